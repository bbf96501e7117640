"""Margins over drives from what was predicted and measured along each, and what margins cover on other drives.

The errors of h along a drive, as the filter's own watch over its margin sees them: what margins are calibrated on.

One walk for all: recordings and simulated drives go through the same memory of a robot that the deployed filter keeps,
so that whatever a barrier, a latent or an actuator's memory does to a prediction is in the calibration as in the watch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import isfinite
from typing import NamedTuple

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.bus import LATENT, LatentMessage, Stale, StateMessage
from safedpa.dynamics import PhysicsModel, fingerprint
from safedpa.errors import InputError
from safedpa.runtime.calibrated_model import CalibratedModel, uncalibrated
from safedpa.runtime.robot_session import LastDecision, RobotSession
from safedpa.safety.margins.calibration import MarginCalibration
from safedpa.safety.margins.conformal import margins_over_drives, smallest_sample
from safedpa.safety.margins.error_clipping import NO_CLIP, ErrorClip
from safedpa.safety.margins.online import HSample
from safedpa.safety.settings import FilterSettings
from safedpa.safety.verdict import Status, resting_verdict

__all__ = [
    "DriveTick",
    "barrier_residuals",
    "calibration_from_drives",
    "covered_shares",
]

Drives = Sequence[Mapping[str, FloatArray]]
"""Of each drive by kind (steps, 4): the least h as it was predicted, and as it was measured; see ``drive_heights``."""

_NOTHING = np.zeros((0, 4))
_NEAR = 10
"""Drives at least in which something has to have come near: from none a margin of 0 would follow."""
_DOUBLINGS = 40


def calibration_from_drives(
    drives: Drives,
    coverage: float,
    date: str,
    model_fingerprint: str,
    clip: ErrorClip = NO_CLIP,
    origin: str = "",
) -> MarginCalibration:
    """Margins for a step near a boundary, and for a whole drive.

    Errors count below the ``clip``, which is doubled where a margin is too wide for it, or too few drives came near.
    A drive in which nothing of a kind came near counts as one without an error. Raises InputError when there are too
    few drives, or no step in any.
    """
    if len(drives) < smallest_sample(coverage):
        raise InputError(
            f"drives: got {len(drives)}, wanted at least {smallest_sample(coverage)} for a coverage of {coverage}; "
            "drive more or ask for less"
        )
    tables: tuple[dict[str, float], dict[str, float]] = ({}, {})
    tops: dict[str, float] = {}
    for kind in dict.fromkeys(kind for heights in drives for kind in heights):
        along = [heights.get(kind, _NOTHING) for heights in drives]
        for which, name in enumerate(("clip", "drive.clip")):
            margin, used = _fitted(kind, along, coverage, clip, which)
            tables[which][kind], tops[f"{name}.{kind}"] = margin, used.of(kind, 0.0)
    steps = sum(max(map(len, heights.values()), default=0) for heights in drives)
    reported = {name: value for name, value in tops.items() if isfinite(value)}
    made = MarginCalibration(tables[0], coverage, steps, date, model_fingerprint, constants=reported, drive=tables[1])
    return replace(made, drives=len(drives), origin=origin)


def _fitted(
    kind: str, along: Sequence[FloatArray], coverage: float, clip: ErrorClip, which: int
) -> tuple[float, ErrorClip]:
    """The margin of a step (0) or a whole drive (1), and the ceiling below which its errors were counted."""

    for _ in range(_DOUBLINGS):
        if sum(len(clip.errors(kind, heights)) > 0 for heights in along) >= min(_NEAR, len(along)):
            break
        clip = clip.doubled(kind)

    def margin(chosen: ErrorClip) -> float:
        errors = [chosen.errors(kind, heights) for heights in along]
        return max(0.0, margins_over_drives([near if len(near) else (0.0,) for near in errors], coverage)[which])

    return clip.fitting(kind, margin)


def covered_shares(drives: Drives, kind: str, epsilon: float, clip: ErrorClip = NO_CLIP) -> FloatArray:
    """(drives,) what share of a drive's steps near a boundary a margin covers; 1 where nothing came near."""
    errors = [clip.errors(kind, heights.get(kind, _NOTHING), epsilon) for heights in drives]
    return np.array([float((near <= epsilon).mean()) if len(near) else 1.0 for near in errors])


class DriveTick(NamedTuple):
    """A state, and the latent that the filter had for it."""

    state: StateMessage
    latent: LatentMessage | None


def barrier_residuals(
    model: PhysicsModel, settings: FilterSettings, ticks: Sequence[DriveTick]
) -> dict[str, FloatArray]:
    """By kind of barrier (steps, 4): the least h, predicted by the barriers of then and measured; see ``HSample``.

    ``ticks`` of one start of one robot, in order. Steps whose action was not the filter's, whose latent is not known,
    or whose state makes no scene are left out. ``Ceiling.errors`` makes errors of them.
    """
    own = fingerprint(model)
    held = CalibratedModel(model, own, uncalibrated(settings, own))
    memory = RobotSession.begun(held, settings, period=ticks[0].state.period if ticks else None)
    memory.margin.learns = False
    found: dict[str, list[HSample]] = {}
    for index, tick in enumerate(ticks):
        memory.observe_state(tick.state)
        for kind, seen in memory.margin.seen.items():
            if np.isfinite(seen).all():
                found.setdefault(kind, []).append(seen)
        following = ticks[index + 1].state if index + 1 < len(ticks) else None
        _go_on(memory, tick, following)
    return {kind: np.array(rows) for kind, rows in found.items()}


def _go_on(memory: RobotSession, tick: DriveTick, following: StateMessage | None) -> None:
    """What the filter would expect of the next state under the action that was taken."""
    state = tick.state
    given = tick.latent if tick.latent is not None else Stale(LATENT, -1)
    latent, problems = memory.usable_latent(state, {LATENT: given})
    obeyed = following is not None and following.tick == state.tick + 1 and following.applied_by == "filter"
    if problems or isinstance(memory.barriers, str) or not obeyed or following is None:
        memory.margin.expect(None)
        return
    verdict = replace(resting_verdict(np.array(following.applied), "recorded"), status=Status.passed)
    memory.decision = LastDecision(state, latent, verdict)
    memory.predict_states(state, verdict, latent)
