"""Transforms between frames, from ``/tf_static`` and ``/tf``: the pose of a sensor in the robot's body frame.

A transform that arrives late is used from its arrival on. The age of a chain is that of its oldest moving link, and
transforms of ``/tf_static`` do not age.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np

from safedpa.arrays import FloatArray

__all__ = ["OPTICAL", "Chain", "TransformTree", "matrix_of", "pose_matrix", "roll_pitch_yaw"]

_MOST_FRAMES = 500
_LONGEST_CHAIN = 32
_BUFFERED = 64
"""Transforms of a moving link that are stored: 0.6 s at 100 Hz."""
_LARGEST_METRES = 1e4
_LONGEST_NAME = 200


def matrix_of(place: tuple[float, float, float], turn: tuple[float, float, float, float]) -> FloatArray | None:
    """Returns the transform (4, 4) of a position [m] and a quaternion x, y, z, w; None if they are invalid."""
    x, y, z, w = turn
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if not 0.9 <= norm <= 1.1 or not all(abs(value) <= _LARGEST_METRES for value in place):
        return None  # also for NaN
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    matrix: FloatArray = np.eye(4)
    matrix[:3, :3] = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
    matrix[:3, 3] = place
    return matrix


def pose_matrix(x: float, y: float, z: float, roll: float, pitch: float, yaw: float) -> FloatArray:
    """Returns the transform (4, 4) of a pose: rotation Rz(yaw) Ry(pitch) Rx(roll) (ROS REP 103)."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(angle), math.sin(angle)) for angle in (roll, pitch, yaw))
    matrix: FloatArray = np.eye(4)
    matrix[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    matrix[:3, 3] = (x, y, z)
    return matrix


def roll_pitch_yaw(matrix: FloatArray) -> tuple[float, float, float]:
    """Returns roll, pitch and yaw [rad] of a transform (4, 4)."""
    pitch = math.asin(max(-1.0, min(1.0, -float(matrix[2, 0]))))
    return math.atan2(matrix[2, 1], matrix[2, 2]), pitch, math.atan2(matrix[1, 0], matrix[0, 0])


OPTICAL: Final[FloatArray] = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""Rotation from an optical frame (z ahead, x to the right) to one with x ahead and y to the left."""


@final
@dataclass(frozen=True)
class Chain:
    """Transform (4, 4) from a frame to another one, and the age [s] of its oldest moving link (0: it has none)."""

    matrix: FloatArray
    age: float


@dataclass
class _Link:
    parent: str
    static: bool
    history: deque[tuple[int, float, FloatArray]]
    """Stamp [ns], arrival [s] and transform to the parent, oldest first."""


@final
class TransformTree:
    """The newest transforms by child frame; ``take`` and ``chain`` may be called from different threads.

    Example:

        >>> from safedpa.ros.transforms import TransformTree, pose_matrix
        >>> tree = TransformTree()
        >>> tree.add("base_link", "laser", pose_matrix(0.2, 0.0, 0.1, 0.0, 0.0, 0.0))
        >>> tree.chain("base_link", "laser", 0.0).matrix[:3, 3].tolist()
        [0.2, 0.0, 0.1]
    """

    def __init__(self) -> None:
        self._links: dict[str, _Link] = {}
        self._lock = threading.Lock()
        self.refused = 0
        """Number of refused transforms: invalid, or of too many frames."""

    def take(self, message: Any, arrived: float, *, static: bool) -> None:
        """Takes a decoded ``tf2_msgs/TFMessage`` that arrived at ``arrived`` [s]."""
        for one in message.transforms[:_MOST_FRAMES]:
            place, turn = one.transform.translation, one.transform.rotation
            matrix = matrix_of((place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w))
            stamp = int(one.header.stamp.sec) * 1_000_000_000 + int(one.header.stamp.nanosec)
            if matrix is None:
                self.refused += 1
            else:
                self.add(one.header.frame_id, one.child_frame_id, matrix, stamp, arrived, static=static)

    def add(
        self, parent: str, child: str, matrix: FloatArray, stamp: int = 0, arrived: float = 0.0, *, static: bool = True
    ) -> None:
        """Adds the transform (4, 4) from ``child`` to ``parent``, measured at ``stamp`` [ns]."""
        parent, child = parent.strip("/"), child.strip("/")
        if not parent or not child or parent == child or max(len(parent), len(child)) > _LONGEST_NAME:
            self.refused += 1
            return
        with self._lock:
            link = self._links.get(child)
            if link is None and len(self._links) >= _MOST_FRAMES:
                self.refused += 1
            elif link is None or link.parent != parent or link.static or static:
                if link is None or static or not link.static:  # a moving link does not replace a static one
                    self._links[child] = _Link(parent, static, deque([(stamp, arrived, matrix)], _BUFFERED))
            else:
                link.history.append((stamp, arrived, matrix))

    def chain(self, target: str, source: str, now: float, stamp: int = 0) -> Chain | None:
        """Returns the transform from frame ``source`` to ``target``, or None without one.

        ``stamp`` [ns] selects the moving transform nearest to that time; 0: the newest.
        """
        with self._lock:
            up, low = self._path(source.strip("/")), self._path(target.strip("/"))
            common = next((frame for frame in up or () if frame in (low or ())), None)
            if common is None or up is None or low is None:
                return None
            forward, age = self._to_ancestor(up, common, now, stamp)
            back, other = self._to_ancestor(low, common, now, stamp)
        return Chain(_inverse(back) @ forward, max(age, other))

    def frames(self) -> tuple[str, ...]:
        """Names of the frames that have a parent."""
        with self._lock:
            return tuple(self._links)

    def _path(self, frame: str) -> list[str] | None:
        """The frame and its ancestors; None if they form a loop, in which no pose is right."""
        found = [frame]
        while frame in self._links and len(found) <= _LONGEST_CHAIN:
            frame = self._links[frame].parent
            if frame in found:
                return None
            found.append(frame)
        return found

    def _to_ancestor(self, path: list[str], ancestor: str, now: float, stamp: int) -> tuple[FloatArray, float]:
        matrix, age = np.eye(4), 0.0
        for frame in path:
            if frame == ancestor:
                break
            link = self._links[frame]
            newest = link.history[-1]
            _, _, step = min(link.history, key=lambda one: abs(one[0] - stamp)) if stamp else newest
            matrix = step @ matrix
            age = max(age, 0.0 if link.static else now - newest[1])
        return matrix, age


def _inverse(matrix: FloatArray) -> FloatArray:
    found: FloatArray = np.eye(4)
    found[:3, :3] = matrix[:3, :3].T
    found[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return found
