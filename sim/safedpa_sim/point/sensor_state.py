"""The point robot's 15 sensor readings as a state, and their conversion to the filter's state.

    accelerometer 3 [m/s2], velocimeter 3 [m/s], gyro 3 [rad/s], magnetometer 3, compass of the goal 2, its distance [m]

all in the robot frame, at its hinge. Together with a latent of two entries they are the 17 inputs in one interpretation
of the paper, which does not define its inputs. The goal's position in the world is known, so the readings determine the
filter's state. With m the magnetometer, v the velocimeter, r the yaw rate, p = compass (distance + 1 mm), R the
rotation by the yaw, c the distance of the centre of mass ahead of the hinge:

    yaw = atan2(-m_x, -m_y),  position = goal - R p + R (c, 0),  velocity = R (v + (0, c r))
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.networks import Frame
from safedpa.operations import Operations, Scalar
from safedpa_sim.point.body import POINT_BODY
from safedpa_sim.point.observation import GOAL_OFFSET, goal_seen
from safedpa_sim.point.simulation import PointSimulation

GROUPS: Final = {
    "accelerometer": slice(0, 3),
    "velocimeter": slice(3, 6),
    "gyro": slice(6, 9),
    "magnetometer": slice(9, 12),
    "compass": slice(12, 14),
    "distance": slice(14, 15),
}
"""The entries of each sensor."""
ENTRIES: Final = (
    *(f"{sensor}_{axis}" for sensor in tuple(GROUPS)[:4] for axis in "xyz"),
    "compass_ahead",
    "compass_left",
    "distance",
)
_AHEAD, _LEFT, _RATE, _NORTH, _COMPASS, _DISTANCE = 3, 4, 8, slice(9, 11), slice(12, 14), 14


def _as_they_are(state: Sequence[Scalar], operations: Operations) -> list[Scalar]:
    del operations
    return list(state)


SENSED_FRAME: Final = Frame(ENTRIES, _as_they_are, None, None)
"""The networks' frame: entries are used unchanged, because the sensors already are in the robot frame."""


def sensed(simulation: PointSimulation, control: FloatArray, goal: FloatArray) -> FloatArray:
    """Returns readings (robots, 15) for goals (robots, 2); the accelerometer measures the current ``control``."""
    return np.concatenate((simulation.sensors(control).T, goal_seen(simulation.pose, goal)), axis=1)


def without_goal(seen: FloatArray) -> FloatArray:
    """Returns the readings with the goal entries set to 0, because a new goal is not a motion of the robot."""
    retained = seen.copy()
    retained[..., _COMPASS] = retained[..., _DISTANCE] = 0.0
    return retained


def decode_state(seen: FloatArray, goal: FloatArray) -> FloatArray:
    """Converts readings (..., 15) with goals (..., 2) to filter states (..., 5), with the yaw in [-pi, pi]."""
    yaw, ahead, left, towards = _parts(seen)
    cosine, sine = np.cos(yaw), np.sin(yaw)
    behind, aside = POINT_BODY.centre_ahead - towards[..., 0], -towards[..., 1]
    return np.stack(
        (
            goal[..., 0] + cosine * behind - sine * aside,
            goal[..., 1] + sine * behind + cosine * aside,
            yaw,
            cosine * ahead - sine * left,
            sine * ahead + cosine * left,
        ),
        axis=-1,
    )


def decoding_jacobian(seen: FloatArray) -> FloatArray:
    """Returns the Jacobian of ``decode_state`` with respect to the readings, (..., 5, 15); independent of the goal."""
    yaw, ahead, left, towards = _parts(seen)
    cosine, sine = np.cos(yaw), np.sin(yaw)
    behind, aside = POINT_BODY.centre_ahead - towards[..., 0], -towards[..., 1]
    jacobian = np.zeros((*seen.shape[:-1], 5, seen.shape[-1]))
    along = np.stack((cosine, sine), axis=-1)
    across = np.stack((-sine, cosine), axis=-1)
    north = seen[..., _NORTH]
    turned = np.stack((north[..., 1], -north[..., 0]), axis=-1) / np.sum(north**2, axis=-1, keepdims=True)
    jacobian[..., 2, _NORTH] = turned
    of_position = behind[..., np.newaxis] * across - aside[..., np.newaxis] * along
    of_velocity = ahead[..., np.newaxis] * across - left[..., np.newaxis] * along
    jacobian[..., :2, _NORTH] = of_position[..., np.newaxis] * turned[..., np.newaxis, :]
    jacobian[..., 3:, _NORTH] = of_velocity[..., np.newaxis] * turned[..., np.newaxis, :]
    jacobian[..., 3:, _AHEAD], jacobian[..., 3:, _LEFT] = along, across
    jacobian[..., 3:, _RATE] = POINT_BODY.centre_ahead * across
    compass, reach = seen[..., _COMPASS], seen[..., _DISTANCE, np.newaxis] + GOAL_OFFSET
    jacobian[..., :2, 12], jacobian[..., :2, 13] = -reach * along, -reach * across
    jacobian[..., :2, _DISTANCE] = -(compass[..., :1] * along + compass[..., 1:] * across)
    return jacobian


def _parts(seen: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Returns yaw, the centre of mass's speed along and across, and the goal relative to the hinge (..., 2)."""
    yaw = np.arctan2(-seen[..., 9], -seen[..., 10])
    left = seen[..., _LEFT] + POINT_BODY.centre_ahead * seen[..., _RATE]
    towards = seen[..., _COMPASS] * (seen[..., _DISTANCE, np.newaxis] + GOAL_OFFSET)
    return yaw, seen[..., _AHEAD], left, towards
