"""Where a fit of the base's own free numbers may start: fits that start far off get stuck, and nobody is told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from safedpa.compare.windows import Floats
from safedpa.diagnosis.fit.least_squares import bounds_of, fit, moved, objectives, size_of
from safedpa.diagnosis.fit.shooting import Shooting
from safedpa.dynamics import PhysicsModel

__all__ = ["best_start"]

_DRAWN = 24
"""Starts beside the given one."""
_TRIED = 2
"""Of them that are fitted."""
_FACTOR = 8.0
"""By which a number may be off to either side."""
_BETTER = 0.02
"""Fall of the objective per independent number from which another start is taken."""
_FAR = 0.5
"""Share of a number by which the given one may be off before weights about it are no good."""
_ROWS = 3
_SEED = 3


def best_start(model: PhysicsModel, free: Sequence[str], shooting: Shooting) -> PhysicsModel:
    """The model with the given numbers, or with clearly better ones; ``shooting`` with weights that no model has made.

    Others are fitted to the first part of each window: nearly a regression of measured rates, which is almost linear
    in most numbers. Over whole windows angles go round and starts far off find another valley; and weights about a
    model that is far off count least what would mend it.
    """
    if not free:
        return model
    short = _first_part(shooting)
    scale = np.maximum(short.residuals([model])[0].std(axis=(0, 1)), 1e-6)
    starts = [model, *(moved(model, dict(zip(free, row, strict=True))) for row in _draws(model, free).tolist())]
    with np.errstate(all="ignore"):
        values = np.nan_to_num(objectives(short.residuals(starts), short, scale), nan=np.inf)
    chosen = [0, *(int(index) for index in np.argsort(values)[:_TRIED] if index)]
    found = [fit(starts[index], free, short, scale).model for index in chosen]
    given = fit(model, free, shooting, scale)
    every = [given, *(fit(near, free, shooting, scale) for near in found)]
    best = min(every, key=lambda item: item.value)
    if best.value < given.value - _BETTER:
        return best.model
    before = np.array([model.settings[path].value for path in free])
    far = (np.abs(given.values - before) > _FAR * np.abs(before)).any()
    return given.model if far else model


def _first_part(shooting: Shooting) -> Shooting:
    """The first fifth of each window, three compared rows at least."""
    count = max(_ROWS, len(shooting.rows) // 5)
    return replace(
        shooting,
        rows=shooting.rows[:count],
        measured=shooting.measured[:, :count],
        counts=shooting.counts[:, :count],
        tangent=shooting.tangent[:, :count],
    )


def _draws(model: PhysicsModel, free: Sequence[str]) -> Floats:
    """Starts (starts, numbers): typical values, then factors about what is given, within the bounds."""
    random = np.random.default_rng(_SEED)
    now = np.array([model.settings[path].value for path in free])
    typical = np.array([model.parameters[path].typical for path in free])
    about = np.where(np.abs(now) > 0, now, np.array([size_of(model.parameters[path]) for path in free]))
    factors = _FACTOR ** random.uniform(-1.0, 1.0, (_DRAWN - 1, len(free)))
    low, high = bounds_of(model, free)
    signs = np.where((low < 0) & (random.random(factors.shape) < 0.5), -1.0, 1.0)
    return np.asarray(np.clip(np.concatenate([typical[None], about * factors * signs]), low, high))
