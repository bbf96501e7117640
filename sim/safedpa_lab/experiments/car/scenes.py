"""The scenes of the car experiment: a start, a goal 4 m ahead, obstacles in between, as in the paper.

What the paper leaves open (field, number, size and places of the obstacles, spread of the start) is declared here.
"""

from __future__ import annotations

from math import cos, hypot, pi, sin

import numpy as np

from safedpa.errors import InputError
from safedpa_sim.robots.car.footprint import footprint
from safedpa_sim.robots.car.loads import Load, load_named
from safedpa_sim.robots.car.scene import Scene

CONFIGURATIONS = {"box": "Box", "chair": "Chair", "none": "Car", "large_chair": "Large Chair"}
"""Name of the load and the paper's name of the configuration, in the order of the paper's table."""

HEAVIER = {"two_cars": Load("two_cars", mass_ratio=2.0, deceleration=1.6, grip=6.0, side=0.45)}
"""As large as the large chair and twice as heavy as the car: heavier than what anything was trained with."""

TICKS = 300
"""Periods of 0.05 s until an episode ends without having reached its goal."""

FIELD = (-4.0, 4.0, -4.0, 4.0)
"""m; lowest x, highest x, lowest y, highest y."""

_START = (0.0, -2.0)
_AHEAD = 4.0
"""m from the start to the goal, along the field's y axis."""
_START_SPREAD = 0.2
"""m to either side."""
_YAW_SPREAD = 0.3
"""rad to either side of straight ahead."""
_COUNT = (3, 5)
"""Fewest and most obstacles."""
_RADII = (0.2, 0.35)
"""m; as the robot's other scenes."""
_BETWEEN = (-2.0, 2.0, -1.2, 1.2)
"""m; where the obstacles' centres lie: between the start and the goal."""
PASSAGE = 0.4
"""m of room beyond twice the footprint's radius between any two solid things."""
_ROW = (-0.4, 0.4)
"""m; position of a row, far enough from start and goal to turn before and behind it."""
_CLEARANCE = 0.35
"""m beyond the footprint's radius that start and goal keep to obstacles."""
_TRIES = 5000
_ROUNDS = 20

Circle = tuple[float, float, float]


def towed_named(name: str) -> Load | None:
    """The load of that name, one that only this experiment knows too. Raises InputError that lists what exists."""
    return HEAVIER[name] if name in HEAVIER else load_named(name)


def car_scene(seed: int, load: str = "none", passage: float = PASSAGE, *, row: bool = False) -> Scene:
    """The scene of a seed: start (0 +- 0.2, -2), yaw pi/2 +- 0.3, goal (0, 2), 3 to 5 obstacles between them.

    At least one obstacle stands in the straight way to the goal; between any two of them, and to the walls, the
    footprint of the configuration fits through with ``passage`` [m] to spare. As a ``row`` they stand side by side
    from wall to wall, each passage exactly so wide: there is no other way to the goal.
    """
    towed = towed_named(load)
    draw = np.random.default_rng([seed, 7])
    x = float(draw.uniform(-_START_SPREAD, _START_SPREAD))
    yaw = pi / 2 + float(draw.uniform(-_YAW_SPREAD, _YAW_SPREAD))
    start = (_START[0] + x, _START[1], yaw)
    goal = (_START[0], _START[1] + _AHEAD)
    if row:
        return Scene(seed, towed, FIELD, _row(draw, start, goal, towed, passage), start, (goal,))
    wanted = int(draw.integers(_COUNT[0], _COUNT[1] + 1))
    for _ in range(_ROUNDS):  # where the first ones stand, there may be no room for the others
        for count in range(wanted, _COUNT[0] - 1, -1):
            obstacles = _obstacles(draw, count, start, goal, towed, passage)
            if obstacles is not None:
                return Scene(seed, towed, FIELD, obstacles, start, (goal,))
    raise InputError(f"seed {seed}, load '{load}': {_COUNT[0]} obstacles found no place; choose another seed")


def _row(
    draw: np.random.Generator, start: Circle, goal: tuple[float, float], load: Load | None, passage: float
) -> tuple[Circle, ...]:
    """The first in the straight way, then to its left and to its right, the last of each side within the wall."""
    _, _, radius = footprint(load)
    gap = 2 * radius + passage
    y, size = float(draw.uniform(*_ROW)), float(draw.uniform(*_RADII))
    way = start[0] + (goal[0] - start[0]) * (y - start[1]) / (goal[1] - start[1])
    placed = [(way + float(draw.uniform(-size - radius, size + radius)), y, size)]
    for side, wall in ((-1.0, -FIELD[0]), (1.0, FIELD[1])):
        x, _, last = placed[0]
        while side * x + last < wall:
            following = float(draw.uniform(*_RADII))
            x, last = x + side * (last + gap + following), following
            placed.append((x, y, following))
    return tuple(placed)


def _obstacles(
    draw: np.random.Generator,
    count: int,
    start: Circle,
    goal: tuple[float, float],
    load: Load | None,
    passage: float,
) -> tuple[Circle, ...] | None:
    """The first of them across the straight way, the others anywhere in between; None when they find no place."""
    _, front, radius = footprint(load)
    gap = 2 * radius + passage
    nose = (start[0] + front * cos(start[2]), start[1] + front * sin(start[2]))
    placed: list[Circle] = []
    for _ in range(_TRIES):
        if len(placed) == count:
            return tuple(placed)
        size = float(draw.uniform(*_RADII))
        low, high, south, north = _BETWEEN
        x, y = float(draw.uniform(low, high)), float(draw.uniform(south, north))
        if not placed:
            aside = size + radius
            way = start[0] + (goal[0] - start[0]) * (y - start[1]) / (goal[1] - start[1])
            x = way + float(draw.uniform(-aside, aside))
        free = all(hypot(x - ox, y - oy) >= gap + size + other for ox, oy, other in placed)
        ends = (start[:2], nose, goal)
        away = all(hypot(x - ex, y - ey) >= size + radius + _CLEARANCE for ex, ey in ends)
        if free and away:
            placed.append((x, y, size))
    return None
