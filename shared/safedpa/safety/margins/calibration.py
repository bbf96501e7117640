"""Margins calibrated on recorded transitions, the TOML file that stores them, and their JSON text on the bus."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from math import isfinite
from pathlib import Path
from typing import Any, cast, final

import numpy as np
from numpy.typing import ArrayLike

from safedpa.arrays import FloatArray
from safedpa.dynamics import AbstractDynamics, PhysicsModel, fingerprint
from safedpa.errors import InputError, did_you_mean
from safedpa.limits import parse_json, parse_toml, text_of_file
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.margins.conformal import smallest_sample, split_conformal_margin
from safedpa.safety.prediction.predictor import Prediction

__all__ = [
    "MarginCalibration",
    "calibrate_margin",
    "calibration_from_errors",
    "margin_from_text",
    "margin_text",
    "one_step_errors",
    "transitions_of",
]

Scene = Sequence[AbstractBarrier] | Callable[[int], Sequence[AbstractBarrier]]
"""The barriers: the same for all transitions, or a function that returns those of a transition's index."""

Drive = Any
"""A recording with ``parts()``, stretches of time, states and actions; or a pair of states and actions."""

_SAME_STEP = 0.1
"""Share by which a step may differ from the usual one."""
_FORMAT = 2
_KEYS = ("format", "coverage", "transitions", "date", "fingerprint", "epsilon")
_OPTIONAL = ("drive", "theorem", "constants", "covered")
_OPTIONAL_SCALARS = ("drives", "origin", "period", "slower")
"""Optional keys that are no tables of numbers."""
_PERIOD_TOLERANCE = 1.01
"""Ratio up to which a longer period counts as the same: the error it adds is less than the spread of the errors."""


