"""What a policy sees of the point robot: the benchmark's sensors, where the goal lies, a lidar of the hazards."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from safedpa_sim.point.layout import FIELD

__all__ = ["GOAL_ENTRIES", "LIDAR_BINS", "SENSOR_ENTRIES", "goal_seen", "hazard_lidar", "own_frame"]

Floats = NDArray[np.float64]

SENSOR_ENTRIES: Final = 12
GOAL_ENTRIES: Final = 3
LIDAR_BINS: Final = 16
_LIDAR_REACH = 2.0 * FIELD
"""m; further hazards read 0."""
_NOT_TO_DIVIDE_BY_ZERO = 0.001


def own_frame(points: Floats, pose: Floats) -> Floats:
    """Points (robots, points, 2) of the world as seen by robots of pose (3, robots): ahead, left."""
    apart = points - pose[:2].T[:, None]
    cosine, sine = np.cos(pose[2])[:, None], np.sin(pose[2])[:, None]
    ahead = cosine * apart[..., 0] + sine * apart[..., 1]
    left = cosine * apart[..., 1] - sine * apart[..., 0]
    return np.stack((ahead, left), axis=-1)


def goal_seen(pose: Floats, goal: Floats) -> Floats:
    """(robots, 3): direction of the goal in the own frame (2 entries of a unit vector), distance [m]."""
    seen = own_frame(goal[:, None], pose)[:, 0]
    distance = np.linalg.norm(seen, axis=1, keepdims=True)
    return np.concatenate((seen / (distance + _NOT_TO_DIVIDE_BY_ZERO), distance), axis=1)


def hazard_lidar(pose: Floats, hazards: Floats) -> Floats:
    """(robots, 16): closeness 1 - distance / 3 m of the nearest hazard in each sixteenth of the circle, 0: none.

    A hazard also shows in the bins beside its own, by how far it lies towards them, so the reading turns smoothly.
    """
    seen = own_frame(hazards, pose)
    closeness = np.clip(1.0 - np.linalg.norm(seen, axis=2) / _LIDAR_REACH, 0.0, None)
    place = np.arctan2(seen[..., 1], seen[..., 0]) % (2.0 * np.pi) / (2.0 * np.pi / LIDAR_BINS)
    index = place.astype(int) % LIDAR_BINS
    share = place - np.floor(place)
    lidar = np.zeros((len(hazards), LIDAR_BINS))
    robots = np.arange(len(hazards))[:, None]
    for offset, weight in ((0, 1.0), (1, share), (-1, 1.0 - share)):
        np.maximum.at(lidar, (robots, (index + offset) % LIDAR_BINS), weight * closeness)
    return lidar
