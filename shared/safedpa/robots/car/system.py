"""The car: a small four-wheeled robot with front steering, seen from above."""

from __future__ import annotations

from math import inf

from safedpa.systems.system import System, Variable

_STATE = (
    Variable("x", "m", -1e4, 1e4),
    Variable("y", "m", -1e4, 1e4),
    Variable("yaw", "rad", -inf, inf, angle=True),
    Variable("speed", "m/s", -30.0, 30.0),
)
_STEER = Variable("steer", "rad", -0.6, 0.6)

CAR = System(name="car", state=_STATE, action=(Variable("target_speed", "m/s", -8.0, 8.0), _STEER))
"""A car with a speed servo. State: position of the rear axle's centre, heading, forward speed."""

CAR_THROTTLE = System(name="car", state=_STATE, action=(Variable("throttle", "1", -1.0, 1.0), _STEER))
"""The same car commanded by a throttle from -1 to 1."""
