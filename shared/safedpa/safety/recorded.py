"""Margin calibration from recordings of the bus: what the filter knew, did, and what became of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import LatentMessage, StateMessage
from safedpa.dynamics import PhysicsModel, fingerprint
from safedpa.errors import InputError
from safedpa.records import read_messages
from safedpa.safety.calibration import MarginCalibration, calibration_from_drives, calibration_from_errors
from safedpa.safety.ceiling import NO_CEILING
from safedpa.safety.drive_errors import DrivenTick, drive_errors
from safedpa.safety.margin import smallest_sample
from safedpa.safety.settings import FilterSettings
from safedpa.safety.theory_recorded import recorded_bound

__all__ = ["RecordedTransitions", "calibration_from_recordings", "joined"]

Values = NDArray[np.float64]

_BLOCK = 100
"""Transitions that stay together, 5 s at 20 Hz: neighbours are too much alike for one to be fresh to the other."""
_SHARE = 5

_Start = tuple[str, int]
"""Robot and epoch."""


@dataclass(frozen=True)
class _Transition:
    before: StateMessage
    after: StateMessage
    latent: tuple[float, ...]
    drive: int


@final
class RecordedTransitions:
    """The n transitions of drives in which the robot did what the filter said, as arrays, with the drive of each.

    ``state`` (n, states), ``action`` (n, actions), ``following`` (n, states), ``latent`` (n, latents), ``drive`` (n,).

    Raises InputError when there are none.
    """

    def __init__(self, drives: Sequence[Sequence[DrivenTick]]) -> None:
        found = [transition for number, ticks in enumerate(drives) for transition in _transitions(number, ticks)]
        if not found:
            raise InputError("recordings: got no transition under an action of the filter with a latent; record more")
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
    constants: Mapping[str, float] | None = None,
) -> MarginCalibration:
    """The margins by kind, and what share of fresh data each covers; ``constants`` are added to its own.

    With enough drives (a drive is one start of one robot) every fifth drive is fresh, and the margins are over drives:
    for a step near a boundary, and for a whole drive. With fewer, every fifth block of 5 s is fresh, transitions are
    taken for exchangeable, all of them count, near a boundary or not, and nothing is said about drives. Raises
    InputError when the recordings hold too few transitions, or latents of another model.
    """
    drives = [ticks for path in recordings for ticks in _drives(path, fingerprint(model))]
    walked = [(ticks, drive_errors(model, settings, ticks)) for ticks in drives]
    along = [errors for _, errors in walked if errors]
    found = RecordedTransitions([ticks for ticks, errors in walked if errors])
    by_drives = len(along) - len(along) // _SHARE >= smallest_sample(coverage)
    if by_drives:
        made, covered = _over_drives(along, coverage, date, fingerprint(model))
    else:
        everywhere = [drive_errors(model, settings, ticks, NO_CEILING) for ticks, errors in walked if errors]
        made, covered = _over_blocks(everywhere, coverage, date, fingerprint(model))
    fresh = (found.drive if by_drives else np.arange(len(found)) // _BLOCK) % _SHARE == _SHARE - 1
    bound = recorded_bound(model, settings, found, ~fresh, coverage)
    theorem = {kind: value for kind, value in bound.margins.items() if kind in made.epsilon}
    told = {f"theorem.{kind}": share for kind, share in covered(theorem).items()}
    told |= {f"conformal.{kind}": share for kind, share in covered(made.epsilon).items()}
    if by_drives:
        told |= {f"drive.{kind}": share for kind, share in _whole(along, made.drive).items()}
    return replace(made, theorem=theorem, constants={**bound.constants, **(constants or {})}, covered=told)


_Covered = Callable[[Mapping[str, float]], dict[str, float]]
"""From margins by kind to the share of fresh steps that each covers."""


def _over_drives(
    along: Sequence[Mapping[str, Values]], coverage: float, date: str, own: str
) -> tuple[MarginCalibration, _Covered]:
    used = [errors for number, errors in enumerate(along) if number % _SHARE != _SHARE - 1]
    fresh = joined(along[_SHARE - 1 :: _SHARE])
    return calibration_from_drives(used, coverage, date, own), lambda margins: _shares(fresh, margins)


def _over_blocks(
    along: Sequence[Mapping[str, Values]], coverage: float, date: str, own: str
) -> tuple[MarginCalibration, _Covered]:
    errors = joined(along)
    fresh = {kind: np.arange(len(values)) // _BLOCK % _SHARE == _SHARE - 1 for kind, values in errors.items()}
    used = {kind: values[~fresh[kind]] for kind, values in errors.items()}
    left = {kind: values[fresh[kind]] for kind, values in errors.items()}
    return calibration_from_errors(used, coverage, date, own), lambda margins: _shares(left, margins)


def joined(along: Sequence[Mapping[str, Values]]) -> dict[str, Values]:
    """The errors by kind of all drives, one after the other."""
    kinds = dict.fromkeys(kind for errors in along for kind in errors)
    return {kind: np.concatenate([errors[kind] for errors in along if kind in errors]) for kind in kinds}


def _shares(fresh: Mapping[str, Values], margins: Mapping[str, float]) -> dict[str, float]:
    return {
        kind: float((fresh[kind] <= epsilon).mean())
        for kind, epsilon in margins.items()
        if kind in fresh and len(fresh[kind])
    }


def _whole(along: Sequence[Mapping[str, Values]], margins: Mapping[str, float]) -> dict[str, float]:
    """Share of the fresh drives in which no error lies beyond the margin."""
    fresh = along[_SHARE - 1 :: _SHARE]
    if not fresh:
        return {}
    return {
        kind: float(np.mean([bool((errors.get(kind, np.zeros(0)) <= epsilon).all()) for errors in fresh]))
        for kind, epsilon in margins.items()
    }


def _drives(path: Path, model: str) -> list[list[DrivenTick]]:
    """One list for each start of a robot; messages may stand in the file in any order."""
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
        [DrivenTick(known[tick], latents.get(start, {}).get(tick)) for tick in sorted(known)]
        for start, known in sorted(states.items())
    ]


def _transitions(drive: int, ticks: Sequence[DrivenTick]) -> Iterator[_Transition]:
    """Pairs of consecutive states with the latent of the first."""
    for before, after in pairwise(ticks):
        wanted = after.state.tick == before.state.tick + 1 and after.state.applied_by == "filter"
        if wanted and before.latent is not None:
            yield _Transition(before.state, after.state, before.latent.values, drive)
