"""The safety filter before many simulated point robots: ``BatchFilter`` with the stopping manoeuvre's barriers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.robots.point.system import POINT
from safedpa.safety.batch import STATUSES, BatchFilter
from safedpa.safety.many_stopping import ManyStopping
from safedpa.safety.shipped import settings_named
from safedpa.safety.stopping_barrier import Motion, StoppingBarrier, stopping_action
from safedpa.safety.verdict import Status
from safedpa_sim.point.belief import Believed
from safedpa_sim.point.layout import HAZARD_RADIUS

__all__ = ["ETA", "Filtered", "PointFilter", "around_hazards", "least_room"]

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

ETA: Final = 0.5
"""Of the simulated robots' filter; that of the robot on the bus keeps more room: it has more to allow for."""
_PLAIN: Final = [STATUSES.index(status) for status in (Status.passed, Status.corrected)]


@final
@dataclass(frozen=True)
class Filtered:
    """Actions (robots, 2) in [-1, 1], where they are not the wish, and where not every condition could be kept."""

    action: Floats
    corrected: Flags
    relaxed: Flags


@final
class PointFilter:
    """``epsilon`` [m] is the margin. Actions lie in [-1, 1], as ``Believed`` has them."""

    def __init__(self, epsilon: float) -> None:
        settings = settings_named("point")
        own = replace(settings, eta=ETA, epsilon={"obstacle": epsilon}, action_low=(-1.0, -1.0), action_high=(1.0, 1.0))
        self._filter = BatchFilter(POINT, own)

    def decide(self, state: Floats, wish: Floats, hazards: Floats, believed: Believed) -> Filtered:
        """Safe actions for states (robots, 5) and wishes (robots, 2) among hazards (robots, m, 2)."""
        around = around_hazards(hazards, believed.motion)

        def stopping(robot: int) -> Floats:
            motion = believed.motion.of(robot)
            end = StoppingBarrier(around.hazards[robot], motion).best_end(state[robot])
            thrust, turn = stopping_action(state[robot].reshape(5, 1), motion, np.array([end]))
            return np.array([thrust[0], turn[0]]) / believed.scale

        affine = believed.drift, believed.gain
        found = self._filter.decide(state, wish, barriers=around, affine=affine, backup=stopping)
        changed = np.any(found.action != wish, axis=1)
        return Filtered(found.action, changed, ~np.isin(found.status, _PLAIN))


def around_hazards(hazards: Floats, motion: Motion) -> ManyStopping:
    """The barriers of robots among hazards (robots, m, 2)."""
    radii = np.full((*hazards.shape[:2], 1), HAZARD_RADIUS)
    return ManyStopping(np.concatenate((hazards, radii), axis=2), motion)


def least_room(state: Floats, hazards: Floats, motion: Motion) -> Floats:
    """min over hazards (n, m, 2) of h (n,) [m] at states (n, 5) by what ``motion`` believes."""
    least: Floats = around_hazards(hazards, motion).values(state).min(axis=1)
    return least
