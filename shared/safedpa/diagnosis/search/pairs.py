"""Pairs of effects: which promise most where no single one passes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np

from safedpa.compare.windows import Floats
from safedpa.diagnosis.fit.shooting import Shooting
from safedpa.diagnosis.fit.trial import Trial, starts_of, tried, with_start
from safedpa.effects import AbstractEffect

__all__ = ["pairs_of"]

_PAIRS = 5
"""Pairs that are fitted at one stage."""


def pairs_of(null: Trial, trials: Sequence[Trial], rest: Sequence[AbstractEffect], shooting: Shooting) -> list[Trial]:
    """The pairs that promise most to first order, fitted."""
    if len(rest) < 2:
        return []
    columns, owners = _displacements(null, rest, shooting)
    order = _promising(null, columns, owners)
    singles = {trial.effects[0]: trial for trial in trials}
    found = []
    for one, other in order[:_PAIRS]:
        trial = tried(null, [rest[one], rest[other]], shooting)
        if trial.loss < min(singles[rest[one].name].loss, singles[rest[other].name].loss):
            found.append(trial)
    return found


def _displacements(null: Trial, rest: Sequence[AbstractEffect], shooting: Shooting) -> tuple[Floats, list[int]]:
    """What each effect at each of its starts changes in the residual: columns (numbers, all starts), and owners."""
    columns, owners = [], []
    for index, item in enumerate(rest):
        models = [with_start(null.fit.model, item, values) for values in starts_of(item)]
        residuals = shooting.residuals([null.fit.model]) if not models else shooting.residuals(models)
        stacked = np.moveaxis(residuals, 0, -1)
        reduced = shooting.eliminated(stacked, null.fit.scale).reshape(-1, len(models))
        columns.append(reduced - null.fit.residual.reshape(-1, 1))
        owners += [index] * len(models)
    return np.concatenate(columns, axis=1).astype(np.float32), owners


def _promising(null: Trial, columns: Any, owners: list[int]) -> list[tuple[int, int]]:
    """Pairs of effects, the one whose best two columns take most squares off the residual first."""
    target: Any = np.asarray(null.fit.residual.reshape(-1), dtype=np.float32)
    if null.fit.columns.shape[-1]:
        known, _ = np.linalg.qr(null.fit.columns.reshape(len(target), -1).astype(np.float32))
        columns, target = columns - known @ (known.T @ columns), target - known @ (known.T @ target)
    columns = columns / (np.linalg.norm(columns, axis=0) + 1e-6)
    slope, gram = -(columns.T @ target), columns.T @ columns
    share = np.maximum(1.0 - gram**2, 1e-3)
    both = (slope[:, None] ** 2 + slope[None] ** 2 - 2 * gram * slope[:, None] * slope[None]) / share
    owner = np.array(owners)
    gains: dict[tuple[int, int], float] = {}
    for one, other in combinations(range(int(owner.max()) + 1), 2):
        part = both[np.ix_(owner == one, owner == other)]
        gains[one, other] = float(part.max())
    return sorted(gains, key=lambda pair: -gains[pair])
