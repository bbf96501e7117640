"""Single periods of the body itself, for the state that filter and networks know: centre of mass, yaw, velocity.

The centre of mass lies ``centre_ahead`` before the hinge. With c that distance, r the yaw rate, n = (-sin, cos):

    x_centre = x_hinge + c (cos, sin),    v_centre = v_hinge + c r n

The rate is no part of the state: the servo follows the command within a few milliseconds. What it was is a memory.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa_sim.point.body import POINT_BODY
from safedpa_sim.point.simulation import PointSimulation

__all__ = ["LARGEST_TURN", "actions_of", "after_one_period", "centre_state", "controls_of", "put_state"]


LARGEST_TURN: Final = POINT_BODY.largest_turn
"""rad/s; faster commands turn no faster."""
_TURN_OF_CONTROL: Final = (
    POINT_BODY.servo_gain * POINT_BODY.gear / (POINT_BODY.servo_gain * POINT_BODY.gear**2 + POINT_BODY.hinge_damping)
)
"""rad/s that the servo settles at for the control 1."""


def centre_state(simulation: PointSimulation) -> FloatArray:
    """(robots, 5): x, y of the centre of mass, yaw, and its velocity in the world, of the robots as they are."""
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
    """Controls (2, robots) of the body's motors for actions (robots, 2): thrust [N], turn [rad/s]."""
    controls: FloatArray = np.stack((action[:, 0] / POINT_BODY.gear, action[:, 1] / _TURN_OF_CONTROL))
    return controls


def actions_of(controls: FloatArray) -> FloatArray:
    """Actions (robots, 2), thrust [N] and turn [rad/s], that controls (2, robots) of the motors come to: what lies
    beyond their limits pushes no harder and turns no faster."""
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
    """States (robots, 5) and yaw rates (robots,) one period later, under actions thrust [N] and turn [rad/s].

    ``wind`` (robots, 2): its force over the mass [m/s2]; ``drag``: deceleration over velocity [1/s] on top of the
    body's own; ``gain``: factor on the thrust.
    """
    simulation = PointSimulation(len(state))
    put_state(simulation, state, rate)
    simulation.force[:] = simulation.body.mass * wind.T
    simulation.extra_damping[:] = simulation.body.mass * np.asarray(drag)
    simulation.strength[:] = gain
    simulation.advance(controls_of(action))
    return centre_state(simulation), simulation.velocity[2].copy()