@final
@dataclass(frozen=True)
class MarginCalibration:
    """Margins by kind of barrier with their origin. Raises InputError naming the key."""

    epsilon: dict[str, float]
    """By kind, >= 0, in the unit of h."""
    coverage: float
    """Probability that no barrier of a kind falls short of its prediction by more than epsilon in one step: a step of a
    new drive if there are ``drives``, else a step like those that were used."""
    transitions: int
    """Number of transitions used."""
    date: str
    """ISO 8601."""
    fingerprint: str
    """Of the model whose errors these are."""

    theorem: dict[str, float] = field(default_factory=dict)
    """By kind, the margin from the theorem's bound, in the unit of h; empty if it was not measured."""
    constants: dict[str, float] = field(default_factory=dict)
    """The scaled constants of the bound, for information."""
    covered: dict[str, float] = field(default_factory=dict)
    """Share of new transitions that each margin covered: ``conformal.obstacle``, ``theorem.obstacle``, ...; and of new
    drives that ``drive`` covered in every step: ``drive.obstacle``, ..."""
    drive: dict[str, float] = field(default_factory=dict)
    """By kind, the margin that no step of a new drive exceeds, with probability ``coverage``; empty: too few drives."""
    drives: int = 0
    """Number of drives that the margins are over; 0: the transitions were treated as exchangeable."""
    origin: str = ""
    """The command that made it, with its seeds and the version; empty: not reported."""
    period: float = 0.0
    """Period [s] of the steps whose errors these are; 0: not reported, then the model's own."""
    slower: dict[str, dict[str, float]] = field(default_factory=dict)
    """Margins for longer steps by their period [s], calibrated on such steps."""

    def __post_init__(self) -> None:
        if not isinstance(self.epsilon, dict) or not self.epsilon:
            raise InputError(f"epsilon: got {self.epsilon!r}, wanted a table with a number for each kind of barrier")
        # All tables have the same form, so one loop names the key of any mistake.
        for name in ("epsilon", *_OPTIONAL):
            if not isinstance(table := getattr(self, name), dict):
                raise InputError(f"{name}: got {table!r}, wanted a table of numbers")
            for kind, value in table.items():
                _check_number(f"{name}.{kind}", value, 0.0)
        self._check_slower()
        _check_number("coverage", self.coverage, 0.0)
        if not 0.0 < self.coverage < 1.0:
            raise InputError(f"coverage: got {self.coverage}, wanted more than 0 and less than 1")
        _check_number("transitions", self.transitions, 1)
        _check_number("drives", self.drives, 0)
        _check_number("period", self.period, 0.0)
        for name in ("date", "fingerprint", "origin"):
            if not isinstance(getattr(self, name), str):
                raise InputError(f"{name}: got {getattr(self, name)!r}, wanted a string")

    def _check_slower(self) -> None:
        if not isinstance(self.slower, dict):
            raise InputError(f"slower: got {self.slower!r}, wanted a table of margins for each period in s")
        for period, table in self.slower.items():
            # A slower table without some kind would leave its barriers without a margin at that period.
            if not isinstance(table, dict) or set(table) != set(self.epsilon):
                reported = ", ".join(table) if isinstance(table, dict) else repr(table)
                raise InputError(f"slower.{period}: got {reported}, wanted numbers for {', '.join(self.epsilon)}")
            for kind, value in table.items():
                _check_number(f"slower.{period}.{kind}", value, 0.0)
            try:
                _check_number(f"slower.{period}", float(period), self.period)
            except ValueError as error:
                raise InputError(f"slower.{period}: wanted a period in s for the name of the table") from error

    def select(self, margin: str | float) -> MarginCalibration:
        """The calibration whose ``epsilon`` is what the setting ``margin`` names: a table, or one number for all.

        Raises InputError for ``theorem`` and ``drive`` if that margin is not in the calibration.
        """
        if margin == "conformal":
            return self
        # A number chosen by a person applies to every kind, and to every period: it is not measured.
        if margin not in ("theorem", "drive"):
            return replace(self, epsilon=dict.fromkeys(self.epsilon, float(margin)), slower={})
        table = self.theorem if margin == "theorem" else self.drive
        # Every kind needs its margin: a missing one would silently be 0.
        if set(table) != set(self.epsilon):
            raise InputError(
                f"margin '{margin}': the calibration has it for {', '.join(table) or 'no kind'}, wanted "
                f"{', '.join(self.epsilon)}; write it with 'safedpa calibrate'"
            )
        return replace(self, epsilon=dict(table), slower={})

    def for_period(self, period: float, own: float) -> tuple[MarginCalibration, float]:
        """Returns the margins for steps of ``period`` [s], and by which factor they exceed any calibrated period.

        Up to the longest calibrated period the factor is 1: the margins of the next longer steps apply, but never less
        than on shorter ones. Beyond, the widest is multiplied by the factor, as if all errors within a step had the
        same sign. ``own`` [s] is the model's period, for a calibration that reports none.
        """
        tables = [(self.period or own, self.epsilon), *((float(name), table) for name, table in self.slower.items())]
        longest = max(known for known, _ in tables)
        until = min((known for known, _ in tables if period <= _PERIOD_TOLERANCE * known), default=longest)
        times = period / longest if period > _PERIOD_TOLERANCE * longest else 1.0
        # The maximum over all periods up to that one: more time must never give a smaller margin.
        widest = {kind: times * max(table[kind] for known, table in tables if known <= until) for kind in self.epsilon}
        return replace(self, epsilon=widest), times

    def write(self) -> str:
        """The TOML text that ``parse`` reads back."""
        lines = [
            f"format = {_FORMAT}",
            f"coverage = {self.coverage!r}",
            f"transitions = {self.transitions}",
            f'date = "{self.date}"',
            f'fingerprint = "{self.fingerprint}"',
        ]
        # Optional keys are written only if set, so that a file of a simple calibration stays short.
        lines += [f"drives = {self.drives}"] if self.drives else []
        lines += [f'origin = "{self.origin}"'] if self.origin else []
        lines += [f"period = {float(self.period)!r}"] if self.period else []
        for name in ("epsilon", *_OPTIONAL):
            if table := getattr(self, name):
                lines += ["", f"[{name}]", *_lines_of(table)]
        for period, table in self.slower.items():
            lines += ["", f'[slower."{period}"]', *_lines_of(table)]
        return "\n".join(lines) + "\n"

    @staticmethod
    def parse(text: str) -> MarginCalibration:
        """Reads the calibration from a TOML text. Raises InputError naming the key."""
        table = parse_toml(text)
        for key in table:
            # An unknown key is an error: a misspelt one would otherwise be a margin that is not used.
            if key not in (known := (*_KEYS, *_OPTIONAL_SCALARS, *_OPTIONAL)):
                raise InputError(f"{key}: unknown key; {did_you_mean(key, known)}")
        for key in _KEYS:
            if key not in table:
                raise InputError(f"{key}: missing; wanted the keys {', '.join(_KEYS)}")
        if table.pop("format") != _FORMAT:
            raise InputError(f"format: wanted {_FORMAT}; convert an earlier file with 'safedpa migrate'")
        return MarginCalibration(**table)

    def save(self, path: str | Path) -> None:
        """Writes ``write`` to a file."""
        Path(path).write_text(self.write(), encoding="utf-8")

    @staticmethod
    def load(path: str | Path) -> MarginCalibration:
        """Reads the calibration from a file. Raises InputError naming the file and the key."""
        try:
            return MarginCalibration.parse(text_of_file(Path(path), "toml_bytes"))
        except (OSError, UnicodeDecodeError, InputError) as error:
            raise InputError(f"{path}: {error}") from error


