"""The point robot's state as its sensors have it: 15 numbers, and what of the world they tell.

    accelerometer 3 [m/s2], velocimeter 3 [m/s], gyro 3 [rad/s], magnetometer 3, compass of the goal 2, its distance [m]

all in the robot's own frame, of its hinge. With a latent of two entries these are the 17 numbers of one reading of the
paper, which defines its own nowhere. Where the goal lies in the world is known, so nothing of the filter's state is
lost: with m the magnetometer, v the velocimeter, r the yaw rate, p = compass (distance + 1 mm), R the turn by the yaw,
c how far the centre of mass lies ahead of the hinge:

    yaw = atan2(-m_x, -m_y),  place = goal - R p + R (c, 0),  velocity = R (v + (0, c r))
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

__all__ = ["ENTRIES", "GROUPS", "SENSED_FRAME", "decode_state", "decoding_slopes", "sensed", "without_goal"]


GROUPS: Final = {
    "accelerometer": slice(0, 3),
    "velocimeter": slice(3, 6),
    "gyro": slice(6, 9),
    "magnetometer": slice(9, 12),
    "compass": slice(12, 14),
    "distance": slice(14, 15),
}
"""Which entries are whose."""
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
"""Networks see every entry as it is and tell its change: sensors are in the robot's own frame already."""


def sensed(simulation: PointSimulation, control: FloatArray, goal: FloatArray) -> FloatArray:
    """(robots, 15) with goals (robots, 2); ``control`` (2, robots) acted until now: the accelerometer feels it."""
    return np.concatenate((simulation.sensors(control).T, goal_seen(simulation.pose, goal)), axis=1)


def without_goal(seen: FloatArray) -> FloatArray:
    """The same with nothing where the goal's entries are: one that is put elsewhere is no motion of the robot."""
    retained = seen.copy()
    retained[..., _COMPASS] = retained[..., _DISTANCE] = 0.0
    return retained


def decode_state(seen: FloatArray, goal: FloatArray) -> FloatArray:
    """The filter's states (..., 5), yaw within -pi and pi, of what is sensed (..., 15) with goals (..., 2)."""
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


def decoding_slopes(seen: FloatArray) -> FloatArray:
    """d decoded / d seen, (..., 5, 15); where the goal lies makes no difference to it."""
    yaw, ahead, left, towards = _parts(seen)
    cosine, sine = np.cos(yaw), np.sin(yaw)
    behind, aside = POINT_BODY.centre_ahead - towards[..., 0], -towards[..., 1]
    slopes = np.zeros((*seen.shape[:-1], 5, seen.shape[-1]))
    along = np.stack((cosine, sine), axis=-1)
    across = np.stack((-sine, cosine), axis=-1)
    north = seen[..., _NORTH]
    turned = np.stack((north[..., 1], -north[..., 0]), axis=-1) / np.sum(north**2, axis=-1, keepdims=True)
    slopes[..., 2, _NORTH] = turned
    of_place = behind[..., np.newaxis] * across - aside[..., np.newaxis] * along
    of_velocity = ahead[..., np.newaxis] * across - left[..., np.newaxis] * along
    slopes[..., :2, _NORTH] = of_place[..., np.newaxis] * turned[..., np.newaxis, :]
    slopes[..., 3:, _NORTH] = of_velocity[..., np.newaxis] * turned[..., np.newaxis, :]
    slopes[..., 3:, _AHEAD], slopes[..., 3:, _LEFT] = along, across
    slopes[..., 3:, _RATE] = POINT_BODY.centre_ahead * across
    compass, reach = seen[..., _COMPASS], seen[..., _DISTANCE, np.newaxis] + GOAL_OFFSET
    slopes[..., :2, 12], slopes[..., :2, 13] = -reach * along, -reach * across
    slopes[..., :2, _DISTANCE] = -(compass[..., :1] * along + compass[..., 1:] * across)
    return slopes


def _parts(seen: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Yaw, the centre of mass's speed along and across, and where the goal lies from the hinge (..., 2)."""
    yaw = np.arctan2(-seen[..., 9], -seen[..., 10])
    left = seen[..., _LEFT] + POINT_BODY.centre_ahead * seen[..., _RATE]
    towards = seen[..., _COMPASS] * (seen[..., _DISTANCE, np.newaxis] + GOAL_OFFSET)
    return yaw, seen[..., _AHEAD], left, towards
