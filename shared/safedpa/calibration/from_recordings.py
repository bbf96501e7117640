"""Margin calibration from recordings of the bus, which contain the filter's inputs, actions and the resulting
states."""

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
from safedpa.calibration.theorem1 import recorded_bound
from safedpa.dynamics import PhysicsModel, fingerprint
from safedpa.errors import InputError
from safedpa.records import read_messages
from safedpa.runtime.scene import scene_of
from safedpa.safety.margins.calibration import MarginCalibration, calibration_from_errors
from safedpa.safety.margins.conformal import smallest_sample
from safedpa.safety.margins.error_clipping import ErrorClip
from safedpa.safety.settings import FilterSettings

# Transitions per block, 5 s at 20 Hz. Neighbouring transitions are correlated, so data are split by whole blocks.
_BLOCK = 100
# Every fifth block or drive is held out.
_SHARE = 5

# Robot and epoch.
_Start = tuple[str, int]


@dataclass(frozen=True)
class _RecordedTransition:
    before: StateMessage
    after: StateMessage
    latent: tuple[float, ...]
    drive: int


@final
class RecordedTransitions:
    """The n transitions in which the robot applied the filter's action, as arrays.

    ``state`` (n, states), ``action`` (n, actions), ``following`` (n, states), ``latent`` (n, latents), ``drive`` (n,).

    Raises InputError without any transition.
    """

    def __init__(self, drives: Sequence[Sequence[DriveTick]]) -> None:
        found = [transition for number, ticks in enumerate(drives) for transition in _transitions(number, ticks)]
        if not found:
            raise InputError("recordings: no transition with an action of the filter and a latent; record more")
        self.drive = np.array([transition.drive for transition in found])
        self.state = np.array([transition.before.values for transition in found])
        self.action = np.array([transition.after.applied for transition in found])
        self.following = np.array([transition.after.values for transition in found])
        self.latent = np.array([transition.latent for transition in found])
        self.footprints = {transition.before.footprint for transition in found}

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
    drives = [ticks for path in recordings for ticks in _drives(path, fingerprint(model))]
    period = _period_of(drives, model)
    walked = [(ticks, barrier_residuals(model, settings, ticks)) for ticks in drives]
    along = [heights for _, heights in walked if heights]
    found = RecordedTransitions([ticks for ticks, heights in walked if heights])
    if by_drives := len(along) - len(along) // _SHARE >= smallest_sample(coverage):
        if len(along) < _SHARE:
            raise InputError(f"drives: got {len(along)}, wanted at least {_SHARE} to hold one of them out; record more")
        made = _over_drives(along, settings, coverage, date, fingerprint(model))
    else:
        made = _over_blocks(along, settings.eta, coverage, date, fingerprint(model))
    made = replace(made, period=period)
    fresh = (found.drive if by_drives else np.arange(len(found)) // _BLOCK) % _SHARE == _SHARE - 1
    bound = recorded_bound(model.with_period(period), settings, found, ~fresh, coverage)
    theorem = {kind: value for kind, value in bound.margins.items() if kind in made.epsilon}
    made = replace(made, theorem=theorem, constants={**made.constants, **bound.constants})
    return replace(made, covered=_covered(made, along, ErrorClip.of_settings(settings), by_drives=by_drives))


def _period_of(drives: Sequence[Sequence[DriveTick]], model: PhysicsModel) -> float:
    """Returns the common period of all drives [s], or the model's without drives. Errors grow with the period."""
    periods = sorted({tick.state.period for ticks in drives for tick in ticks}) or [model.period]
    if len(periods) > 1:
        reported = " and ".join(f"{period:g}" for period in (periods[0], periods[-1]))
        raise InputError(f"recordings: got steps of {reported} s, wanted one period; calibrate for each separately")
    return periods[0]


def _over_drives(
    along: Sequence[Mapping[str, FloatArray]], settings: FilterSettings, coverage: float, date: str, own: str
) -> MarginCalibration:
    used = [heights for number, heights in enumerate(along) if number % _SHARE != _SHARE - 1]
    return calibration_from_drives(used, coverage, date, own, ErrorClip.of_settings(settings))


def _over_blocks(
    along: Sequence[Mapping[str, FloatArray]], eta: float, coverage: float, date: str, own: str
) -> MarginCalibration:
    used = {kind: values[~fresh] for kind, (values, fresh) in _all_errors(along, eta).items()}
    return calibration_from_errors(used, coverage, date, own)


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


def _transitions(drive: int, ticks: Sequence[DriveTick]) -> Iterator[_RecordedTransition]:
    """Yields pairs of consecutive states with the latent of the first one."""
    for before, after in pairwise(ticks):
        wanted = after.state.tick == before.state.tick + 1 and after.state.applied_by == "filter"
        if wanted and before.latent is not None:
            yield _RecordedTransition(before.state, after.state, before.latent.values, drive)
