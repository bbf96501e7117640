"""What the point robot's own policy pi(x, z) sees: its motion, the goal, hazards, the first turn of the way, z."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from safedpa_sim.point.layout import HAZARD_RADIUS
from safedpa_sim.point.observation import LIDAR_BINS, hazard_lidar, own_frame
from safedpa_sim.point.task import PointTask

__all__ = ["entries_seen", "policy_seen"]

Floats = NDArray[np.float64]

_NEAREST: Final = 4
"""Hazards that are told one by one."""
_FADING: Final = 0.3
"""m from a hazard's edge at which it counts a third."""
_FARTHEST: Final = 1.0
"""m beyond which a distance makes no difference."""
_NOT_TO_DIVIDE_BY_ZERO: Final = 1e-3


def entries_seen(latents: int) -> int:
    """How many numbers ``policy_seen`` gives."""
    return 3 + 3 * latents + 3 + 3 * _NEAREST + LIDAR_BINS + 3


def policy_seen(task: PointTask, latent: NDArray[np.floating[Any]], turn: Floats) -> Floats:
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


def _towards(place: Floats, pose: Floats) -> Floats:
    seen = own_frame(place[:, np.newaxis], pose)[:, 0]
    distance = np.linalg.norm(seen, axis=1, keepdims=True)
    parts = (seen / (distance + _NOT_TO_DIVIDE_BY_ZERO), np.minimum(distance, _FARTHEST))
    return np.concatenate(parts, axis=1)


def _nearest(hazards: Floats, pose: Floats) -> Floats:
    seen = own_frame(hazards, pose)
    distance = np.linalg.norm(seen, axis=2)
    order = np.argsort(distance, axis=1)[:, :_NEAREST]
    distance = np.take_along_axis(distance, order, axis=1)[..., np.newaxis]
    direction = np.take_along_axis(seen, order[..., np.newaxis], axis=1) / (distance + _NOT_TO_DIVIDE_BY_ZERO)
    nearness = np.exp((HAZARD_RADIUS - distance) / _FADING)
    return np.concatenate((direction, nearness), axis=2).reshape(len(seen), -1)
