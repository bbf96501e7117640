"""What policies see of the point robot.

The task's: the benchmark's sensors, where the goal lies, a lidar of the hazards. The robot's own policy pi(x, z): its
motion, the goal, hazards, the first turn of the way, z.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa_sim.point.layout import FIELD, HAZARD_RADIUS

if TYPE_CHECKING:
    from safedpa_sim.point.task import PointTask

__all__ = [
    "GOAL_ENTRIES",
    "GOAL_OFFSET",
    "LIDAR_BINS",
    "SENSOR_ENTRIES",
    "entries_seen",
    "goal_seen",
    "hazard_lidar",
    "policy_seen",
]


_NEAREST: Final = 4
"""Hazards that are told one by one."""
_FADING: Final = 0.3
"""m from a hazard's edge at which it counts a third."""
_FARTHEST: Final = 1.0
"""m beyond which a distance makes no difference."""


def entries_seen(latents: int) -> int:
    """How many numbers ``policy_seen`` gives."""
    return 3 + 3 * latents + 3 + 3 * _NEAREST + LIDAR_BINS + 3


def policy_seen(task: PointTask, latent: NDArray[np.floating[Any]], turn: FloatArray) -> FloatArray:
    """(robots, entries), all as seen from the robot, directions as unit vectors ahead and left:

        velocity and yaw rate; z cos yaw, z sin yaw, z; goal: direction and distance; the four nearest hazards:
        direction and exp(-distance to the edge / 0.3 m); the lidar; the way's first ``turn`` (robots, 2): direction and
        distance.

    z turned by the yaw is there because a wind acts in the world and the robot pushes along its heading.
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


def _towards(place: FloatArray, pose: FloatArray) -> FloatArray:
    seen = _own_frame(place[:, np.newaxis], pose)[:, 0]
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
"""m; further hazards read 0."""
GOAL_OFFSET: Final = 0.001
"""m on top of a distance, not to divide by zero."""


def _own_frame(points: FloatArray, pose: FloatArray) -> FloatArray:
    """Points (robots, points, 2) of the world as seen by robots of pose (3, robots): ahead, left."""
    apart = points - pose[:2].T[:, None]
    cosine, sine = np.cos(pose[2])[:, None], np.sin(pose[2])[:, None]
    ahead = cosine * apart[..., 0] + sine * apart[..., 1]
    left = cosine * apart[..., 1] - sine * apart[..., 0]
    return np.stack((ahead, left), axis=-1)


def goal_seen(pose: FloatArray, goal: FloatArray) -> FloatArray:
    """(robots, 3): direction of the goal in the own frame (2 entries of a unit vector), distance [m]."""
    seen = _own_frame(goal[:, None], pose)[:, 0]
    distance = np.linalg.norm(seen, axis=1, keepdims=True)
    return np.concatenate((seen / (distance + GOAL_OFFSET), distance), axis=1)


def hazard_lidar(pose: FloatArray, hazards: FloatArray) -> FloatArray:
    """(robots, 16): closeness 1 - distance / 3 m of the nearest hazard in each sixteenth of the circle, 0: none.

    A hazard also shows in the bins next to its own, by how far it lies towards them, so the reading turns smoothly.
    """
    seen = _own_frame(hazards, pose)
    closeness = np.clip(1.0 - np.linalg.norm(seen, axis=2) / _LIDAR_REACH, 0.0, None)
    place = np.arctan2(seen[..., 1], seen[..., 0]) % (2.0 * np.pi) / (2.0 * np.pi / LIDAR_BINS)
    index = place.astype(int) % LIDAR_BINS
    share = place - np.floor(place)
    lidar = np.zeros((len(hazards), LIDAR_BINS))
    robots = np.arange(len(hazards))[:, None]
    for offset, weight in ((0, 1.0), (1, share), (-1, 1.0 - share)):
        np.maximum.at(lidar, (robots, (index + offset) % LIDAR_BINS), weight * closeness)
    return lidar
