"""Many point robots at once, in numpy: MuJoCo's own arithmetic for this one body, for training.

With q = (x, y, yaw), centre of mass c ahead of the hinge, mass m, inertia I about the hinge:

    M(q) = [[m, 0, -m c sin], [0, m, m c cos], [-m c sin, m c cos, I]]
    force = thrust (cos, sin, 0) + wind at the centre of mass + torque - damping v + m c rate^2 (cos, sin, 0)
    (M - dt dforce/dv) a = force,  v += dt a,  q += dt v

which is the integrator ``implicitfast``: dforce/dv is diagonal, the dampings and, while it is not at its limit, the
turning servo. Tests hold it against MuJoCo.
"""

from __future__ import annotations

import numpy as np

from safedpa.arrays import FloatArray
from safedpa_sim.point.body import CONTROL_SECONDS, POINT_BODY, SUBSTEPS, PointBody

__all__ = ["PointSimulation"]


_GRAVITY = 9.81
_MAGNETIC = -0.5
"""MuJoCo's magnetic field points along negative y of the world."""


class PointSimulation:
    """``count`` bodies, each in a wind of its own; all arrays have the robot as last axis."""

    def __init__(self, count: int, body: PointBody = POINT_BODY) -> None:
        self.body = body
        self.pose = np.zeros((3, count))
        """x, y [m], yaw [rad], turns counted."""
        self.velocity = np.zeros((3, count))
        """vx, vy [m/s] in the world, yaw rate [rad/s]."""
        self.force = np.zeros((2, count))
        """N, of the wind in the world."""
        self.extra_damping = np.zeros(count)
        """N s/m on top of the slides': a drag that no one told of."""
        self.strength = np.ones(count)
        """Factor on the thrust: a motor that weakens."""

    def advance(self, control: FloatArray) -> None:
        """Holds (thrust, turn) controls (2, count), each cut to [-1, 1], for one step of the task."""
        control = np.clip(control, -1.0, 1.0)
        limit = self.body.force_limit
        thrust = self.strength * self.body.gear * np.clip(control[0], -limit, limit)
        for _ in range(SUBSTEPS):
            acceleration = self.acceleration(thrust, control[1])
            self.velocity += CONTROL_SECONDS / SUBSTEPS * acceleration
            self.pose += CONTROL_SECONDS / SUBSTEPS * self.velocity

    def acceleration(
        self, thrust: FloatArray, turn: FloatArray, seconds: float = CONTROL_SECONDS / SUBSTEPS
    ) -> FloatArray:
        """(3, count) mean acceleration over an implicit step of ``seconds``; 0: of this moment."""
        body = self.body
        cosine, sine = np.cos(self.pose[2]), np.sin(self.pose[2])
        rate = self.velocity[2]
        lever = body.mass * body.centre_ahead
        outward = thrust + lever * rate * rate
        slide = body.slide_damping + self.extra_damping
        along_x = outward * cosine + self.force[0] - slide * self.velocity[0]
        along_y = outward * sine + self.force[1] - slide * self.velocity[1]
        wanted = body.servo_gain * (turn - body.gear * rate)
        free = np.abs(wanted) < body.force_limit
        torque = body.gear * np.clip(wanted, -body.force_limit, body.force_limit) - body.hinge_damping * rate
        torque += body.centre_ahead * (cosine * self.force[1] - sine * self.force[0])
        mass = body.mass + seconds * slide
        stiff = body.hinge_damping + np.where(free, body.servo_gain * body.gear**2, 0.0)
        inertia = body.hinge_inertia + seconds * stiff - lever * lever / mass
        turning = (torque - lever / mass * (cosine * along_y - sine * along_x)) / inertia
        return np.stack(
            ((along_x + lever * sine * turning) / mass, (along_y - lever * cosine * turning) / mass, turning)
        )

    def sensors(self, control: FloatArray) -> FloatArray:
        """(12, count): accelerometer, velocimeter, gyro, magnetometer, of this moment under (thrust, turn) controls."""
        limit = self.body.force_limit
        control = np.clip(control, -1.0, 1.0)
        thrust = self.strength * self.body.gear * np.clip(control[0], -limit, limit)
        acceleration = self.acceleration(thrust, control[1], 0.0)
        cosine, sine = np.cos(self.pose[2]), np.sin(self.pose[2])
        nothing = np.zeros_like(cosine)
        return np.stack(
            (
                *_turned(acceleration, cosine, sine),
                nothing + _GRAVITY,
                *_turned(self.velocity, cosine, sine),
                nothing,
                nothing,
                nothing,
                self.velocity[2],
                _MAGNETIC * sine,
                _MAGNETIC * cosine,
                nothing,
            )
        )


def _turned(vector: FloatArray, cosine: FloatArray, sine: FloatArray) -> tuple[FloatArray, FloatArray]:
    """World to body."""
    return cosine * vector[0] + sine * vector[1], cosine * vector[1] - sine * vector[0]
