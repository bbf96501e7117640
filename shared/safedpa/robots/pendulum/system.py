"""The system of the inverted pendulum with a motor."""

from __future__ import annotations

from math import inf

from safedpa.systems.system import System, Variable

PENDULUM = System(
    name="pendulum",
    state=(Variable("angle", "rad", -inf, inf, angle=True), Variable("rate", "rad/s", -100.0, 100.0)),
    action=(Variable("torque", "N m", -50.0, 50.0),),
)
"""Angle 0 is upright, counted counter-clockwise; torque acts in the direction of the angle."""
