"""The system of the differential drive: two driven wheels on one axle, commanded by speed and turn rate."""

from __future__ import annotations

from math import inf

from safedpa.systems.system import System, Variable

TRACK = 0.233
"""m between the wheels; default of the models."""

DIFFERENTIAL_DRIVE = System(
    name="differential_drive",
    state=(
        Variable("x", "m", -1e4, 1e4),
        Variable("y", "m", -1e4, 1e4),
        Variable("yaw", "rad", -inf, inf, angle=True),
        Variable("speed", "m/s", -10.0, 10.0),
        Variable("turn_rate", "rad/s", -30.0, 30.0),
    ),
    action=(Variable("target_speed", "m/s", -5.0, 5.0), Variable("target_turn_rate", "rad/s", -20.0, 20.0)),
)
"""Position of the axle's centre; speed along the heading."""
