"""The safety filter for batches of point robots: ``BatchFilter`` with the barriers of the stopping manoeuvre."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np

from safedpa.arrays import BoolArray, FloatArray
from safedpa.robots.point.system import POINT
from safedpa.safety.barriers.stopping import Motion, StoppingBarrier, stopping_action
from safedpa.safety.batch.barriers import BatchStopping
from safedpa.safety.batch.filter import STATUSES, BatchFilter
from safedpa.safety.defaults import settings_named
from safedpa.safety.verdict import Status
from safedpa_sim.point.layout import HAZARD_RADIUS
from safedpa_sim.point.point_model import PointPrediction

ETA: Final = 0.5
"""eta of the filter in simulation; the robot on the bus uses a more conservative value."""
_PLAIN: Final = [STATUSES.index(status) for status in (Status.passed, Status.corrected)]


@final
@dataclass(frozen=True)
class FilteredActions:
    """Filtered actions (robots, 2) in [-1, 1], and for each robot whether the action was corrected, and whether a
    constraint was relaxed because not all could be satisfied."""

    action: FloatArray
    corrected: BoolArray
    relaxed: BoolArray


@final
class PointFilter:
    """The batched filter with margin ``epsilon`` [m]; actions are in [-1, 1], as in ``PointPrediction``."""

    def __init__(self, epsilon: float) -> None:
        settings = settings_named("point")
        own = replace(settings, eta=ETA, epsilon={"obstacle": epsilon}, action_low=(-1.0, -1.0), action_high=(1.0, 1.0))
        self._filter = BatchFilter(POINT, own)

    def decide(
        self, state: FloatArray, nominal: FloatArray, hazards: FloatArray, believed: PointPrediction
    ) -> FilteredActions:
        """Returns safe actions for states (robots, 5) and nominal actions (robots, 2) among hazards (robots, m, 2)."""
        around = around_hazards(hazards, believed.motion)

        def stopping(robot: int) -> FloatArray:
            motion = believed.motion.of(robot)
            end = StoppingBarrier(around.hazards[robot], motion).best_end(state[robot])
            thrust, turn = stopping_action(state[robot].reshape(5, 1), motion, np.array([end]))
            return np.array([thrust[0], turn[0]]) / believed.scale

        affine = believed.drift, believed.gain
        found = self._filter.decide(state, nominal, barriers=around, affine=affine, backup=stopping)
        changed = np.any(found.action != nominal, axis=1)
        return FilteredActions(found.action, changed, ~np.isin(found.status, _PLAIN))


def around_hazards(hazards: FloatArray, motion: Motion) -> BatchStopping:
    """Returns the barriers of robots among hazards (robots, m, 2)."""
    radii = np.full((*hazards.shape[:2], 1), HAZARD_RADIUS)
    return BatchStopping(np.concatenate((hazards, radii), axis=2), motion)


def minimum_barrier(state: FloatArray, hazards: FloatArray, motion: Motion) -> FloatArray:
    """Returns the minimum of h over hazards (n, m, 2), shape (n,) [m], at states (n, 5) for the modelled ``motion``."""
    least: FloatArray = around_hazards(hazards, motion).h(state).min(axis=1)
    return least
