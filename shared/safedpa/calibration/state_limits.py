"""Limits of a plausible state from healthy drives, which the filter's own session replays."""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan

from safedpa.calibration.from_drives import DriveTick, continue_session
from safedpa.dynamics import PhysicsModel, fingerprint
from safedpa.runtime.calibrated_model import CalibratedModel, uncalibrated
from safedpa.runtime.robot_session import RobotSession
from safedpa.safety.session.plausibility import CREEPING_FACTOR
from safedpa.safety.session.state_limits import Evidence, StateLimits
from safedpa.safety.settings import FilterSettings

__all__ = ["only_answers", "state_evidence"]


def only_answers(evidence: Evidence) -> Evidence:
    """The part of the evidence that needs no exact prediction over one period: what the commands should have caused."""
    ways = {unit: (0.0, way) for unit, (_, way) in evidence.drift.items()}
    return Evidence(dict.fromkeys(evidence.jump, 0.0), ways, evidence.unanswered)


def state_evidence(model: PhysicsModel, settings: FilterSettings, ticks: Sequence[DriveTick]) -> list[Evidence]:
    """What each state of a drive shows against the prediction from the one before.

    ``ticks`` are those of one start of one robot, in order; states may be lost (NaN) or missing. What the first state
    after a lost one shows is no jump over one period. ``limits_from_evidence`` turns the rows of several drives into
    limits.
    """
    own = fingerprint(model)
    held = CalibratedModel(model, own, uncalibrated(settings, own))
    # Limits without an entry refuse nothing, but the states are compared.
    session = RobotSession.create(held, settings, period=ticks[0].state.period if ticks else None, limits=StateLimits())
    session.margin.learns = False
    found = []
    for index, tick in enumerate(ticks):
        session.observe_state(tick.state)
        before = ticks[index - 1].state if index else None
        whole = before is not None and before.tick == tick.state.tick - 1 and not isnan(sum(before.values))
        if session.evidence is not None:
            share = 1.0 if before is None or before.values == tick.state.values else 1.0 / CREEPING_FACTOR
            shown = {unit: share * size for unit, size in session.evidence.unanswered.items()}
            evidence = session.evidence._replace(unanswered=shown)
            found.append(evidence if whole else only_answers(evidence))
        following = ticks[index + 1].state if index + 1 < len(ticks) else None
        continue_session(session, tick, following)
    return found
