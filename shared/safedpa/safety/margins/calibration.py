"""Margins calibrated on recorded transitions, and the TOML file that keeps them with their origin.

A margin calibration as it travels on the bus: JSON text.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from math import isfinite
from pathlib import Path
from typing import Any, final

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
]

Scene = Sequence[AbstractBarrier] | Callable[[int], Sequence[AbstractBarrier]]
"""The barriers, the same for all transitions or one scene for each transition's index."""

_FORMAT = 2
_KEYS = ("format", "coverage", "transitions", "date", "fingerprint", "epsilon")
_OPTIONAL = ("drive", "theorem", "constants", "covered")
_MESSAGE = ("drives", "origin", "period", "slower")
"""Optional as well, but no tables of numbers."""
_SAME_PERIOD = 1.01
"""Times as long at most: an error grows with the period, and so much more is less than its own spread."""


@final
@dataclass(frozen=True)
class MarginCalibration:
    """Margins by kind of barrier, and where they come from. Raises InputError naming the key."""

    epsilon: dict[str, float]
    """By kind, >= 0, in the unit of h."""
    coverage: float
    """Probability with which no barrier of a kind falls short of its prediction by more than epsilon in one step: a
    step of a fresh drive where there are ``drives``, else one like the steps that were used."""
    transitions: int
    """How many were used."""
    date: str
    """ISO 8601."""
    fingerprint: str
    """Of the model whose errors these are."""

    theorem: dict[str, float] = field(default_factory=dict)
    """By kind, the margin by the theory's bound, in the unit of h; empty when it was not measured."""
    constants: dict[str, float] = field(default_factory=dict)
    """What the bound was made of, scaled; for people."""
    covered: dict[str, float] = field(default_factory=dict)
    """Share of fresh transitions that each margin covered: ``conformal.obstacle``, ``theorem.obstacle``, ...; of fresh
    drives that ``drive`` covered in every step: ``drive.obstacle``, ..."""
    drive: dict[str, float] = field(default_factory=dict)
    """By kind, the margin that no step of a fresh drive exceeds, with probability ``coverage``; empty: too few drives
    to say."""
    drives: int = 0
    """How many drives the margins are over; 0: the transitions were taken for exchangeable."""
    origin: str = ""
    """The command that made it, with its seeds and the version; empty: not told."""
    period: float = 0.0
    """s, of the steps whose errors these are; 0: not told, then it is the model's own."""
    slower: dict[str, dict[str, float]] = field(default_factory=dict)
    """By period [s] of longer steps, the margins in place of ``epsilon`` that were calibrated on those."""

    def __post_init__(self) -> None:
        if not isinstance(self.epsilon, dict) or not self.epsilon:
            raise InputError(f"epsilon: got {self.epsilon!r}, wanted a table with a number for each kind of barrier")
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
            if not isinstance(table, dict) or set(table) != set(self.epsilon):
                reported = ", ".join(table) if isinstance(table, dict) else repr(table)
                raise InputError(f"slower.{period}: got {reported}, wanted numbers for {', '.join(self.epsilon)}")
            for kind, value in table.items():
                _check_number(f"slower.{period}.{kind}", value, 0.0)
            try:
                _check_number(f"slower.{period}", float(period), self.period)
            except ValueError as error:
                raise InputError(f"slower.{period}: wanted a period in s for the name of the table") from error

    def chosen(self, margin: str | float) -> MarginCalibration:
        """The calibration whose ``epsilon`` is what the settings' ``margin`` names: a table, or one number for all.

        Raises InputError for ``theorem`` and ``drive`` when that margin is not in the calibration.
        """
        if margin == "conformal":
            return self
        if margin not in ("theorem", "drive"):
            return replace(self, epsilon=dict.fromkeys(self.epsilon, float(margin)), slower={})
        table = self.theorem if margin == "theorem" else self.drive
        if set(table) != set(self.epsilon):
            raise InputError(
                f"margin '{margin}': the calibration has it for {', '.join(table) or 'no kind'}, wanted "
                f"{', '.join(self.epsilon)}; write it with 'safedpa calibrate'"
            )
        return replace(self, epsilon=dict(table), slower={})

    def over(self, period: float, own: float) -> tuple[MarginCalibration, float]:
        """The same with ``epsilon`` for steps of ``period`` [s], and how many times as long as any known ones they are.

        1 and what was calibrated on such steps or the next longer ones, never less than on shorter ones; beyond all of
        them so many times the widest: what steps come to that are so long if all parts of each err in one way.
        ``own`` [s] is the model's own period, which stands where none is told.
        """
        tables = [(self.period or own, self.epsilon), *((float(name), table) for name, table in self.slower.items())]
        longest = max(known for known, _ in tables)
        until = min((known for known, _ in tables if period <= _SAME_PERIOD * known), default=longest)
        times = period / longest if period > _SAME_PERIOD * longest else 1.0
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
        """The calibration that a TOML text holds; raises InputError naming the key."""
        table = parse_toml(text)
        for key in table:
            if key not in (known := (*_KEYS, *_MESSAGE, *_OPTIONAL)):
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
        """The calibration in a file; raises InputError naming the file and the key."""
        try:
            return MarginCalibration.parse(text_of_file(Path(path), "toml_bytes"))
        except (OSError, UnicodeDecodeError, InputError) as error:
            raise InputError(f"{path}: {error}") from error


