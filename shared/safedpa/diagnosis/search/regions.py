"""Places where the floor brakes, written as effects so that they are fitted like any other: a circle, a strip.

A place where the floor brakes: no effect of the library, but what an engineer would look for on the map.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.comparison.where import PLACE
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.residual_inputs import residual_inputs
from safedpa.diagnosis.fit.trial import EffectTrial, block_gain, fit_trial, with_effect_at
from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.friction import REST_SPEED, direction_of
from safedpa.effects.parameter import Parameter
from safedpa.operations import Scalar

__all__ = [
    "CircularRegion",
    "RegionEffect",
    "RegionFit",
    "StripRegion",
    "best_region",
    "clip_outliers",
    "share_one_area",
]

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
"""Strips next to each other in each direction."""

_DECELERATION = Parameter("deceleration", "m/s2", -10.0, 10.0, 1.0)


class RegionEffect(RateEffect):
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
    def starts(self, points: FloatArray) -> Iterator[tuple[dict[str, float], FloatArray]]:
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
class CircularRegion(RegionEffect):
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

    def starts(self, points: FloatArray) -> Iterator[tuple[dict[str, float], FloatArray]]:  # noqa: D102
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
class StripRegion(RegionEffect):
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

    def starts(self, points: FloatArray) -> Iterator[tuple[dict[str, float], FloatArray]]:  # noqa: D102
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


_SURE = 2.0
"""Standard errors of gain on unseen blocks: few blocks lie in one place, so they are never many."""
_AHEAD = 2.0
"""Standard errors by which it has to be better than the best effect of the library."""
_LITTLE = 0.03
"""Fall of the logarithm of the held-out residual, mean over the states, that is worth a place."""
_FEWEST = 8
"""Windows inside."""
_FEWEST_OF_A_RUN = 3
_TOUCHED = 0.01
"""Of the most that a place explains in a window, from which a window counts as inside."""
_MOST = 0.7
"""Share of the windows inside: what is nearly everywhere is no place."""


@dataclass(frozen=True)
class RegionFit:
    """The place that explains most, fitted like an effect."""

    place: RegionEffect
    trial: EffectTrial
    gain: float
    share: float
    """Of the remaining squared error."""

    @property
    def values(self) -> dict[str, float]:
        """Its parameters by name, SI."""
        settings = self.trial.fit.model.settings
        return {p.name: settings[f"{self.place.name}.{p.name}"].value for p in self.place.parameters}

    @property
    def expression(self) -> str:
        """The formula in one line."""
        values = self.values
        size = values["deceleration"]
        sign = "-" if size > 0 else "+"
        return f"d(speed)/dt {sign}= {abs(size):.2g} sign(speed) where {self.place.where(values)}"

    def beats(self, effect: EffectTrial, shooting: Shooting) -> bool:
        """Whether it predicts unseen blocks clearly better than an effect of the library."""
        return self.trial.loss < effect.loss - _LITTLE and block_gain(effect, self.trial, shooting) > _AHEAD


def clip_outliers(pushes: FloatArray) -> FloatArray:
    """Pushes (windows, ...) cut at what glitches alone exceed.

    Six medians or the 90 % quantile of the sizes, whichever is larger: where a fifth of the windows is pushed hard and
    the rest not at all, the median knows nothing of the hard ones.
    """
    size = np.abs(pushes)
    most = np.maximum(6.0 * np.median(size, axis=0), np.quantile(size, 0.9, axis=0)) + 1e-9
    return np.clip(pushes, -most, most)


def best_region(null: EffectTrial, shooting: Shooting) -> RegionFit | None:
    """The best circle or strip, or None where there is no plane or no place that unseen blocks confirm."""
    names = shooting.windows.system.state_names
    if not {*PLACE, "speed"} <= set(names) or len(shooting.windows) < 30 or not share_one_area(shooting):
        return None
    middle = shooting.measured[:, shooting.measured.shape[1] // 2]
    points, signs = middle[:, [names.index(name) for name in PLACE]], np.sign(middle[:, names.index("speed")])
    along = clip_outliers(residual_inputs(null, shooting, ("speed",))[:, 0]) * signs
    robot = shooting.windows.system.name
    shapes = [(item, _start(item, points, along)) for item in (CircularRegion(robot), StripRegion(robot))]
    found = [_fitted(item, start, null, shooting) for item, start in shapes if start]
    retained = [
        patch
        for patch in found
        if patch.gain >= _SURE and patch.trial.loss <= null.loss - _LITTLE and _in_most_runs(patch, null, shooting)
    ]
    return min(retained, key=lambda patch: patch.trial.loss, default=None)


def share_one_area(shooting: Shooting) -> bool:
    """Whether the runs may be of one room: the places where they were overlap, directly or by way of other runs."""
    windows = shooting.windows
    at = [windows.system.state_names.index(name) for name in PLACE]
    points = shooting.measured[:, shooting.measured.shape[1] // 2][:, at]
    boxes = [np.quantile(points[windows.run == run], [0.02, 0.98], axis=0) for run in np.unique(windows.run)]
    reached, left = boxes[:1], boxes[1:]
    while left:
        near = [box for box in left if any(_overlap(box, other) for other in reached)]
        if not near:
            return False
        reached, left = [*reached, *near], [box for box in left if not any(box is one for one in near)]
    return True


def _overlap(one: FloatArray, other: FloatArray) -> bool:
    return bool((one[0] <= other[1]).all() and (other[0] <= one[1]).all())


def _in_most_runs(patch: RegionFit, null: EffectTrial, shooting: Shooting) -> bool:
    """Whether most of the runs that were in the place are predicted better with it: a floor is the same for all."""
    inside = (patch.trial.explained**2).sum(axis=1) > _TOUCHED * float((patch.trial.explained**2).sum(axis=1).max())
    better = ((null.heldout - patch.trial.heldout) / null.fit.scale**2).sum(axis=1)
    runs = shooting.windows.run
    there = [run for run in np.unique(runs) if int((inside & (runs == run)).sum()) >= _FEWEST_OF_A_RUN]
    return sum(float(better[inside & (runs == run)].sum()) > 0 for run in there) > 0.5 * len(there) or not there


def _fitted(item: RegionEffect, start: dict[str, float], null: EffectTrial, shooting: Shooting) -> RegionFit:
    trial = fit_trial(null, [item], shooting, [with_effect_at(null.fit.model, item, start)])
    ratio = (trial.heldout.sum(axis=0) / null.heldout.sum(axis=0)).mean()
    return RegionFit(item, trial, block_gain(null, trial, shooting), float(1.0 - ratio))


def _start(item: RegionEffect, points: FloatArray, along: FloatArray) -> dict[str, float] | None:
    """The place and deceleration that explain most of the pushes along the motion (windows,)."""
    best, found = 0.0, None
    for place, inside in item.starts(points):
        count = int(inside.sum())
        if not _FEWEST <= count <= _MOST * len(points):
            continue
        size = float(along[inside].sum()) / count
        if size * size * count > best:
            best = size * size * count
            found = {**place, "deceleration": float(np.clip(-size, -9.0, 9.0))}
    return found
