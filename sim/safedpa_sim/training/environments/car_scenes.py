"""Random scenes for training a car policy, thousands at a time: field, obstacles with passages, start and goal.

The rules are those of ``safedpa_sim.robots.car.scene``, but no scene is one that an experiment uses.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import AnyFloatArray, BoolArray, Float32Array
from safedpa_sim.robots.car.loads import LOADS, footprint

MOST_OBSTACLES = 6
FOOTPRINTS = tuple(footprint(load) for load in (None, *LOADS.values()))
"""Rear, front, radius [m] of the car alone and with each known load."""

_REAR, _FRONT, _ = FOOTPRINTS[0]
_RADII = (min(item[2] for item in FOOTPRINTS), max(item[2] for item in FOOTPRINTS))
_ANY_RADIUS = 0.3
"""Share of the scenes whose footprint has any radius between the smallest and the largest."""
_HALF_FIELD = (3.6, 4.4)
_OBSTACLE_RADII = (0.2, 0.35)
_PASSAGE = (0.4, 0.8)
"""m of room between any two solid objects beyond twice the footprint's radius; drawn per scene."""
_CLEARANCE = 0.35
_WALL_CLEARANCE = 0.8
"""m of distance from start and goal to walls beyond the footprint's radius."""
_LEG = 2.0
"""m; least distance between start and goal."""
_CROSSING = 0.5
"""Share of the scenes that lead across the middle of the field, with all obstacles in between."""
_BEHIND = 0.8
"""Share of the scenes with an obstacle on the straight line from start to goal."""
_ANY_HEADING = 0.25
"""Share of the starts with any heading; the others face inwards, because with some loads a car cannot leave a wall."""
_TRIES = 40
_FAR_AWAY = 1e4


@final
@dataclass(frozen=True)
class ScenePool:
    """Arrays over scenes: start (n, 3), goal (n, 2), obstacles (n, 6, 3), field (n, 4), footprint (n, 3); m and rad."""

    start: Float32Array
    goal: Float32Array
    obstacles: Float32Array
    """x, y, radius; unused rows are far away."""
    field: Float32Array
    footprint: Float32Array

    def __len__(self) -> int:
        return len(self.start)

    def taken(self, which: NDArray[np.intp] | slice) -> ScenePool:
        """Returns the scenes with the given indices."""
        return ScenePool(**{item.name: getattr(self, item.name)[which] for item in fields(self)})


def draw_scenes(random: np.random.Generator, count: int, *, loads: bool = True) -> ScenePool:
    """Draws scenes: half lead across the middle as in the car experiment, half between random positions.

    Without ``loads`` every scene has the footprint of the car alone.
    """
    radius = _footprint_radii(random, count) if loads else np.full(count, FOOTPRINTS[0][2])
    half = random.uniform(*_HALF_FIELD, count)
    crossing = random.random(count) < _CROSSING
    start, goal = _ends(random, radius, half, crossing)
    obstacles = _obstacles(random, radius, half, crossing, start, goal)
    turn = 0.5 * np.pi * random.integers(0, 4, count)
    start = np.concatenate((_rotated(start[:, :2], turn), (start[:, 2] + turn)[:, np.newaxis]), axis=1)
    obstacles[..., :2] = _rotated(obstacles[..., :2], turn[:, np.newaxis])
    arrays = (
        start,
        _rotated(goal, turn),
        obstacles,
        half[:, np.newaxis] * np.array([-1.0, 1.0, -1.0, 1.0]),
        np.stack((np.full(count, _REAR), np.full(count, _FRONT), radius), axis=1),
    )
    return ScenePool(*(array.astype(np.float32) for array in arrays))


def _footprint_radii(random: np.random.Generator, count: int) -> AnyFloatArray:
    known = np.array([item[2] for item in FOOTPRINTS])[random.integers(0, len(FOOTPRINTS), count)]
    return np.where(random.random(count) < _ANY_RADIUS, random.uniform(*_RADII, count), known)


def _ends(
    random: np.random.Generator, radius: AnyFloatArray, half: AnyFloatArray, crossing: BoolArray
) -> tuple[AnyFloatArray, AnyFloatArray]:
    """Draws start (n, 3) and goal (n, 2): from south to north across the middle, or anywhere ``_LEG`` apart."""
    count = len(radius)
    inner = (half - radius - _WALL_CLEARANCE)[:, np.newaxis, np.newaxis]
    positions = inner * random.uniform(-1.0, 1.0, (count, _TRIES + 1, 2))
    first, others = positions[:, 0], positions[:, 1:]
    far = _length(others - first[:, np.newaxis]) >= _LEG
    anywhere = others[np.arange(count), np.argmax(far, axis=1)]
    leg = random.uniform(3.6, 4.4, count)
    south = np.stack((random.uniform(-0.4, 0.4, count), -0.5 * leg), axis=1)
    north = np.stack((random.uniform(-0.3, 0.3, count), 0.5 * leg), axis=1)
    start = np.where(crossing[:, np.newaxis], south, first)
    goal = np.where(crossing[:, np.newaxis], north, anywhere)
    towards = np.arctan2(goal[:, 1] - start[:, 1], goal[:, 0] - start[:, 0])
    inwards = np.arctan2(-start[:, 1], -start[:, 0])
    outwards = random.random(count) < _ANY_HEADING
    middle, spread = np.where(crossing, towards, inwards), np.where(crossing, 0.5, np.where(outwards, np.pi, 1.2))
    yaw = middle + spread * random.uniform(-1.0, 1.0, count)
    return np.concatenate((start, yaw[:, np.newaxis]), axis=1), goal


