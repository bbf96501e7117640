"""Regions of the floor that brake: a circle or a strip, as effects that are fitted like any other.

They are not in the library of effects. They are what an engineer would look for on a map of the residual. The map shows
residual inputs: the constant rate, window by window, that a model would need to agree with the measurements.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.comparison.where import POSITION
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial, block_gain, fit_trial, with_effect_at
from safedpa.effects import Where
from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.friction import REST_SPEED, direction_of
from safedpa.effects.parameter import Parameter

# Step of the difference quotient: small against any real disturbance, far above rounding.
_STEP = 0.01


@final
class _ConstantRate(RateEffect):
    """d(state)/dt += amount."""

    name = "push"
    robot = ""
    stage = Stage.MOTION
    equation = "d(state)/dt += amount"
    parameters = (Parameter("amount", "1/s", -1e6, 1e6, 1.0),)
    signature = "anything"
    source = "a disturbance that is constant over a window"

    def __init__(self, state: str, robot: str) -> None:
        self.state = state
        self.robot = robot  # type: ignore[misc]

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:
        del context
        return {**rates, self.state: rates[self.state] + parameters["amount"]}


def residual_inputs(trial: EffectTrial, shooting: Shooting, states: Sequence[str]) -> FloatArray:
    """Returns the constant rates (windows, states), in state units per second, by least squares in each window."""
    model = trial.fit.model
    now = shooting.residuals([model])[0]
    columns = []
    for state in states:
        disturbed = with_effect_at(model, _ConstantRate(state, model.system.name), {"amount": _STEP})
        columns.append((shooting.residuals([disturbed])[0] - now) / _STEP)
    reduced = shooting.eliminated(np.stack([now, *columns], axis=-1), trial.fit.scale)
    residual, slopes = reduced[..., 0], reduced[..., 1:]
    # The ridge covers windows in which a rate does not show, for example one with a single counted row.
    gram = np.einsum("wip,wiq->wpq", slopes, slopes) + 1e-9 * np.eye(len(states))
    right = np.einsum("wip,wi->wp", slopes, residual)
    return -np.asarray(np.linalg.solve(gram, right[..., None])[..., 0])


# Width [m] over which the resistance sets in: small against any region worth reporting, smooth enough for a fit.
_EDGE = 0.1
# Grid of starts: neighbouring sizes differ by a factor of about 1.5, which a fit can bridge.
_RADII = (0.5, 0.8, 1.2, 1.7)
_HALF_WIDTHS = (0.25, 0.5, 0.9)
# Centres of circles along each side of the plane: 0.6 m apart on a plane of 10 m, about the smallest radius.
_CENTRES = 18
# Directions of strips, 22.5 degrees apart: a fit rotates the best one by the rest.
_DIRECTIONS = 8
# Parallel strips in each direction: on a floor of 10 m their spacing is below the width of most strips.
_OFFSETS = 24

_DECELERATION = Parameter("deceleration", "m/s2", -10.0, 10.0, 1.0)


class RegionEffect(RateEffect):
    """d(speed)/dt -= deceleration sign(speed) inside a region, whose edge is smoothed over 0.1 m."""

    name = "place"
    robot = ""
    stage = Stage.WEIGHT
    signature = "a map of the residual"
    source = "Coulomb friction of a floor covering"
    shape: ClassVar[str]

    def __init__(self, robot: str = "") -> None:
        self.robot = robot  # type: ignore[misc]

    @abstractmethod
    def starts(self, points: FloatArray) -> Iterator[tuple[dict[str, float], FloatArray]]:
        """Yields regions to try, as parameters without the deceleration, and which points (windows, 2) lie inside."""

    @abstractmethod
    def where(self, values: Mapping[str, float]) -> str:
        """Returns the region as a condition on x and y."""

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        pull = parameters["deceleration"] * Where(self.shape, "", _EDGE).inside(parameters, context)
        # The smoothed sign needs a typical size: 1, the typical value of the deceleration.
        direction = direction_of(context.state["speed"], 1.0, REST_SPEED, context)
        return {**rates, "speed": rates["speed"] - pull * direction}


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

    def starts(self, points: FloatArray) -> Iterator[tuple[dict[str, float], FloatArray]]:  # noqa: D102
        # Quantiles, because a single stray position would stretch the grid.
        low, high = np.quantile(points, [0.03, 0.97], axis=0)
        for at_x in np.linspace(low[0], high[0], _CENTRES).tolist():
            for at_y in np.linspace(low[1], high[1], _CENTRES).tolist():
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

    def starts(self, points: FloatArray) -> Iterator[tuple[dict[str, float], FloatArray]]:  # noqa: D102
        for angle in (math.pi * np.arange(_DIRECTIONS) / _DIRECTIONS).tolist():
            across = points[:, 0] * math.cos(angle) + points[:, 1] * math.sin(angle)
            low, high = np.quantile(across, [0.03, 0.97])
            for offset in np.linspace(low, high, _OFFSETS).tolist():
                for half_width in _HALF_WIDTHS:
                    found = {"angle": angle, "offset": offset, "half_width": half_width}
                    yield found, np.abs(across - offset) < half_width

    def where(self, values: Mapping[str, float]) -> str:  # noqa: D102
        angle, offset, half = (values[name] for name in ("angle", "offset", "half_width"))
        text = f"|{math.cos(angle):.2f} x + {math.sin(angle):.2f} y - {offset:.2f}| < {half:.2f}"
        return text.replace("+ -", "- ").replace("- -", "+ ")


# Standard errors of gain on unseen blocks: low, because only a few blocks lie in one region.
_SURE = 2.0
# Standard errors by which a region has to beat the best effect of the library: as much as it needs by itself.
_LEAD = 2.0
# Decrease of the log held-out residual (mean over the states) that a region needs: grids of hundreds of regions fit
# smaller decreases by chance.
_MIN_DECREASE = 0.03
# Windows inside a region: fewer do not determine a position, a size and a deceleration.
_MIN_WINDOWS = 8
# Windows of a run inside the region for the run to vote: with fewer its sign is chance.
_MIN_WINDOWS_OF_RUN = 3
# A window is inside if the region explains this share of the most that it explains in any window: the smooth edge has
# no exact border.
_INSIDE = 0.01
# Share of windows inside: a region that covers nearly everything is not one, but an effect that acts everywhere.
_MAX_SHARE = 0.7


@dataclass(frozen=True)
class RegionFit:
    """The region that explains most, fitted like an effect."""

    region: RegionEffect
    trial: EffectTrial
    gain: float
    share: float
    """Share of the remaining squared error that it explains."""

    @property
    def values(self) -> dict[str, float]:
        """Its parameters by name, in SI units."""
        settings = self.trial.fit.model.settings
        return {p.name: settings[f"{self.region.name}.{p.name}"].value for p in self.region.parameters}

    @property
    def expression(self) -> str:
        """The formula in one line."""
        values = self.values
        size = values["deceleration"]
        sign = "-" if size > 0 else "+"
        return f"d(speed)/dt {sign}= {abs(size):.2g} sign(speed) where {self.region.where(values)}"

    def beats(self, effect: EffectTrial, shooting: Shooting) -> bool:
        """Returns whether the region predicts unseen blocks clearly better than an effect of the library."""
        return self.trial.loss < effect.loss - _MIN_DECREASE and block_gain(effect, self.trial, shooting) > _LEAD


def clip_outliers(inputs: FloatArray) -> FloatArray:
    """Clips residual inputs (windows, ...) at six medians or the 90 % quantile of their sizes, whichever is larger.

    The quantile matters if a fifth of the windows has a large input and the rest none: the median does not show it.
    """
    size = np.abs(inputs)
    most = np.maximum(6.0 * np.median(size, axis=0), np.quantile(size, 0.9, axis=0)) + 1e-9
    return np.clip(inputs, -most, most)


def best_region(null: EffectTrial, shooting: Shooting) -> RegionFit | None:
    """Returns the best circle or strip; None if the state has no position or unseen blocks confirm no region."""
    names = shooting.windows.system.state_names
    # Thirty windows: below that a region with eight windows inside is most of the data.
    if not {*POSITION, "speed"} <= set(names) or len(shooting.windows) < 30 or not share_one_area(shooting):
        return None
    middle = shooting.measured[:, shooting.measured.shape[1] // 2]
    points, signs = middle[:, [names.index(name) for name in POSITION]], np.sign(middle[:, names.index("speed")])
    along = clip_outliers(residual_inputs(null, shooting, ("speed",))[:, 0]) * signs
    robot = shooting.windows.system.name
    shapes = [(item, _start(item, points, along)) for item in (CircularRegion(robot), StripRegion(robot))]
    found = [_fit_region(item, start, null, shooting) for item, start in shapes if start]
    retained = [
        fit
        for fit in found
        if fit.gain >= _SURE and fit.trial.loss <= null.loss - _MIN_DECREASE and _in_most_runs(fit, null, shooting)
    ]
    return min(retained, key=lambda fit: fit.trial.loss, default=None)


def share_one_area(shooting: Shooting) -> bool:
    """Returns whether the runs may share one room: their areas overlap, directly or through other runs."""
    windows = shooting.windows
    at = [windows.system.state_names.index(name) for name in POSITION]
    points = shooting.measured[:, shooting.measured.shape[1] // 2][:, at]
    boxes = [np.quantile(points[windows.run == run], [0.02, 0.98], axis=0) for run in np.unique(windows.run)]
    connected, remaining = boxes[:1], boxes[1:]
    while remaining:
        adjacent = [box for box in remaining if any(_overlap(box, other) for other in connected)]
        if not adjacent:
            return False
        remaining = [box for box in remaining if not any(box is one for one in adjacent)]
        connected = [*connected, *adjacent]
    return True


def _overlap(one: FloatArray, other: FloatArray) -> bool:
    return bool((one[0] <= other[1]).all() and (other[0] <= one[1]).all())


def _in_most_runs(region_fit: RegionFit, null: EffectTrial, shooting: Shooting) -> bool:
    """Returns whether most runs that entered the region are predicted better with it: a floor is the same for all."""
    inside = (region_fit.trial.explained**2).sum(axis=1) > _INSIDE * float(
        (region_fit.trial.explained**2).sum(axis=1).max()
    )
    better = ((null.heldout - region_fit.trial.heldout) / null.fit.scale**2).sum(axis=1)
    runs = shooting.windows.run
    entered = [run for run in np.unique(runs) if int((inside & (runs == run)).sum()) >= _MIN_WINDOWS_OF_RUN]
    return sum(float(better[inside & (runs == run)].sum()) > 0 for run in entered) > 0.5 * len(entered) or not entered


def _fit_region(item: RegionEffect, start: dict[str, float], null: EffectTrial, shooting: Shooting) -> RegionFit:
    trial = fit_trial(null, [item], shooting, [with_effect_at(null.fit.model, item, start)])
    ratio = (trial.heldout.sum(axis=0) / null.heldout.sum(axis=0)).mean()
    return RegionFit(item, trial, block_gain(null, trial, shooting), float(1.0 - ratio))


def _start(item: RegionEffect, points: FloatArray, along: FloatArray) -> dict[str, float] | None:
    """Returns the region and deceleration that explain most of the inputs ``along`` the motion (windows,)."""
    best, found = 0.0, None
    for region, inside in item.starts(points):
        count = int(inside.sum())
        if not _MIN_WINDOWS <= count <= _MAX_SHARE * len(points):
            continue
        size = float(along[inside].sum()) / count
        # count * mean^2 is the squares that a constant deceleration inside removes.
        if size * size * count > best:
            best = size * size * count
            found = {**region, "deceleration": float(np.clip(-size, -9.0, 9.0))}
    return found
