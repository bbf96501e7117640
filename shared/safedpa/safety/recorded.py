"""Margin calibration from recordings of the bus: what the filter knew, did, and what became of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from safedpa.bus import LatentMessage, StateMessage
from safedpa.dynamics import PhysicsModel, fingerprint
from safedpa.errors import InputError
from safedpa.records import read_messages
from safedpa.safety.barrier import AbstractBarrier
from safedpa.safety.calibration import MarginCalibration, calibrate_margin
from safedpa.safety.scene import SceneBarriers
from safedpa.safety.settings import FilterSettings

__all__ = ["calibration_from_recordings"]


_Stamp = tuple[str, int, int]
"""Robot, epoch, tick."""


@dataclass(frozen=True)
class _Transition:
    before: StateMessage
    after: StateMessage
    latent: tuple[float, ...]


def calibration_from_recordings(
    model: PhysicsModel, settings: FilterSettings, recordings: Sequence[Path], coverage: float, date: str
) -> MarginCalibration:
    """Margins by kind from every transition in which the robot did what the filter said.

    Raises InputError when the recordings hold too few of them, or latents of another model.
    """
    found = [transition for path in recordings for transition in _transitions(path, fingerprint(model))]
    if not found:
        raise InputError(f"{recordings[0]}: got no transition under an action of the filter with a latent; record more")
    scenes = SceneBarriers(settings)

    def barriers(row: int) -> Sequence[AbstractBarrier]:
        scene = scenes.of(found[row].before)
        if isinstance(scene, str):
            raise InputError(f"the {scene}")
        return scene

    return calibrate_margin(
        model,
        barriers,
        np.array([transition.before.values for transition in found]),
        np.array([transition.after.applied for transition in found]),
        np.array([transition.after.values for transition in found]),
        np.array([transition.latent for transition in found]),
        coverage=coverage,
        date=date,
    )


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
