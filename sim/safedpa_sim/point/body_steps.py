"""Single periods of the simulated body in terms of the filter's state: centre of mass, yaw, velocity.

The centre of mass is ``centre_ahead`` in front of the hinge. With c this distance, r the yaw rate, n = (-sin, cos):

    x_centre = x_hinge + c (cos, sin),    v_centre = v_hinge + c r n

The yaw rate is not part of the state, because the servo follows its command within a few milliseconds; functions that
need it take it separately.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa_sim.point.body import POINT_BODY
from safedpa_sim.point.simulation import PointSimulation

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
