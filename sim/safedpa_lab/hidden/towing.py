"""The pymunk car with a load hitched, driven about an empty field: rigid bodies, tyres, a drawbar."""

from __future__ import annotations

from math import atan, atan2, cos, hypot, sin

import numpy as np

from safedpa_lab.hidden.excitation import reference
from safedpa_lab.hidden.lanes import Floats
from safedpa_sim.robots.loads import load_named
from safedpa_sim.robots.world import CarWorld

__all__ = ["drive_in", "drive_towing"]

_FIELD = (-200.0, 200.0, -200.0, 200.0)
_LATERAL = 2.5
"""m/s2; faster curves would throw the load about."""
_STEER = 0.3
"""rad"""


def drive_towing(load: str, random: np.random.Generator, rows: int, period: float) -> tuple[Floats, Floats]:
    """States (rows, 4) and actions (rows, 2) of one run, forwards only: a load that is pushed back folds up."""
    return drive_in(
        CarWorld((0.0, 0.0, float(random.uniform(-3.0, 3.0))), _FIELD, (), load_named(load)), random, rows, period
    )


def drive_in(world: CarWorld, random: np.random.Generator, rows: int, period: float) -> tuple[Floats, Floats]:
    """The same in a world that there is: states (rows, 4) and actions (rows, 2)."""
    speeds = reference(random, rows, period, (0.0, 2.0), 1.5, (0.8, 3.0))
    steers = reference(random, rows, period, (-_STEER, _STEER), 2 * _STEER, (0.6, 2.0))
    states, actions = np.empty((rows, 4)), np.empty((rows, 2))
    for row in range(rows):
        states[row] = world.state
        actions[row] = speeds[row], _steer(float(steers[row]), *world.state)
        world.advance(float(actions[row, 0]), float(actions[row, 1]), period)
    return states, actions


def _steer(wanted: float, x: float, y: float, yaw: float, speed: float) -> float:
    """The plan's steer, back to the middle from far out, wider when fast."""
    home = atan2(-y, -x) - yaw
    home = atan2(sin(home), cos(home))
    if hypot(x, y) > 6.0 and abs(home) > 0.6:
        wanted = max(-_STEER, min(_STEER, 1.5 * home))
    most = atan(_LATERAL * 0.32 / max(speed * speed, 0.1))
    return max(-most, min(most, wanted))
