"""How much of a log lies where other logs hold hardly any data: what a model says there is not compared with any."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from safedpa.comparison.windows import Windows
from safedpa.diagnosis.coverage import within_coverage
from safedpa.diagnosis.report_schema import CoveredRange
from safedpa.records.run import Run

__all__ = ["VARIABLES", "reported_windows", "uncovered"]

VARIABLES = ("speed", "throttle")
"""What drives: laws of drive and drag that agree at some pairs of these differ at others."""
_NEAR = 0.05
"""Of each variable's range over all rows (2 to 98 %): rows closer than that, in every variable, are alike."""
_STAYS = 0.9
_LEAST = 1.0
"""s of driving without which a row counts as not covered."""


def uncovered(seen: Sequence[Run], unseen: Run) -> float:
    """Share of the rows of ``unseen`` about which the logs in ``seen`` hold less than a second of driving."""
    from scipy.spatial import cKDTree

    own, others = _rows(unseen), np.concatenate([_rows(run) for run in seen])
    low, high = np.quantile(np.concatenate([own, others]), (0.02, 0.98), axis=0)
    near = np.maximum(_NEAR * (high - low), 1e-9)
    found = cKDTree(others / near).query_ball_point(own / near, 1.0, p=np.inf, return_length=True)
    period = float(np.median([run.period for run in seen]))
    return float((found * period < _LEAST).mean())


def reported_windows(coverage: Sequence[CoveredRange], windows: Windows) -> NDArray[np.bool_]:
    """Windows (windows,) that begin, end and for nine tenths of their rows stay where a report says that it holds."""
    good = within_coverage(coverage, windows.system, windows.states, windows.actions)
    spans = zip(windows.start.tolist(), windows.end.tolist(), strict=True)
    return np.array([good[begin] and good[end] and good[begin : end + 1].mean() >= _STAYS for begin, end in spans])


def _rows(run: Run) -> NDArray[np.float64]:
    """(rows, variables)"""
    names = (*run.system.state_names, *run.system.action_names)
    table = np.concatenate([np.column_stack([states, actions]) for _, states, actions in run.parts()])
    return np.asarray(table[:, [names.index(name) for name in VARIABLES]], dtype=np.float64)
