"""Margins from recordings of the bus, which contain the filter's inputs, actions and the resulting states.

They are split conformal quantiles, and next to them those of Theorem 1, from norms of one-step errors.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.bus import LatentMessage, StateMessage
from safedpa.calibration.from_drives import DriveTick, barrier_residuals, calibration_from_drives, covered_shares
from safedpa.dynamics import PhysicsModel, fingerprint
from safedpa.errors import InputError
from safedpa.networks import frame_of
from safedpa.records import read_messages
from safedpa.runtime.scene import scene_of
from safedpa.safety.margins.calibration import MarginCalibration, calibration_from_errors
from safedpa.safety.margins.conformal import smallest_sample, split_conformal_margin
from safedpa.safety.margins.error_clipping import ErrorClip
from safedpa.safety.settings import FilterSettings
from safedpa.systems.robots import robot_like

# Transitions per block, 5 s at 20 Hz. Neighbouring transitions are correlated, so data are split by whole blocks. The
# first of every ten blocks determines the scales of Theorem 1.
_BLOCK = 100
# Every fifth block or drive is held out.
_SHARE = 5

# Robot and epoch.
_Start = tuple[str, int]


@final
class RecordedTransitions:
    """The n transitions in which the robot applied the filter's action, as arrays.

    ``state`` (n, states), ``action`` (n, actions), ``following`` (n, states), ``latent`` (n, latents), ``drive`` (n,).

    Raises InputError without any transition.
    """

    def __init__(self, drives: Sequence[Sequence[DriveTick]]) -> None:
        found = [(number, *pair) for number, ticks in enumerate(drives) for pair in _transitions(ticks)]
        if not found:
            raise InputError("recordings: no transition with an action of the filter and a latent; record more")
        self.drive = np.array([number for number, _, _, _ in found])
        self.state = np.array([before.values for _, before, _, _ in found])
        self.action = np.array([after.applied for _, _, after, _ in found])
        self.following = np.array([after.values for _, _, after, _ in found])
        self.latent = np.array([latent.values for _, _, _, latent in found])
        self.footprints = {before.footprint for _, before, _, _ in found}
        """(rear, front, radius) [m] of the robots."""

    def __len__(self) -> int:
        return len(self.drive)


def calibration_from_recordings(
    model: PhysicsModel,
    settings: FilterSettings,
    recordings: Sequence[Path],
    coverage: float,
    date: str,
) -> MarginCalibration:
    """Calibrates the margins by kind of barrier, and their coverage of held-out data.

    With enough drives (a drive is one start of one robot), every fifth drive is held out, and there are margins for a
    step near a boundary and for a whole drive. With fewer drives, every fifth block of 5 s is held out, transitions are
    assumed exchangeable, and all of them count whether near a boundary or not; there are no margins for drives. Raises
    InputError for too few transitions or drives, latents of another model, or robots of several periods.
    """
    scene_of(model, settings)  # raises for settings of another robot before reading the recordings
    own, clip = fingerprint(model), ErrorClip.of_settings(settings)
    drives = [ticks for path in recordings for ticks in _drives(path, own)]
    period = _period_of(drives, model)
    walked = [(ticks, barrier_residuals(model, settings, ticks)) for ticks in drives]
    along = [heights for _, heights in walked if heights]
    found = RecordedTransitions([ticks for ticks, heights in walked if heights])
    if by_drives := len(along) - len(along) // _SHARE >= smallest_sample(coverage):
        if len(along) < _SHARE:
            raise InputError(f"drives: got {len(along)}, wanted at least {_SHARE} to hold one of them out; record more")
        used = [heights for number, heights in enumerate(along) if number % _SHARE != _SHARE - 1]
        made = calibration_from_drives(used, coverage, date, own, clip)
    else:
        old = {kind: values[~fresh] for kind, (values, fresh) in _all_errors(along, settings.eta).items()}
        made = calibration_from_errors(old, coverage, date, own)
    made = replace(made, period=period)
    fresh = (found.drive if by_drives else np.arange(len(found)) // _BLOCK) % _SHARE == _SHARE - 1
    bound = recorded_bound(model.with_period(period), settings, found, ~fresh, coverage)
    theorem = {kind: value for kind, value in bound.margins.items() if kind in made.epsilon}
    made = replace(made, theorem=theorem, constants={**made.constants, **bound.constants})
    return replace(made, covered=_covered(made, along, clip, by_drives=by_drives))


def _period_of(drives: Sequence[Sequence[DriveTick]], model: PhysicsModel) -> float:
    """Returns the common period of all drives [s], or the model's without drives. Errors grow with the period."""
    periods = sorted({tick.state.period for ticks in drives for tick in ticks}) or [model.period]
    if len(periods) > 1:
        reported = " and ".join(f"{period:g}" for period in (periods[0], periods[-1]))
        raise InputError(f"recordings: got steps of {reported} s, wanted one period; calibrate for each separately")
    return periods[0]


