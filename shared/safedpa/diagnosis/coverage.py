"""Where a diagnosis holds: the range of each state and action that was driven, and the parts of it that were hardly.

Blocks of time decide what is added. A part of a range in which the recordings hold less than one such block decided
nothing: laws that agree on both sides of it may differ inside, and what the model says there is extrapolated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.comparison.where import PLACE
from safedpa.diagnosis.fit.multiple_shooting import block_seconds
from safedpa.diagnosis.report_schema import CoverageGap, CoveredRange
from safedpa.records.run import Run
from safedpa.systems import System, Variable

__all__ = ["coverage_of", "within_coverage"]

_PARTS = 10
"""Equal parts of a range."""
_NARROW = 2
"""Parts from one that is held to the next, up to which what lies between is told by both sides."""


def coverage_of(runs: Sequence[Run]) -> tuple[CoveredRange, ...]:
    """For each action and each state that is neither a place nor an angle the range that the runs hold, and its gaps.

    A range ends where less than half a block of time lies beyond, or where its last parts of ten hold less than a block
    each. A gap is two such parts side by side or more: what lies on both sides of a narrower one tells of it as well.
    """
    if not runs:
        return ()
    system, block = runs[0].system, block_seconds(runs)
    table = np.concatenate([np.column_stack([states, actions]) for run in runs for _, states, actions in run.parts()])
    seconds = np.concatenate([np.full(len(states), run.period) for run in runs for _, states, _ in run.parts()])
    chosen = [(index, own) for index, own in enumerate((*system.state, *system.action)) if _counts(own)]
    found = [_covered(own, table[:, index], seconds, block) for index, own in chosen]
    return tuple(item for item in found if item is not None)


def _counts(variable: Variable) -> bool:
    return variable.name not in PLACE and not variable.angle


def _covered(variable: Variable, values: FloatArray, seconds: FloatArray, block: float) -> CoveredRange | None:
    """None of a variable that does not change, or of so few data that no part could hold a block."""
    order = np.argsort(values, kind="stable")
    values, past = values[order], np.cumsum(seconds[order])
    whole = float(past[-1])
    ends = np.searchsorted(past, (0.5 * block, whole - 0.5 * block))
    low, high = (float(values[min(int(end), len(values) - 1)]) for end in ends)
    if not high > low or whole < 2.0 * block * _PARTS:
        return None
    edges = np.linspace(low, high, _PARTS + 1)
    edges[-1] = np.nextafter(high, np.inf)
    held = np.diff(np.concatenate([[0.0], past])[np.searchsorted(values, edges)])
    known = np.flatnonzero(held >= block)
    if not len(known):
        return None
    gaps = [
        CoverageGap(float(edges[one + 1]), float(edges[other]), float(held[one + 1 : other].sum()))
        for one, other in pairwise(known.tolist())
        if other - one > _NARROW
    ]
    first, last = float(edges[known[0]]), float(edges[known[-1] + 1])
    return CoveredRange(variable.name, variable.unit, first, last, whole, tuple(gaps))


def within_coverage(
    coverage: Sequence[CoveredRange], system: System, states: FloatArray, actions: FloatArray
) -> NDArray[np.bool_]:
    """Rows (rows,) of states (rows, states) and actions (rows, actions) that lie within every range, in no gap."""
    names = (*system.state_names, *system.action_names)
    table: Mapping[str, Any] = dict(zip(names, np.column_stack([states, actions]).T, strict=True))
    found = np.ones(len(states), dtype=bool)
    for item in coverage:
        own = table[item.variable]
        found &= (own >= item.low) & (own <= item.high)
        for gap in item.gaps:
            found &= ~((own >= gap.low) & (own < gap.high))
    return found
