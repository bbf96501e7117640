"""Observations of the point robot.

The task's observation has the benchmark's sensors, the goal and a lidar of the hazards. The observation of the policy
pi(x, z) has motion, z, goal, hazards, lidar and the first turn of the route.
"""

from __future__ import annotations

from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
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
