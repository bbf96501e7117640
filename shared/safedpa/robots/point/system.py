"""The system of the point robot: a small body on slides with a thruster along its heading and a turn servo."""

from __future__ import annotations

from math import inf

from safedpa.systems.system import System, Variable

POINT = System(
    name="point",
    state=(
        Variable("x", "m", -1e4, 1e4),
        Variable("y", "m", -1e4, 1e4),
        Variable("yaw", "rad", -inf, inf, angle=True),
        Variable("vx", "m/s", -50.0, 50.0),
        Variable("vy", "m/s", -50.0, 50.0),
    ),
    action=(Variable("thrust", "N", -10.0, 10.0), Variable("turn", "rad/s", -10.0, 10.0)),
)
"""Velocity in the world frame; the thrust acts along the heading, the turn rate is commanded."""