def calibrate_margin(
    model: AbstractDynamics | Prediction,
    barriers: Scene,
    states: ArrayLike | Sequence[Drive],
    actions: ArrayLike | None = None,
    next_states: ArrayLike | None = None,
    latents: ArrayLike | None = None,
    *,
    coverage: float,
    date: str,
    model_fingerprint: str = "",
) -> MarginCalibration:
    """Margins from n transitions that were not used to fit the model: states (n, states), actions (n, actions), ...

    Without ``actions``, ``states`` are recorded drives: recordings as ``safedpa.read`` returns them, or pairs of states
    (n, states) and actions (n, actions), one row a period. There is one error for each transition and kind, the worst
    over the kind's barriers, so that the coverage holds for all of them at once. Raises InputError if n is too small
    for the coverage, or shapes do not fit.
    """
    if actions is None or next_states is None:
        if actions is not None or next_states is not None or latents is not None:
            raise InputError("transitions: got states without actions or next states, wanted all three, or drives")
        states, actions, next_states = transitions_of(cast("Sequence[Drive]", states))
    errors = one_step_errors(model, barriers, states, actions, next_states, latents)
    # Only a physics model has a fingerprint and a period of its own.
    if not isinstance(model, PhysicsModel):
        return calibration_from_errors(errors, coverage, date, model_fingerprint)
    return calibration_from_errors(errors, coverage, date, model_fingerprint or fingerprint(model), model.period)


