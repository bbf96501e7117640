"""Batched simulation of point robots in NumPy, with MuJoCo's equations for this body.

With q = (x, y, yaw), centre of mass c ahead of the hinge, mass m, inertia I about the hinge:

    M(q) = [[m, 0, -m c sin], [0, m, m c cos], [-m c sin, m c cos, I]]
    force = thrust (cos, sin, 0) + wind at the centre of mass + torque - damping v + m c rate^2 (cos, sin, 0)
    (M - dt dforce/dv) a = force,  v += dt a,  q += dt v

This is MuJoCo's integrator ``implicitfast``: dforce/dv is diagonal, with the dampings and the turning servo unless it
saturates. Tests compare the result with MuJoCo.

The filter's state is that of the centre of mass, ``centre_ahead`` in front of the hinge. With r the yaw rate and n =
(-sin, cos):

    x_centre = x_hinge + c (cos, sin),    v_centre = v_hinge + c r n

The yaw rate is not part of it, because the servo follows its command within a few milliseconds; functions that need it
take it separately.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa_sim.point.body import CONTROL_SECONDS, POINT_BODY, SUBSTEPS, PointBody

_GRAVITY = 9.81
_MAGNETIC = -0.5
"""MuJoCo's magnetic field points along negative y of the world."""


class PointSimulation:
    """``count`` bodies, each in its own wind; in all arrays the robot is the last axis."""

    def __init__(self, count: int, body: PointBody = POINT_BODY) -> None:
        self.body = body
        self.pose = np.zeros((3, count))
        """x, y [m], yaw [rad], not wrapped."""
        self.velocity = np.zeros((3, count))
        """vx, vy [m/s] in the world, yaw rate [rad/s]."""
        self.force = np.zeros((2, count))
        """Force of the wind in the world frame [N]."""
        self.extra_damping = np.zeros(count)
        """Additional damping of the slides [N s/m], unknown to the models."""
        self.strength = np.ones(count)
        """Factor on the thrust, for weakened motors."""

    def advance(self, control: FloatArray) -> None:
        """Simulates one step of the task under (thrust, turn) controls (2, count), clipped to [-1, 1]."""
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
        """Returns the mean acceleration (3, count) over an implicit step of ``seconds``; with 0 the current one."""
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
        """Returns the current accelerometer, velocimeter, gyro and magnetometer (12, count) under the controls."""
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
    """Rotates a vector from the world to the body frame."""
    return cosine * vector[0] + sine * vector[1], cosine * vector[1] - sine * vector[0]


LARGEST_TURN: Final = POINT_BODY.largest_turn
"""rad/s; commands above saturate."""
_TURN_OF_CONTROL: Final = (
    POINT_BODY.servo_gain * POINT_BODY.gear / (POINT_BODY.servo_gain * POINT_BODY.gear**2 + POINT_BODY.hinge_damping)
)
"""Steady-state yaw rate [rad/s] per unit of servo control."""


def centre_state(simulation: PointSimulation) -> FloatArray:
    """Returns the current states (robots, 5): x, y of the centre of mass, yaw, and its velocity in the world."""
    ahead = simulation.body.centre_ahead
    x, y, yaw = simulation.pose
    cosine, sine = np.cos(yaw), np.sin(yaw)
    swing = ahead * simulation.velocity[2]
    return np.stack(
        (
            x + ahead * cosine,
            y + ahead * sine,
            yaw,
            simulation.velocity[0] - swing * sine,
            simulation.velocity[1] + swing * cosine,
        ),
        axis=1,
    )


def put_state(simulation: PointSimulation, state: FloatArray, rate: FloatArray) -> None:
    """Sets all robots to states (robots, 5), turning at ``rate`` (robots,) [rad/s]: the inverse of ``centre_state``."""
    ahead = simulation.body.centre_ahead
    cosine, sine = np.cos(state[:, 2]), np.sin(state[:, 2])
    simulation.pose[:] = state[:, 0] - ahead * cosine, state[:, 1] - ahead * sine, state[:, 2]
    swing = ahead * rate
    simulation.velocity[:] = state[:, 3] + swing * sine, state[:, 4] - swing * cosine, rate


def controls_of(action: FloatArray) -> FloatArray:
    """Converts actions (robots, 2), thrust [N] and turn rate [rad/s], to motor controls (2, robots)."""
    controls: FloatArray = np.stack((action[:, 0] / POINT_BODY.gear, action[:, 1] / _TURN_OF_CONTROL))
    return controls


def actions_of(controls: FloatArray) -> FloatArray:
    """Converts motor controls (2, robots) to actions (robots, 2), thrust [N] and turn rate [rad/s], with saturation."""
    limit = POINT_BODY.force_limit
    thrust = POINT_BODY.gear * np.clip(controls[0], -limit, limit)
    turn = np.clip(_TURN_OF_CONTROL * np.clip(controls[1], -1.0, 1.0), -LARGEST_TURN, LARGEST_TURN)
    return np.stack((thrust, turn), axis=1)


def after_one_period(
    state: FloatArray,
    action: FloatArray,
    rate: FloatArray,
    wind: FloatArray,
    drag: FloatArray | float = 0.0,
    gain: FloatArray | float = 1.0,
) -> tuple[FloatArray, FloatArray]:
    """Returns states (robots, 5) and yaw rates (robots,) one period later, under thrust [N] and turn rate [rad/s].

    ``wind`` (robots, 2) is force over mass [m/s2], ``drag`` deceleration over velocity [1/s] in addition to the body's
    own, and ``gain`` a factor on the thrust.
    """
    simulation = PointSimulation(len(state))
    put_state(simulation, state, rate)
    simulation.force[:] = simulation.body.mass * wind.T
    simulation.extra_damping[:] = simulation.body.mass * np.asarray(drag)
    simulation.strength[:] = gain
    simulation.advance(controls_of(action))
    return centre_state(simulation), simulation.velocity[2].copy()
