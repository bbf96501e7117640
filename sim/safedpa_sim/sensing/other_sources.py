"""Simulated sensors other than a laser scanner: a point cloud, depth images, a ring of range sensors, a local grid.

Each measures as often and as late as ``Laser``, and publishes what ``safedpa.perception.readings`` makes of it. Objects
reach from the ground to above the robot.
"""

from __future__ import annotations

import math
from collections import deque
from math import pi
from typing import Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.bus.messages.messages import ScanMessage
from safedpa.errors import InputError, did_you_mean
from safedpa.perception import Camera, Rays, rays_of_depth, rays_of_grid, rays_of_points, rays_of_range
from safedpa_sim.sensing.laser import Laser, LaserSettings
from safedpa_sim.sensing.shapes import Outline, cast

SOURCES: Final = ("cloud", "depth", "range", "grid")
KNOWN_SOURCES: Final = ("laser", *SOURCES)
_HEIGHTS: Final = (0.2, 0.5, 0.8)
"""m; of the points of a cloud on each object."""
_GROUND: Final = 0.25
"""m between the ground points of a cloud along a ray."""
_CAMERAS, _COLUMNS, _ROWS = 4, 96, 24
_FOCAL: Final = 47.0
"""pixels; half of the columns: each camera sees a quarter of a turn."""
_RANGES, _CONE = 16, 2.0 * pi / 16
_RANGE_FARTHEST: Final = 4.0
_GRID, _CELL = 10.0, 0.05
"""m; edge of the grid around the robot, and of its cells."""


def make_sources(kind: str, seed: int, laser: LaserSettings | None = None) -> tuple[OtherSource | Laser, ...]:
    """Returns the sensors of a kind around the robot: four cameras, sixteen ranges, or one.

    ``laser`` are the settings of a laser. Raises InputError for a kind that does not exist.
    """
    if kind not in KNOWN_SOURCES:
        raise InputError(f"source '{kind}': {did_you_mean(kind, KNOWN_SOURCES)}")
    if kind == "laser":
        return (Laser(laser or LaserSettings(), seed),)
    count = {"depth": _CAMERAS, "range": _RANGES}.get(kind, 1)
    return tuple(OtherSource(kind, f"{kind}{index}", 2.0 * pi * index / count, seed + index) for index in range(count))


@final
class OtherSource:
    """One sensor, with the interface of ``Laser``; it looks towards ``yaw`` [rad] in the body frame."""

    def __init__(self, kind: str, name: str, yaw: float, seed: int) -> None:
        self.settings = LaserSettings(name=name, mount=(0.0, 0.0, yaw))
        self._kind, self._yaw, self._draw = kind, yaw, np.random.default_rng([seed, 13])
        self._number = 0
        self._waiting: deque[ScanMessage] = deque()

    @property
    def next_scan(self) -> float:
        """Robot time [s] of the next measurement."""
        return self._number / self.settings.rate

    def scan(self, pose: tuple[float, float, float], outline: Outline, epoch: int, tick: int) -> None:
        """Measures ``outline`` at ``next_scan`` from the body's pose (x, y [m], yaw [rad])."""
        measured = {"cloud": self._cloud, "depth": self._depth, "range": self._range, "grid": self._grid}[self._kind]
        rays = measured(pose, outline)
        self._waiting.append(rays.message(self.settings.name, self._number, epoch, tick, self.next_scan))
        self._number += 1

    def reported(self, now: float) -> list[ScanMessage]:
        """Returns the scans due at robot time ``now`` [s], each once, in order."""
        due = []
        while self._waiting and self._waiting[0].robot_time + self.settings.latency <= now + 1e-9:
            due.append(self._waiting.popleft())
        return due

    def _true(self, pose: tuple[float, float, float], outline: Outline, angles: FloatArray) -> FloatArray:
        """Returns noisy distances [m] along ``angles`` [rad] in the body frame."""
        x, y, yaw = pose
        true = cast(outline, x, y, angles + yaw)
        return true + self._draw.normal(0.0, 1.0, len(angles)) * self.settings.noise

    def _cloud(self, pose: tuple[float, float, float], outline: Outline) -> Rays:
        angles: FloatArray = -pi + 2.0 * pi / 720 * np.arange(720, dtype=np.float64)
        distance = self._true(pose, outline, angles)
        seen = distance < self.settings.farthest
        points = [
            np.column_stack([distance * np.cos(angles), distance * np.sin(angles), np.full(720, height)])[seen]
            for height in _HEIGHTS
        ]
        for far in _GROUND * np.arange(1, 20):
            before = distance > far + 0.05
            points.append(np.column_stack([far * np.cos(angles), far * np.sin(angles), np.zeros(720)])[before])
        return rays_of_points(np.vstack(points), (0.0, 0.0, 0.0), farthest=self.settings.farthest)

    def _depth(self, pose: tuple[float, float, float], outline: Outline) -> Rays:
        camera = Camera(_FOCAL, _FOCAL, 0.5 * (_COLUMNS - 1), 0.5 * (_ROWS - 1), z=0.3, yaw=self._yaw)
        left = (camera.cx - np.arange(_COLUMNS)) / camera.fx
        distance = self._true(pose, outline, np.arctan(left) + self._yaw)
        wall = distance / np.sqrt(1.0 + left**2)
        down = (np.arange(_ROWS) - camera.cy) / camera.fy
        ground = np.where(down > 0.0, camera.z / np.where(down > 0.0, down, 1.0), math.inf)
        return rays_of_depth(
            np.minimum(wall[np.newaxis, :], ground[:, np.newaxis]), camera, rays=_COLUMNS, farthest=8.0
        )

    def _range(self, pose: tuple[float, float, float], outline: Outline) -> Rays:
        angles: FloatArray = self._yaw + np.linspace(-0.5 * _CONE, 0.5 * _CONE, 15)
        nearest = float(self._true(pose, outline, angles).min())
        return rays_of_range(nearest, _CONE, (0.0, 0.0, self._yaw), 0.02, _RANGE_FARTHEST)

    def _grid(self, pose: tuple[float, float, float], outline: Outline) -> Rays:
        angles: FloatArray = -pi + 2.0 * pi / 720 * np.arange(720, dtype=np.float64)
        distance = self._true(pose, outline, angles)
        count = round(_GRID / _CELL)
        middles = -0.5 * _GRID + _CELL * (np.arange(count) + 0.5)
        x, y = np.meshgrid(middles, middles)
        away = np.hypot(x, y)
        ray = np.rint((np.arctan2(y, x) + pi) / (2.0 * pi / 720)).astype(np.int64) % 720
        cells = np.where(away < distance[ray] - 0.5 * _CELL, 0, -1)
        cells[np.abs(away - distance[ray]) <= 0.75 * _CELL] = 100
        corner = -0.5 * _GRID
        return rays_of_grid(cells, _CELL, (corner, corner, 0.0), farthest=4.5)
