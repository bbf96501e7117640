"""A place where the floor brakes: no effect of the library, but what an engineer would look for on the map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from safedpa.diagnosis.pushes import pushes_of
from safedpa.diagnosis.shooting import Shooting
from safedpa.diagnosis.trial import Trial, block_gain, tried, with_start
from safedpa.diagnosis.where import PLACE
from safedpa.diagnosis.windows import Floats
from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.friction import REST_SPEED, direction_of
from safedpa.effects.parameter import Parameter

__all__ = ["Patch", "best_patch"]

_SURE = 2.0
"""Standard errors of gain on unseen blocks: few blocks lie in one place, so they are never many."""
_AHEAD = 2.0
"""Standard errors by which it has to be better than the best effect of the library."""
_LITTLE = 0.03
"""Fall of the logarithm of the held-out residual, mean over the states, that is worth a place."""
_EDGE = 0.1
"""m over which the resistance sets in."""
_RADII = (0.5, 0.8, 1.2, 1.7)
"""m"""


@final
class _Place(RateEffect):
    """d(speed)/dt -= deceleration sign(speed) inside a circle; its edge is rounded off."""

    name = "place"
    robot = "car"
    stage = Stage.WEIGHT
    equation = "d(speed)/dt -= deceleration sign(speed) where |(x, y) - (at_x, at_y)| < radius"
    parameters = (
        Parameter("at_x", "m", -1e4, 1e4, 1.0),
        Parameter("at_y", "m", -1e4, 1e4, 1.0),
        Parameter("radius", "m", 0.1, 100.0, 1.0, neutral=None),
        Parameter("deceleration", "m/s2", -10.0, 10.0, 1.0),
    )
    signature = "a map of the residual"
    source = "Coulomb friction of a floor covering"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:
        operations, state = context.operations, context.state
        dx, dy = state["x"] - parameters["at_x"], state["y"] - parameters["at_y"]
        distance = (dx * dx + dy * dy + 1e-12) ** 0.5
        inside = 0.5 + 0.5 * operations.tanh((parameters["radius"] - distance) / _EDGE)
        pull = parameters["deceleration"] * inside
        # the sign's rounding off needs a size: what is usual
        return {**rates, "speed": rates["speed"] - pull * direction_of(state["speed"], 1.0, REST_SPEED, context)}


@dataclass(frozen=True)
class Patch:
    """The circle that explains most, fitted like an effect."""

    trial: Trial
    gain: float
    share: float
    """Of the remaining squared error."""

    @property
    def expression(self) -> str:
        """The formula in one line."""
        settings = self.trial.fit.model.settings
        x, y, radius, size = (settings[f"place.{p.name}"].value for p in _Place.parameters)
        return (
            f"d(speed)/dt {'-' if size > 0 else '+'}= {abs(size):.2g} sign(speed) "
            f"where (x - {x:.2f})^2 + (y - {y:.2f})^2 < {radius:.2f}^2"
        )

    def beats(self, effect: Trial, shooting: Shooting) -> bool:
        """Whether it predicts unseen blocks clearly better than an effect of the library."""
        return self.trial.loss < effect.loss - _LITTLE and block_gain(effect, self.trial, shooting) > _AHEAD


def best_patch(null: Trial, shooting: Shooting) -> Patch | None:
    """The best circle, or None where there is no plane or no circle that unseen blocks confirm."""
    names = shooting.windows.system.state_names
    if not {*PLACE, "speed"} <= set(names) or len(shooting.windows) < 30:
        return None
    start = _start(null, shooting, [names.index(name) for name in PLACE], names.index("speed"))
    if start is None:
        return None
    item = _Place()
    trial = tried(null, [item], shooting, [with_start(null.fit.model, item, start)])
    gain = block_gain(null, trial, shooting)
    if gain < _SURE or trial.loss > null.loss - _LITTLE:
        return None
    before = (null.heldout.sum(axis=0) / null.heldout.sum(axis=0)).sum()
    after = (trial.heldout.sum(axis=0) / null.heldout.sum(axis=0)).sum()
    return Patch(trial, gain, float(1.0 - after / before))


def _start(null: Trial, shooting: Shooting, place: list[int], speed: int) -> dict[str, float] | None:
    """Centre, radius and deceleration that explain most of the windows' pushes along the motion."""
    pushes = pushes_of(null, shooting, ("speed",))[:, 0]
    middle = shooting.measured[:, shooting.measured.shape[1] // 2]
    signs = np.sign(middle[:, speed])
    points, target = middle[:, place], pushes - 0.0
    spread = np.median(np.abs(target)) * 6 + 1e-9
    target = np.clip(target, -spread, spread)
    best, found = 0.0, None
    for centre in _centres(points):
        distance = np.linalg.norm(points - centre, axis=1)
        for radius in _RADII:
            inside = distance < radius
            count = int(inside.sum())
            if count < 8 or count > 0.7 * len(points):
                continue
            size = float((target[inside] * signs[inside]).sum()) / count
            gain = size * size * count
            if gain > best:
                values = (float(centre[0]), float(centre[1]), radius, float(np.clip(-size, -9.0, 9.0)))
                best, found = gain, dict(zip([p.name for p in _Place.parameters], values, strict=True))
    return found


def _centres(points: Floats) -> Floats:
    low, high = np.quantile(points, [0.03, 0.97], axis=0)
    sides = [np.linspace(low[i], high[i], 18) for i in range(2)]
    return np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