def transitions_of(drives: Sequence[Drive]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """States (n, states), actions (n, actions) and next states (n, states) of all steps of one length.

    Steps of a recording that differ by more than 10 % from the median of all are left out. Raises InputError without
    any step, or for a drive of another form.
    """
    parts: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    for drive in drives:
        # Of a pair, one row a period: the length of a step has no influence.
        stretches = drive.parts() if hasattr(drive, "parts") else [(np.arange(len(drive[0])), *drive)]
        for stretch in stretches:
            t, states, actions = (np.asarray(table, dtype=np.float64) for table in stretch)
            parts.append((t, states, actions))
    for t, states, actions in parts:
        if states.ndim != 2 or actions.ndim != 2 or not len(t) == len(states) == len(actions):
            raise InputError(f"drives: got tables of shapes {states.shape} and {actions.shape}, wanted as many rows")
    steps = [np.diff(t) for t, _, _ in parts]
    if not sum(map(len, steps)):
        raise InputError("drives: got no step, wanted drives of two rows or more")
    usual = float(np.median(np.concatenate(steps)))
    near = [np.abs(step - usual) <= _SAME_STEP * usual for step in steps]
    found = [
        np.concatenate([table[keep] for table, keep in zip(tables, near, strict=True)])
        for tables in (
            [states[:-1] for _, states, _ in parts],
            [actions[:-1] for _, _, actions in parts],
            [states[1:] for _, states, _ in parts],
        )
    ]
    return found[0], found[1], found[2]


def calibration_from_errors(
    errors: Mapping[str, FloatArray], coverage: float, date: str, model_fingerprint: str, period: float = 0.0
) -> MarginCalibration:
    """Margins from errors by kind (n,), as from ``one_step_errors``, of steps of ``period`` [s] (0: not reported).

    Raises InputError if some n is too small.
    """
    count = min(map(len, errors.values()), default=0)
    if count < smallest_sample(coverage):
        raise InputError(
            f"transitions: got {count}, wanted at least {smallest_sample(coverage)} for a coverage of {coverage}; "
            "record more or ask for less"
        )
    # Not below 0: a model that is always too pessimistic must not permit h to fall below 0.
    epsilon = {kind: max(0.0, split_conformal_margin(values, coverage)) for kind, values in errors.items()}
    return MarginCalibration(epsilon, coverage, count, date, model_fingerprint, period=period)


def one_step_errors(
    model: AbstractDynamics | Prediction,
    barriers: Scene,
    states: ArrayLike,
    actions: ArrayLike,
    next_states: ArrayLike,
    latents: ArrayLike | None = None,
) -> dict[str, FloatArray]:
    """By kind (n,): the maximum over its barriers of h(predicted next state) - h(measured next state).

    Kinds without a barrier in some scene have error 0 there. Raises InputError if shapes do not fit.
    """
    prediction = model if isinstance(model, Prediction) else Prediction.of_model(model)
    x, a, following = (np.asarray(table, dtype=np.float64) for table in (states, actions, next_states))
    z = None if latents is None else np.asarray(latents, dtype=np.float64)
    if x.ndim != 2 or x.shape != following.shape or a.ndim != 2 or len(a) != len(x) or len(x) == 0:
        raise InputError(f"transitions: got shapes {x.shape}, {a.shape}, {following.shape}, wanted n rows in each")
    if z is not None and (z.ndim != 2 or len(z) != len(x)):
        raise InputError(f"latents: got shape {z.shape}, wanted ({len(x)}, latents)")
    errors: dict[str, FloatArray] = {}
    for row in range(len(x)):
        # One row at a time: a user's function takes one state.
        expected = prediction.next_state(x[row], a[row], None if z is None else z[row], None)
        for part in barriers(row) if callable(barriers) else barriers:
            worst = (part.h(expected) - part.h(following[row])).max(initial=-np.inf)
            worst_of_kind = errors.setdefault(part.kind, np.full(len(x), -np.inf))
            worst_of_kind[row] = np.maximum(worst_of_kind[row], worst)  # unlike max(), propagates NaN
    if not errors:
        raise InputError("barriers: got none, wanted at least one")
    return {kind: np.where(np.isneginf(values), 0.0, values) for kind, values in errors.items()}


def _lines_of(table: Mapping[str, float]) -> list[str]:
    return [f'"{kind}" = {float(value)!r}' for kind, value in table.items()]


def _check_number(name: str, value: Any, low: float) -> None:
    # bool is a subclass of int in Python; true is no margin.
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not isfinite(value) or value < low:
        raise InputError(f"{name}: got {value!r}, wanted a finite number >= {low:g}")


def margin_text(calibration: MarginCalibration) -> str:
    """JSON text for ``margin_from_text``."""
    return json.dumps(asdict(calibration), sort_keys=True)


def margin_from_text(text: str) -> MarginCalibration:
    """Reads the calibration from JSON text. Raises InputError naming what is wrong."""
    try:
        return MarginCalibration(**parse_json(text))
    except (ValueError, TypeError, InputError) as error:
        raise InputError(f"margin: {error}; wanted a calibration as JSON text") from error
