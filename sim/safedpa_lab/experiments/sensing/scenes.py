"""Where the drives with a laser take place: among pillars, people, boxes and walls with a door, and past a box."""

from __future__ import annotations

from collections.abc import Iterator
from math import atan2, pi

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import InputError, did_you_mean
from safedpa_sim.robots.car.loads import Load, footprint, load_named
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.sensing import Person, StepsOut
from safedpa_sim.sensing.people import walkers
from safedpa_sim.sensing.shapes import Outline, Point, Polygon, box, clearance_at

SCENES = ("pillars", "people", "rooms", "steps-out")
"""Six pillars; the same among people; two rooms with a door, boxes and up to six people; someone behind a
box."""
PEOPLE = 3
"""People of the scene "people" unless another number is given."""
_MOST_PEOPLE = 6
_HALF = 4.0
"""m; half an edge of the square field of the rooms."""
_WALL = 0.15
"""m thick."""
_DOOR = 1.0
"""m of a door's width beyond the car's own, which is twice its radius."""
_BETWEEN = 0.6
"""m between two things beyond the car's width."""
_GOAL = 0.45
"""m beyond the car's radius that goals keep to everything, and ..."""
_START = 0.9
"""m that the start does: a car turns round there."""
_LEG = 2.5
"""m; shortest way from one goal to the next."""
_GOALS, _BOXES, _TRIES = 12, 3, 4000


def scene_and_people(
    kind: str, seed: int, load: str, walking: float = 1.5, people: int = PEOPLE
) -> tuple[Scene, tuple[Person, ...]]:
    """The scene of a seed, and who is in it, ``walking`` [m/s] at most; who steps out does so at that speed.

    ``people`` is the number of people in the scene "people". Raises InputError for a kind or load that does not exist.
    """
    if kind not in SCENES:
        raise InputError(f"scene '{kind}': {did_you_mean(kind, SCENES)}")
    draw = np.random.default_rng([seed, 23])
    if kind == "steps-out":
        return _past_a_box(seed, load_named(load), draw, walking)
    if kind == "rooms":
        scene = _rooms(seed, load_named(load), draw)
        return scene, walkers(scene, int(draw.integers(0, _MOST_PEOPLE + 1)), walking, draw)
    scene = Scene.random(seed, load)
    return scene, walkers(scene, people if kind == "people" else 0, walking, draw)


def _past_a_box(
    seed: int, load: Load | None, draw: np.random.Generator, walking: float
) -> tuple[Scene, tuple[Person, ...]]:
    """Someone steps out from behind a box into the car's way when the car is 0.8 to 2.2 m away."""
    x, after = float(draw.uniform(-1.0, 1.0)), float(draw.uniform(0.5, 0.9))
    field = (-4.0 if load is None else -5.0, 4.0, -3.0, 3.0)
    cover = box(x, 1.0, 0.9, 0.6)
    scene = Scene(seed, load, field, (), (-3.0, 0.0, 0.0), ((3.2, 0.0), (-3.2, 0.0)), (cover,))
    trigger = float(draw.uniform(0.8, 2.2))
    return scene, (StepsOut((x + after, 1.6), (x + after, 0.0), walking, trigger),)


def _rooms(seed: int, load: Load | None, draw: np.random.Generator) -> Scene:
    """A wall with a door across a square field, boxes, a pillar, and goals on both sides of the wall in turn."""
    radius = footprint(load)[2]
    field = (-_HALF, _HALF, -_HALF, _HALF)
    across, middle = draw.uniform((-0.8, -1.5), (0.8, 1.5)).tolist()
    gap = radius + _DOOR / 2
    walls = tuple(
        box(across, (low + high) / 2, _WALL, high - low)
        for low, high in ((-_HALF, middle - gap), (middle + gap, _HALF))
    )
    things = walls + tuple(_boxes(field, walls, 2 * radius + _BETWEEN, draw))
    outline = Outline((), things, (field,))
    places = _free(outline, field, radius + _GOAL, draw)
    goals, side = list[Point](), 1.0 if draw.random() < 0.5 else -1.0
    for place in places:
        near = goals and np.hypot(place[0] - goals[-1][0], place[1] - goals[-1][1]) < _LEG
        if (place[0] - across) * side > 0.0 and not near:
            goals.append(place)
            side = side if draw.random() < 0.5 else -side
        if len(goals) == _GOALS:
            break
    x, y = next(_free(outline, field, radius + _START, draw))
    yaw = atan2(-y, -x) + float(draw.uniform(-pi / 3, pi / 3))
    return Scene(seed, load, field, (), (x, y, yaw), tuple(goals), things)


def _boxes(
    field: tuple[float, float, float, float], walls: tuple[Polygon, ...], gap: float, draw: np.random.Generator
) -> Iterator[Polygon]:
    """Boxes of 0.4 to 0.9 by 0.3 to 0.6 m, turned any way, with ``gap`` [m] between all things; fewer where full."""
    things, made = walls, 0
    for x, y in _free(Outline((), walls, (field,)), field, 0.55 + gap, draw):
        length, width, yaw = draw.uniform((0.4, 0.3, 0.0), (0.9, 0.6, pi)).tolist()
        if clearance_at(Outline((), things, (field,)), x, y) > 0.55 + gap:
            things, made = (*things, box(x, y, length, width, yaw)), made + 1
            yield things[-1]
        if made == _BOXES:
            return


def _free(
    outline: Outline, field: tuple[float, float, float, float], room: float, draw: np.random.Generator
) -> Iterator[Point]:
    """Places that keep ``room`` [m] to everything, drawn one after the other."""
    for _ in range(_TRIES):
        x, y = draw.uniform((field[0], field[2]), (field[1], field[3])).tolist()
        if _outside(outline, x, y) and clearance_at(outline, x, y) > room:
            yield x, y


def _outside(outline: Outline, x: float, y: float) -> bool:
    """Whether a place lies in none of the boxes: room is measured to their edges, from within as from outside."""
    return not any(_within(np.array(polygon), x, y) for polygon in outline.polygons)


def _within(corners: NDArray[np.float64], x: float, y: float) -> bool:
    way = np.roll(corners, -1, axis=0) - corners
    return bool((way[:, 0] * (y - corners[:, 1]) - way[:, 1] * (x - corners[:, 0]) > 0.0).all())
