"""Margins from barrier residuals along drives, and their coverage on other drives.

The residuals are computed by the filter's own ``RobotSession``, for recorded and simulated drives alike. Effects of
barriers, latents and actuator states on a prediction are therefore the same in the calibration and in the online margin
monitor.
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

Drives = Sequence[Mapping[str, FloatArray]]
"""Residuals of each drive by kind of barrier, (steps, 4); see ``barrier_residuals``."""

_NOTHING = np.zeros((0, 4))
# Minimum number of drives with errors below the clip. Without any, the margin would be 0.
_NEAR = 10
_DOUBLINGS = 40
AT_REST = 0.01
"""m/s; below it a robot counts as stationary."""


def calibration_from_drives(
    drives: Drives,
    coverage: float,
    date: str,
    model_fingerprint: str,
    clip: ErrorClip = NO_CLIP,
    origin: str = "",
) -> MarginCalibration:
    """Calibrates the margins for a step near a boundary and for a whole drive.

    Errors count only below the ``clip``, which is doubled if the margin exceeds it or if too few drives came near a
    boundary. A drive that did not come near a boundary of some kind counts as a drive with error 0. Raises InputError
    for too few drives or drives without steps.
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
            tables[which][kind], tops[f"{name}.{kind}"] = margin, used.level(kind, 0.0)
    steps = sum(max(map(len, heights.values()), default=0) for heights in drives)
    reported = {name: value for name, value in tops.items() if isfinite(value)}
    made = MarginCalibration(tables[0], coverage, steps, date, model_fingerprint, constants=reported, drive=tables[1])
    return replace(made, drives=len(drives), origin=origin)


def _fitted(
    kind: str, along: Sequence[FloatArray], coverage: float, clip: ErrorClip, which: int
) -> tuple[float, ErrorClip]:
    """Returns the margin of a step (0) or a whole drive (1), and the clip that was used."""

    for _ in range(_DOUBLINGS):
        if sum(len(clip.errors(kind, heights)) > 0 for heights in along) >= min(_NEAR, len(along)):
            break
        clip = clip.doubled(kind)

    def margin(chosen: ErrorClip) -> float:
        errors = [chosen.errors(kind, heights) for heights in along]
        return max(0.0, margins_over_drives([near if len(near) else (0.0,) for near in errors], coverage)[which])

    return clip.fit_margin(kind, margin)


def covered_shares(drives: Drives, kind: str, epsilon: float, clip: ErrorClip = NO_CLIP) -> FloatArray:
    """Returns the share of each drive's steps near a boundary that a margin covers (drives,); 1 without such steps."""
    errors = [clip.errors(kind, heights.get(kind, _NOTHING), epsilon) for heights in drives]
    return np.array([float((near <= epsilon).mean()) if len(near) else 1.0 for near in errors])


class DriveTick(NamedTuple):
    """A state with the latent that the filter used."""

    state: StateMessage
    latent: LatentMessage | None


def barrier_residuals(
    model: PhysicsModel, settings: FilterSettings, ticks: Sequence[DriveTick]
) -> dict[str, FloatArray]:
    """Returns the smallest h, predicted and measured, by kind of barrier (steps, 4); see ``HSample``.

    ``ticks`` are those of one start of one robot, in order. Steps are left out if the filter did not choose the action,
    the latent is unknown, or the state has no valid scene, and if the robot rests before and after: any model predicts
    that, and such steps would make the margin that of a robot that waits. ``ErrorClip.errors`` converts the result to
    errors.
    """
    own = fingerprint(model)
    held = CalibratedModel(model, own, uncalibrated(settings, own))
    memory = RobotSession.create(held, settings, period=ticks[0].state.period if ticks else None)
    memory.margin.learns = False
    found: dict[str, list[HSample]] = {}
    rested = False
    for index, tick in enumerate(ticks):
        memory.observe_state(tick.state)
        before, rested = rested, _rests(memory, tick.state)
        for kind, seen in memory.margin.samples.items():
            if np.isfinite(seen).all():
                found.setdefault(kind, []).extend([] if before and rested else [seen])
        following = ticks[index + 1].state if index + 1 < len(ticks) else None
        continue_session(memory, tick, following)
    return {kind: np.array(rows).reshape(-1, len(HSample._fields)) for kind, rows in found.items()}


def _rests(memory: RobotSession, state: StateMessage) -> bool:
    return bool(memory.speeds) and all(abs(state.values[index]) < AT_REST for index in memory.speeds)


def continue_session(memory: RobotSession, tick: DriveTick, following: StateMessage | None) -> None:
    """Predicts the next state under the recorded action, as the filter would."""
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
