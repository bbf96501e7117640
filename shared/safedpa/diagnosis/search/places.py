"""Places where the floor brakes, written as effects so that they are fitted like any other: a circle, a strip."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from typing import ClassVar, final

import numpy as np

from safedpa.compare.windows import Floats
from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.friction import REST_SPEED, direction_of
from safedpa.effects.parameter import Parameter
from safedpa.operations import Scalar

__all__ = ["Circle", "Place", "Strip"]

_EDGE = 0.1
"""m over which the resistance sets in."""
_RADII = (0.5, 0.8, 1.2, 1.7)
"""m"""
_HALF_WIDTHS = (0.25, 0.5, 0.9)
"""m"""
_SIDE = 18
"""Centres of circles along each side of the plane."""
_TURNS = 8
"""Directions of strips."""
_LINES = 24
"""Strips beside each other in each direction."""

_DECELERATION = Parameter("deceleration", "m/s2", -10.0, 10.0, 1.0)


class Place(RateEffect):
    """d(speed)/dt -= deceleration sign(speed) in one place; its edge is rounded off over 0.1 m."""

    name = "place"
    robot = ""
    stage = Stage.WEIGHT
    signature = "a map of the residual"
    source = "Coulomb friction of a floor covering"
    shape: ClassVar[str]

    def __init__(self, robot: str = "") -> None:
        self.robot = robot  # type: ignore[misc]

    @abstractmethod
    def depth(self, parameters: Named, x: Scalar, y: Scalar, context: Context) -> Scalar:
        """m from a point to the edge, positive inside."""

    @abstractmethod
    def starts(self, points: Floats) -> Iterator[tuple[dict[str, float], Floats]]:
        """Places to look at, by parameters without the deceleration, and which points (windows, 2) lie inside."""

    @abstractmethod
    def where(self, values: Mapping[str, float]) -> str:
        """The place as a condition on x and y."""

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        operations, state = context.operations, context.state
        depth = self.depth(parameters, state["x"], state["y"], context)
        pull = parameters["deceleration"] * (0.5 + 0.5 * operations.tanh(depth / _EDGE))
        # the sign's rounding off needs a size: what is usual
        return {**rates, "speed": rates["speed"] - pull * direction_of(state["speed"], 1.0, REST_SPEED, context)}


@final
class Circle(Place):
    """Inside a circle."""

    shape = "circle"
    equation = "d(speed)/dt -= deceleration sign(speed) where |(x, y) - (at_x, at_y)| < radius"
    parameters = (
        Parameter("at_x", "m", -1e4, 1e4, 1.0),
        Parameter("at_y", "m", -1e4, 1e4, 1.0),
        Parameter("radius", "m", 0.1, 100.0, 1.0, neutral=None),
        _DECELERATION,
    )

    def depth(self, parameters: Named, x: Scalar, y: Scalar, context: Context) -> Scalar:  # noqa: D102
        del context
        dx, dy = x - parameters["at_x"], y - parameters["at_y"]
        return parameters["radius"] - (dx * dx + dy * dy + 1e-12) ** 0.5

    def starts(self, points: Floats) -> Iterator[tuple[dict[str, float], Floats]]:  # noqa: D102
        low, high = np.quantile(points, [0.03, 0.97], axis=0)
        for at_x in np.linspace(low[0], high[0], _SIDE).tolist():
            for at_y in np.linspace(low[1], high[1], _SIDE).tolist():
                distance = np.hypot(points[:, 0] - at_x, points[:, 1] - at_y)
                for radius in _RADII:
                    yield {"at_x": at_x, "at_y": at_y, "radius": radius}, distance < radius

    def where(self, values: Mapping[str, float]) -> str:  # noqa: D102
        x, y, radius = (values[name] for name in ("at_x", "at_y", "radius"))
        return f"(x - {x:.2f})^2 + (y - {y:.2f})^2 < {radius:.2f}^2".replace("- -", "+ ")


@final
class Strip(Place):
    """Between two parallel lines."""

    shape = "strip"
    equation = "d(speed)/dt -= deceleration sign(speed) where |x cos(angle) + y sin(angle) - offset| < half_width"
    parameters = (
        Parameter("angle", "rad", -10.0, 10.0, 0.3),
        Parameter("offset", "m", -1e4, 1e4, 1.0),
        Parameter("half_width", "m", 0.05, 100.0, 0.5, neutral=None),
        _DECELERATION,
    )

    def depth(self, parameters: Named, x: Scalar, y: Scalar, context: Context) -> Scalar:  # noqa: D102
        operations = context.operations
        angle = parameters["angle"]
        across = x * operations.cos(angle) + y * operations.sin(angle) - parameters["offset"]
        return parameters["half_width"] - (across * across + 1e-12) ** 0.5

    def starts(self, points: Floats) -> Iterator[tuple[dict[str, float], Floats]]:  # noqa: D102
        for angle in (math.pi * np.arange(_TURNS) / _TURNS).tolist():
            across = points[:, 0] * math.cos(angle) + points[:, 1] * math.sin(angle)
            low, high = np.quantile(across, [0.03, 0.97])
            for offset in np.linspace(low, high, _LINES).tolist():
                for half_width in _HALF_WIDTHS:
                    found = {"angle": angle, "offset": offset, "half_width": half_width}
                    yield found, np.abs(across - offset) < half_width

    def where(self, values: Mapping[str, float]) -> str:  # noqa: D102
        angle, offset, half = (values[name] for name in ("angle", "offset", "half_width"))
        text = f"|{math.cos(angle):.2f} x + {math.sin(angle):.2f} y - {offset:.2f}| < {half:.2f}"
        return text.replace("+ -", "- ").replace("- -", "+ ")
