"""Limits of a plausible state from healthy drives, which the filter's own session replays."""

from __future__ import annotations

from collections.abc import Sequence

from safedpa.calibration.from_drives import DriveTick, continue_session
from safedpa.dynamics import PhysicsModel, fingerprint
from safedpa.runtime.calibrated_model import CalibratedModel, uncalibrated
from safedpa.runtime.robot_session import RobotSession
from safedpa.safety.session.state_limits import Evidence, StateLimits
from safedpa.safety.settings import FilterSettings

__all__ = ["state_evidence"]


def state_evidence(model: PhysicsModel, settings: FilterSettings, ticks: Sequence[DriveTick]) -> list[Evidence]:
    """What each state of a drive shows against the prediction from the one before.

    ``ticks`` are those of one start of one robot, in order. ``limits_from_evidence`` turns the rows of several drives
    into limits.
    """
    own = fingerprint(model)
    held = CalibratedModel(model, own, uncalibrated(settings, own))
    # Limits without an entry refuse nothing, but the states are compared.
    session = RobotSession.create(held, settings, period=ticks[0].state.period if ticks else None, limits=StateLimits())
    session.margin.learns = False
    found = []
    for index, tick in enumerate(ticks):
        session.observe_state(tick.state)
        if session.evidence is not None:
            found.append(session.evidence)
        following = ticks[index + 1].state if index + 1 < len(ticks) else None
        continue_session(session, tick, following)
    return found
