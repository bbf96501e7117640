"""Margin calibration from recordings of the bus: what the filter knew, did, and what became of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import final

import numpy as np

from safedpa.bus import LatentMessage, StateMessage
from safedpa.dynamics import PhysicsModel, fingerprint
from safedpa.errors import InputError
from safedpa.records import read_messages
from safedpa.safety.barrier import AbstractBarrier
from safedpa.safety.calibration import MarginCalibration, calibration_from_errors, one_step_errors
from safedpa.safety.point_scene import PointScene
from safedpa.safety.scenes import scene_of
from safedpa.safety.settings import FilterSettings
from safedpa.safety.theory_recorded import recorded_bound

__all__ = ["RecordedTransitions", "calibration_from_recordings"]

_BLOCK = 100
"""Transitions that stay together, 5 s at 20 Hz: neighbours are too much alike for one to be fresh to the other."""
_SHARE = 5

_Stamp = tuple[str, int, int]
"""Robot, epoch, tick."""


@dataclass(frozen=True)
class _Transition:
    before: StateMessage
    after: StateMessage
    latent: tuple[float, ...]


@final
class RecordedTransitions:
    """The n transitions of recordings in which the robot did what the filter said, as arrays, with their scenes.

    ``state`` (n, states), ``action`` (n, actions), ``following`` (n, states), ``latent`` (n, latents).

    Raises InputError when there are none, latents of another model, or settings of another robot.
    """

    def __init__(self, model: PhysicsModel, settings: FilterSettings, recordings: Sequence[Path]) -> None:
        self._scenes = scene_of(model, settings)
        found = [transition for path in recordings for transition in _transitions(path, fingerprint(model))]
        if not found:
            raise InputError(
                f"{recordings[0]}: got no transition under an action of the filter with a latent; record more"
            )
        self._found = found
        self.state = np.array([transition.before.values for transition in found])
        self.action = np.array([transition.after.applied for transition in found])
        self.following = np.array([transition.after.values for transition in found])
        self.latent = np.array([transition.latent for transition in found])
        self.footprints = {transition.before.footprint for transition in found}

    def __len__(self) -> int:
        return len(self._found)

    def barriers(self, row: int) -> Sequence[AbstractBarrier]:
        """Of the scene in which a transition began. Raises InputError when it is none."""
        if isinstance(self._scenes, PointScene):
            self._scenes.learn(self.latent[row])
        scene = self._scenes.of(self._found[row].before)
        if isinstance(scene, str):
            raise InputError(f"the {scene}")
        return scene


def calibration_from_recordings(
    model: PhysicsModel,
    settings: FilterSettings,
    recordings: Sequence[Path],
    coverage: float,
    date: str,
    constants: Mapping[str, float] | None = None,
) -> MarginCalibration:
    """Both margins by kind, and what share of fresh transitions each covers; ``constants`` are added to its own.

    Every fifth block of 5 s is fresh: not used for the margins. Raises InputError when the recordings hold too few
    transitions, or latents of another model.
    """
    found = RecordedTransitions(model, settings, recordings)
    fresh = np.arange(len(found)) // _BLOCK % _SHARE == _SHARE - 1
    errors = one_step_errors(model, found.barriers, found.state, found.action, found.following, found.latent)
    used = {kind: values[~fresh] for kind, values in errors.items()}
    calibration = calibration_from_errors(used, coverage, date, fingerprint(model))
    bound = recorded_bound(model, settings, found, ~fresh, coverage)
    theorem = {kind: value for kind, value in bound.margins.items() if kind in errors}
    covered = {
        f"{name}.{kind}": float((errors[kind][fresh] <= epsilon).mean())
        for name, table in (("conformal", calibration.epsilon), ("theorem", theorem))
        for kind, epsilon in table.items()
        if fresh.any()
    }
    return replace(calibration, theorem=theorem, constants={**bound.constants, **(constants or {})}, covered=covered)


def _transitions(path: Path, model: str) -> Iterator[_Transition]:
    """Pairs of consecutive states with the latent of the first; messages may stand in the file in any order."""
    states: dict[_Stamp, StateMessage] = {}
    latents: dict[_Stamp, LatentMessage] = {}
    for key, _, message in read_messages(path):
        stamp = (key.split("/")[2], message.epoch, message.tick)
        if isinstance(message, LatentMessage):
            if message.model != model:
                raise InputError(f"{path}: latents of model {message.model}, wanted {model}; drive with that model")
            latents[stamp] = message
        elif isinstance(message, StateMessage):
            states[stamp] = message
    for robot, epoch, tick in sorted(states):
        before = states[robot, epoch, tick]
        after, latent = states.get((robot, epoch, tick + 1)), latents.get((robot, epoch, tick))
        if after is not None and latent is not None and after.applied_by == "filter":
            yield _Transition(before, after, latent.values)
