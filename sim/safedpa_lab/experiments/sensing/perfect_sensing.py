"""Perception with perfect knowledge of the scene, for comparison with a laser on the same drives."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from math import ceil
from typing import Protocol, final

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import SCAN, SURROUNDINGS, AbstractNode, Inputs, Message, Outputs, StateMessage, SurroundingsMessage
from safedpa.perception import PerceptionNode, PerceptionSettings
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.sensing.shapes import Outline, Point

_APART = 0.1
"""m between the points of an edge: between two of them a car's body gets up to 7 mm nearer to it."""
_RADIUS = 0.01
"""m of each."""


class Disc(Protocol):
    """Someone, or a part of something, that moves."""

    @property
    def position(self) -> Point:
        """x, y [m] now."""

    @property
    def radius(self) -> float:
        """m"""


@final
class ReportsEverything(AbstractNode):
    """Publishes with each state the true scene and the positions of all people; nothing is hidden.

    No one's next step is known: anyone who may move may do so at the speed that perception reckons with.
    """

    name = "perception"
    inputs = ()
    outputs = (SURROUNDINGS,)
    share = 0.0
    lingers = False

    def __init__(self, scene: Scene, people: Sequence[Disc], settings: PerceptionSettings | None = None) -> None:
        self._people, self._settings = people, settings or PerceptionSettings()
        outline = Outline(scene.obstacles, scene.polygons, (scene.field,))
        self._points = np.vstack([outline.discs, *map(_along, outline.edges)])

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        del robot, inputs
        here = np.array(state.values[:2])
        away = np.hypot(*(self._points[:, :2] - here).T) - self._points[:, 2]
        order = np.argsort(away)
        near = self._points[order[away[order] < self._settings.reach]]
        message = SurroundingsMessage(
            epoch=state.epoch,
            tick=state.tick,
            robot_time=state.robot_time,
            publish_time=time.time(),
            points=tuple(map(tuple, near.tolist())),
            movers=tuple((*one.position, one.radius, 0.0, 0.0, self._settings.fastest) for one in self._people),
            hidden=(),
            ages=(0.0,) * len(state.sources),
        )
        return {SURROUNDINGS: message}


@final
class ReportsAllButWhoHides(AbstractNode):
    """Publishes the true scene, the positions of all people, and the places hidden from the laser: what the promise
    about who hides costs, with nothing lost to noise, age and tracks."""

    name = "perception"
    inputs = ()
    outputs = (SURROUNDINGS,)
    listens = (SCAN,)
    share = 0.0
    lingers = False

    def __init__(self, scene: Scene, people: Sequence[Disc], settings: PerceptionSettings) -> None:
        self._seen, self._reported = PerceptionNode(settings), ReportsEverything(scene, people, settings)

    def hear(self, robot: str, message: Message) -> None:  # noqa: D102
        self._seen.hear(robot, message)

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        seen = self._seen.step(robot, state, inputs)
        reported = self._reported.step(robot, state, inputs)[SURROUNDINGS]
        if not seen or not isinstance(reported, SurroundingsMessage):
            return seen
        message = seen[SURROUNDINGS]
        assert isinstance(message, SurroundingsMessage)
        return {SURROUNDINGS: replace(message, points=reported.points, movers=reported.movers)}


def _along(edge: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (n, 3) with a radius, from one end of an edge x, y, x, y [m] to the other."""
    start, end = edge[:2], edge[2:]
    share = np.linspace(0.0, 1.0, ceil(float(np.hypot(*(end - start))) / _APART) + 1)[:, np.newaxis]
    places = start + share * (end - start)
    return np.column_stack([places, np.full(len(places), _RADIUS)])