def calibrate_margin(
    model: AbstractDynamics | Prediction,
    barriers: Scene,
    states: ArrayLike,
    actions: ArrayLike,
    next_states: ArrayLike,
    latents: ArrayLike | None = None,
    *,
    coverage: float,
    date: str,
    model_fingerprint: str = "",
) -> MarginCalibration:
    """Margins from n transitions that were not used to fit the model: states (n, states), actions (n, actions), ...

    One error for each transition and kind, the worst over the kind's barriers, so that the coverage holds for all of
    them at once. Raises InputError when n is too small for the coverage, or shapes do not fit.
    """
    errors = one_step_errors(model, barriers, states, actions, next_states, latents)
    if not isinstance(model, PhysicsModel):
        return calibration_from_errors(errors, coverage, date, model_fingerprint)
    return calibration_from_errors(errors, coverage, date, model_fingerprint or fingerprint(model), model.period)


def calibration_from_errors(
    errors: Mapping[str, FloatArray], coverage: float, date: str, model_fingerprint: str, period: float = 0.0
) -> MarginCalibration:
    """Margins from errors by kind (n,), as ``one_step_errors`` has them, of steps of ``period`` [s], 0: not told.

    Raises InputError when some n is too small.
    """
    count = min(map(len, errors.values()), default=0)
    if count < smallest_sample(coverage):
        raise InputError(
            f"transitions: got {count}, wanted at least {smallest_sample(coverage)} for a coverage of {coverage}; "
            "record more or ask for less"
        )
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
    """By kind (n,): max over the kind's barriers of h(predicted next state) - h(measured next state).

    Kinds without a barrier in some scene have error 0 there. Raises InputError when shapes do not fit.
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
        expected = prediction.next_state(x[row], a[row], None if z is None else z[row], None)
        for part in barriers(row) if callable(barriers) else barriers:
            worst = (part.values(expected) - part.values(following[row])).max(initial=-np.inf)
            kept = errors.setdefault(part.kind, np.full(len(x), -np.inf))
            kept[row] = np.maximum(kept[row], worst)  # max() would lose a NaN
    if not errors:
        raise InputError("barriers: got none, wanted at least one")
    return {kind: np.where(np.isneginf(values), 0.0, values) for kind, values in errors.items()}


def _lines_of(table: Mapping[str, float]) -> list[str]:
    return [f'"{kind}" = {float(value)!r}' for kind, value in table.items()]


def _check_number(name: str, value: Any, low: float) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not isfinite(value) or value < low:
        raise InputError(f"{name}: got {value!r}, wanted a finite number >= {low:g}")


def margin_text(calibration: MarginCalibration) -> str:
    """The JSON text that ``margin_from_text`` reads back."""
    return json.dumps(asdict(calibration), sort_keys=True)


def margin_from_text(text: str) -> MarginCalibration:
    """The calibration that a JSON text holds. Raises InputError naming what is wrong."""
    try:
        return MarginCalibration(**parse_json(text))
    except (ValueError, TypeError, InputError) as error:
        raise InputError(f"margin: {error}; wanted a calibration as JSON text") from error
