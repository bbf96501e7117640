"""The force of one axle's tyres on the floor."""

from __future__ import annotations

from math import sqrt

__all__ = ["axle_force"]


def axle_force(
    rolling: float, sideways: float, drive: float, limit: float, slip_scale: float, slip_speed: float
) -> tuple[float, float]:
    """Longitudinal and lateral force [N] on an axle, in the frame of its wheels.

    F_x = clip(drive, +-limit), F_y = -sqrt(limit^2 - F_x^2) s / sqrt(1 + s^2),
    s = sideways / (slip_scale (|rolling| + slip_speed)):
    a tyre of cornering stiffness limit / slip_scale that saturates on the friction circle of radius ``limit`` [N].
    ``rolling`` and ``sideways`` [m/s] are the velocity of the axle's middle along and across its wheels. Source: the
    combined-slip friction circle, Rajamani, Vehicle Dynamics and Control, 2nd ed., ch. 13, with a smooth saturation.
    """
    along = -limit if drive < -limit else limit if drive > limit else drive
    slip = sideways / (slip_scale * (abs(rolling) + slip_speed))
    return along, -sqrt(limit * limit - along * along) * slip / sqrt(1.0 + slip * slip)