def _obstacles(
    random: np.random.Generator,
    radius: AnyFloatArray,
    half: AnyFloatArray,
    crossing: BoolArray,
    start: AnyFloatArray,
    goal: AnyFloatArray,
) -> AnyFloatArray:
    """Places obstacles (n, 6, 3) one after the other; an obstacle without a free position is left out."""
    count = len(radius)
    wanted = np.where(crossing, random.integers(3, 6, count), random.integers(0, MOST_OBSTACLES + 1, count))
    behind = random.random(count) < _BEHIND
    placed = np.full((count, MOST_OBSTACLES, 3), _FAR_AWAY)
    placed[..., 2] = 0.0
    gap = (2.0 * radius + random.uniform(*_PASSAGE, count))[:, np.newaxis]
    for slot in range(MOST_OBSTACLES):
        drawn = _candidates(random, radius, half, crossing, start, goal, behind & (slot == 0))
        size = drawn[..., 2]
        free = _room(drawn, placed) >= gap
        within = np.abs(drawn[..., :2]).max(axis=-1) <= half[:, np.newaxis] - gap - size
        fits = free & (within | crossing[:, np.newaxis]) & _ends_free(drawn, radius, start, goal)
        fits &= (slot < wanted)[:, np.newaxis]
        chosen = np.argmax(fits, axis=1)
        found = fits.any(axis=1)
        placed[found, slot] = drawn[found, chosen[found]]
    return placed


def _candidates(
    random: np.random.Generator,
    radius: AnyFloatArray,
    half: AnyFloatArray,
    crossing: BoolArray,
    start: AnyFloatArray,
    goal: AnyFloatArray,
    behind: BoolArray,
) -> AnyFloatArray:
    """Draws candidate obstacles (n, tries, 3); where ``behind``, across the straight line from start to goal."""
    shape = (len(radius), _TRIES)
    size = random.uniform(*_OBSTACLE_RADII, shape)
    middle = np.array([2.0, 1.2]) * random.uniform(-1.0, 1.0, (*shape, 2))
    anywhere = half[:, np.newaxis, np.newaxis] * random.uniform(-1.0, 1.0, (*shape, 2))
    positions = np.where(crossing[:, np.newaxis, np.newaxis], middle, anywhere)
    way = goal - start[:, :2]
    normal = np.stack((-way[:, 1], way[:, 0]), axis=1) / np.maximum(_length(way), 1e-6)[:, np.newaxis]
    share = random.uniform(0.2, 0.8, shape)[..., np.newaxis]
    aside = (size + radius[:, np.newaxis]) * random.uniform(-1.0, 1.0, shape)
    across = start[:, np.newaxis, :2] + share * way[:, np.newaxis] + aside[..., np.newaxis] * normal[:, np.newaxis]
    positions = np.where(behind[:, np.newaxis, np.newaxis], across, positions)
    return np.concatenate((positions, size[..., np.newaxis]), axis=-1)


def _room(drawn: AnyFloatArray, placed: AnyFloatArray) -> AnyFloatArray:
    """Returns the gap between each candidate and the nearest placed obstacle, (n, tries) [m]."""
    between = _length(drawn[:, :, np.newaxis, :2] - placed[:, np.newaxis, :, :2])
    room: AnyFloatArray = (between - drawn[:, :, np.newaxis, 2] - placed[:, np.newaxis, :, 2]).min(axis=-1)
    return room


def _ends_free(drawn: AnyFloatArray, radius: AnyFloatArray, start: AnyFloatArray, goal: AnyFloatArray) -> AnyFloatArray:
    """Returns whether a candidate leaves the start, the area behind and ahead of it, and the goal free, (n, tries)."""
    heading = np.stack((np.cos(start[:, 2]), np.sin(start[:, 2])), axis=1)
    ends = [start[:, :2] + reach * heading for reach in (-0.5, 0.0, _FRONT, _FRONT + 0.4)]
    needed = drawn[..., 2] + radius[:, np.newaxis] + _CLEARANCE
    free = np.ones(drawn.shape[:2], dtype=bool)
    for end in (*ends, goal):
        free &= _length(drawn[..., :2] - end[:, np.newaxis]) >= needed
    return free


def _rotated(positions: AnyFloatArray, angle: AnyFloatArray) -> AnyFloatArray:
    x, y, cosine, sine = positions[..., 0], positions[..., 1], np.cos(angle), np.sin(angle)
    return np.stack((cosine * x - sine * y, sine * x + cosine * y), axis=-1)


def _length(offset: AnyFloatArray) -> AnyFloatArray:
    length: AnyFloatArray = np.hypot(offset[..., 0], offset[..., 1])
    return length
