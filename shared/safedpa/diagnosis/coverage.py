"""Coverage: the range of each state and action in the recordings, and gaps in it.

Blocks of time decide which effects are added. A part of a range with less than one block of data decided nothing:
models that agree on both sides of it may differ inside, where the fitted model extrapolates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.comparison.where import POSITION
from safedpa.diagnosis.fit.multiple_shooting import block_seconds
from safedpa.diagnosis.report_schema import CoverageGap, CoveredRange
from safedpa.records.run import Run
from safedpa.systems import System, Variable

# Equal parts of a range: finer ones would show gaps by chance.
_PARTS = 10
# Largest distance between two covered parts, in parts, that is no gap: one empty part is interpolated from both sides.
_NARROW = 2


def coverage_of(runs: Sequence[Run]) -> tuple[CoveredRange, ...]:
    """Returns the covered range and its gaps for each action and each state except positions and angles.

    A range ends where less than half a block of time lies beyond, or where its outer parts (of ten) contain less than a
    block each. A gap is two or more such parts in a row.
    """
    if not runs:
        return ()
    system, block = runs[0].system, block_seconds(runs)
    table = np.concatenate([np.column_stack([states, actions]) for run in runs for _, states, actions in run.parts()])
    seconds = np.concatenate([np.full(len(states), run.period) for run in runs for _, states, _ in run.parts()])
    chosen = [
        (index, variable) for index, variable in enumerate((*system.state, *system.action)) if _is_reported(variable)
    ]
    found = [_covered(variable, table[:, index], seconds, block) for index, variable in chosen]
    return tuple(item for item in found if item is not None)


def _is_reported(variable: Variable) -> bool:
    return variable.name not in POSITION and not variable.angle


def _covered(variable: Variable, values: FloatArray, seconds: FloatArray, block: float) -> CoveredRange | None:
    """Returns the range of one variable; None if it is constant or the data are too few for a block in each part."""
    order = np.argsort(values, kind="stable")
    values, elapsed = values[order], np.cumsum(seconds[order])
    whole = float(elapsed[-1])
    ends = np.searchsorted(elapsed, (0.5 * block, whole - 0.5 * block))
    low, high = (float(values[min(int(end), len(values) - 1)]) for end in ends)
    # Twice the time that ten parts of one block need: with less, gaps are inevitable and mean nothing.
    if not high > low or whole < 2.0 * block * _PARTS:
        return None
    edges = np.linspace(low, high, _PARTS + 1)
    # searchsorted is exclusive on the right: without this the largest value would be in no part.
    edges[-1] = np.nextafter(high, np.inf)
    seconds_in_part = np.diff(np.concatenate([[0.0], elapsed])[np.searchsorted(values, edges)])
    covered = np.flatnonzero(seconds_in_part >= block)
    if not len(covered):
        return None
    gaps = [
        CoverageGap(float(edges[one + 1]), float(edges[other]), float(seconds_in_part[one + 1 : other].sum()))
        for one, other in pairwise(covered.tolist())
        if other - one > _NARROW
    ]
    first, last = float(edges[covered[0]]), float(edges[covered[-1] + 1])
    return CoveredRange(variable.name, variable.unit, first, last, whole, tuple(gaps))


def within_coverage(
    coverage: Sequence[CoveredRange], system: System, states: FloatArray, actions: FloatArray
) -> NDArray[np.bool_]:
    """Returns which rows of states (rows, states) and actions (rows, actions) are inside all ranges and no gap."""
    names = (*system.state_names, *system.action_names)
    table: Mapping[str, Any] = dict(zip(names, np.column_stack([states, actions]).T, strict=True))
    found = np.ones(len(states), dtype=bool)
    for item in coverage:
        values = table[item.variable]
        found &= (values >= item.low) & (values <= item.high)
        for gap in item.gaps:
            found &= ~((values >= gap.low) & (values < gap.high))
    return found
