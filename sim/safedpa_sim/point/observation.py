"""Observations of the point robot.

The task's observation has the benchmark's sensors, the goal and a lidar of the hazards. The observation of the policy
pi(x, z) has motion, z, goal, hazards, lidar and the first turn of the route.

The 15 sensor readings are also used as a state,

    accelerometer 3 [m/s2], velocimeter 3 [m/s], gyro 3 [rad/s], magnetometer 3, compass of the goal 2, its distance [m]

all in the robot frame, at its hinge. Together with a latent of two entries they are the 17 inputs in one interpretation
of the paper, which does not define its inputs. The goal's position in the world is known, so the readings determine the
filter's state. With m the magnetometer, v the velocimeter, r the yaw rate, p = compass (distance + 1 mm), R the
rotation by the yaw, c the distance of the centre of mass ahead of the hinge:

    yaw = atan2(-m_x, -m_y),  position = goal - R p + R (c, 0),  velocity = R (v + (0, c r))
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.networks import Frame
from safedpa.operations import Operations, Scalar
from safedpa_sim.point.body import POINT_BODY
from safedpa_sim.point.layout import FIELD, HAZARD_RADIUS, Layout
from safedpa_sim.point.simulation import PointSimulation

_NEAREST: Final = 4
"""Number of nearest hazards that are observed individually."""
_FADING: Final = 0.3
"""m; decay length of a hazard's entry with the distance from its edge."""
_FARTHEST: Final = 1.0
"""m; larger distances are clipped."""


class ObservedTask(Protocol):
    """The part of a task that an observation reads."""

    simulation: PointSimulation
    layout: Layout


def entries_seen(latents: int) -> int:
    """Returns the number of entries of ``policy_seen``."""
    return 3 + 3 * latents + 3 + 3 * _NEAREST + LIDAR_BINS + 3


def policy_seen(task: ObservedTask, latent: NDArray[np.floating[Any]], turn: FloatArray) -> FloatArray:
    """Returns the policy's observation (robots, entries) in the robot frame, with directions as unit vectors:

        velocity and yaw rate; z cos yaw, z sin yaw, z; direction and distance of the goal; direction and
        exp(-distance to the edge / 0.3 m) of the four nearest hazards; lidar; direction and distance of the route's
        first ``turn`` (robots, 2).

    z is included rotated by the yaw because a wind acts in the world frame, while the robot pushes along its heading.
    """
    pose, velocity = task.simulation.pose, task.simulation.velocity
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    motion = (cosine * velocity[0] + sine * velocity[1], cosine * velocity[1] - sine * velocity[0], velocity[2])
    parts = (
        np.stack(motion, axis=1),
        latent * cosine[:, np.newaxis],
        latent * sine[:, np.newaxis],
        latent,
        _towards(task.layout.goal, pose),
        _nearest(task.layout.hazards, pose),
        hazard_lidar(pose, task.layout.hazards),
        _towards(turn, pose),
    )
    return np.concatenate(parts, axis=1)


def _towards(position: FloatArray, pose: FloatArray) -> FloatArray:
    seen = _own_frame(position[:, np.newaxis], pose)[:, 0]
    distance = np.linalg.norm(seen, axis=1, keepdims=True)
    parts = (seen / (distance + GOAL_OFFSET), np.minimum(distance, _FARTHEST))
    return np.concatenate(parts, axis=1)


def _nearest(hazards: FloatArray, pose: FloatArray) -> FloatArray:
    seen = _own_frame(hazards, pose)
    distance = np.linalg.norm(seen, axis=2)
    order = np.argsort(distance, axis=1)[:, :_NEAREST]
    distance = np.take_along_axis(distance, order, axis=1)[..., np.newaxis]
    direction = np.take_along_axis(seen, order[..., np.newaxis], axis=1) / (distance + GOAL_OFFSET)
    nearness = np.exp((HAZARD_RADIUS - distance) / _FADING)
    return np.concatenate((direction, nearness), axis=2).reshape(len(seen), -1)


SENSOR_ENTRIES: Final = 12
GOAL_ENTRIES: Final = 3
LIDAR_BINS: Final = 16
_LIDAR_REACH = 2.0 * FIELD
"""m; range of the lidar, beyond which hazards read 0."""
GOAL_OFFSET: Final = 0.001
"""m added to a distance to avoid a division by zero."""


def _own_frame(points: FloatArray, pose: FloatArray) -> FloatArray:
    """Converts world points (robots, points, 2) to the frames of robots with pose (3, robots): ahead, left."""
    apart = points - pose[:2].T[:, None]
    cosine, sine = np.cos(pose[2])[:, None], np.sin(pose[2])[:, None]
    ahead = cosine * apart[..., 0] + sine * apart[..., 1]
    left = cosine * apart[..., 1] - sine * apart[..., 0]
    return np.stack((ahead, left), axis=-1)


def goal_seen(pose: FloatArray, goal: FloatArray) -> FloatArray:
    """Returns (robots, 3): direction of the goal in the robot frame (unit vector) and distance [m]."""
    seen = _own_frame(goal[:, None], pose)[:, 0]
    distance = np.linalg.norm(seen, axis=1, keepdims=True)
    return np.concatenate((seen / (distance + GOAL_OFFSET), distance), axis=1)


def hazard_lidar(pose: FloatArray, hazards: FloatArray) -> FloatArray:
    """Returns (robots, 16): closeness 1 - distance / 3 m of the nearest hazard in each angular bin, 0 if none.

    A hazard also contributes to the two neighbouring bins by linear interpolation, so that readings vary smoothly.
    """
    seen = _own_frame(hazards, pose)
    closeness = np.clip(1.0 - np.linalg.norm(seen, axis=2) / _LIDAR_REACH, 0.0, None)
    bins = np.arctan2(seen[..., 1], seen[..., 0]) % (2.0 * np.pi) / (2.0 * np.pi / LIDAR_BINS)
    index = bins.astype(int) % LIDAR_BINS
    share = bins - np.floor(bins)
    lidar = np.zeros((len(hazards), LIDAR_BINS))
    robots = np.arange(len(hazards))[:, None]
    for offset, weight in ((0, 1.0), (1, share), (-1, 1.0 - share)):
        np.maximum.at(lidar, (robots, (index + offset) % LIDAR_BINS), weight * closeness)
    return lidar


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