def _all_errors(
    along: Sequence[Mapping[str, FloatArray]], eta: float
) -> dict[str, tuple[FloatArray, NDArray[np.bool_]]]:
    """Returns the concatenated errors (steps,) of all drives by kind, and which of them are held out."""
    kinds = dict.fromkeys(kind for heights in along for kind in heights)
    clip = ErrorClip(eta)
    joined = {kind: np.concatenate([heights[kind] for heights in along if kind in heights]) for kind in kinds}
    return {
        kind: (clip.errors(kind, rows), np.arange(len(rows)) // _BLOCK % _SHARE == _SHARE - 1)
        for kind, rows in joined.items()
    }


def _covered(
    made: MarginCalibration, along: Sequence[Mapping[str, FloatArray]], clip: ErrorClip, *, by_drives: bool
) -> dict[str, float]:
    """Returns the share of held-out steps that each margin covers, and of held-out drives that ``drive`` covers."""
    reported: dict[str, float] = {}
    blocks, fresh = _all_errors(along, clip.eta), along[_SHARE - 1 :: _SHARE]
    for name, table in (("conformal", made.epsilon), ("theorem", made.theorem), ("drive", made.drive)):
        for kind, epsilon in table.items():
            if by_drives:
                shares = covered_shares(fresh, kind, epsilon, clip)
                reported[f"{name}.{kind}"] = float((shares == 1.0).mean() if name == "drive" else shares.mean())
            elif (left := blocks[kind][0][blocks[kind][1]]).size:
                reported[f"{name}.{kind}"] = float((left <= epsilon).mean())
    return reported


def _drives(path: Path, model: str) -> list[list[DriveTick]]:
    """Returns one list of ticks per start of a robot; the messages of a file may be in any order."""
    states: dict[_Start, dict[int, StateMessage]] = {}
    latents: dict[_Start, dict[int, LatentMessage]] = {}
    for key, _, message in read_messages(path):
        start = (key.split("/")[2], message.epoch)
        if isinstance(message, LatentMessage):
            if message.model != model:
                raise InputError(f"{path}: latents of model {message.model}, wanted {model}; drive with that model")
            latents.setdefault(start, {})[message.tick] = message
        elif isinstance(message, StateMessage):
            states.setdefault(start, {})[message.tick] = message
    return [
        [DriveTick(known[tick], latents.get(start, {}).get(tick)) for tick in sorted(known)]
        for start, known in sorted(states.items())
    ]


def _transitions(ticks: Sequence[DriveTick]) -> Iterator[tuple[StateMessage, StateMessage, LatentMessage]]:
    """Yields consecutive states, the second one reached under the filter's action, with the latent of the first."""
    for (before, latent), (after, _) in pairwise(ticks):
        if after.tick == before.tick + 1 and after.applied_by == "filter" and latent is not None:
            yield before, after, latent


_SMALLEST_SCALE = 1e-6


@final
@dataclass(frozen=True)
class RecordedBound:
    """Margins by kind of barrier, and the constants of which they are products; both empty except for the car."""

    margins: dict[str, float]
    constants: dict[str, float]


def recorded_bound(
    model: PhysicsModel, settings: FilterSettings, found: RecordedTransitions, used: NDArray[np.bool_], coverage: float
) -> RecordedBound:
    """Returns epsilon = P eps with eps the split conformal quantile of |v - v^|_sup over the ``used`` (n,) transitions.

    With the latent in use as the definition of z, eps_z is 0, and eps_f + eps_g |u|_1 + eps_r equals |v - v^|_sup,
    which can be measured. Its product with the largest gradient of h is the margin of Theorem 1, as far as a recording
    shows it. The bound holds for any scaling of the state's entries. Here each entry is scaled by its own errors on
    some transitions that are then left out, so that the error of one entry does not dominate the others.

    P is the largest gradient over the recorded footprints. Raises InputError for too few transitions for the coverage.
    """
    robot = robot_like(model.system)
    if robot is None or not robot.theorem_margins:
        return RecordedBound({}, {})
    errors = np.abs(own_errors(model, found))
    scaling = used & (np.arange(len(used)) // _BLOCK % 10 == 0)
    scale = np.maximum(np.quantile(errors[scaling], coverage, axis=0), _SMALLEST_SCALE)
    steps = (errors[used & ~scaling] / scale).max(axis=-1)
    step = split_conformal_margin(steps, coverage)
    if not np.isfinite(step):
        raise InputError(f"transitions: got {len(steps)}, too few for a coverage of {coverage}; record more")
    tables = [robot.largest_gradients(settings, footprint, scale) for footprint in found.footprints]
    gradients = {kind: max(table[kind] for table in tables) for kind in tables[0]}
    constants = {
        "step": step,
        **{f"scale.{name}": float(value) for name, value in zip(model.system.state_names, scale, strict=True)},
        **{f"gradient.{kind}": value for kind, value in gradients.items()},
    }
    return RecordedBound({kind: value * step for kind, value in gradients.items()}, constants)


def own_errors(model: PhysicsModel, found: RecordedTransitions) -> FloatArray:
    """Returns measured minus predicted increment (n, states) in the robot's own frame, in SI units."""
    frame = frame_of(model.system.name)
    expected = model.step(found.state, found.action, found.latent)
    measured = frame.own_increment(found.state, found.following)
    return np.asarray(measured - frame.own_increment(found.state, expected))
