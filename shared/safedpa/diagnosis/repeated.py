"""The same recording given twice: it would count as evidence twice."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from safedpa.records.run import Finding, Run

__all__ = ["without_repeated"]

_SHARE = 0.5
"""Of the different rows of a run: from there on it is a copy, or a piece of one."""
_FEWEST = 20
"""Different rows, without which nothing is said."""


def without_repeated(runs: Sequence[Run]) -> tuple[list[Run], list[tuple[str, Finding]]]:
    """The runs without those whose rows an earlier, longer or equal one has already, and what was left out.

    Rows are the same where every state and action is, to the last digit: noise never repeats itself. When they were
    recorded does not count, so a copy with another clock is a copy.
    """
    marks = [_marks(run) for run in runs]
    order = sorted(range(len(runs)), key=lambda index: -len(marks[index]))
    kept: list[int] = []
    found = {}
    for index in order:
        for other in kept:
            same = int(np.isin(marks[index], marks[other]).sum())
            if len(marks[index]) >= _FEWEST and same > _SHARE * len(marks[index]):
                found[index] = other, same
                break
        else:
            kept.append(index)
    findings = [(runs[index].name, _finding(runs[index], runs[found[index][0]], found[index][1])) for index in found]
    return [runs[index] for index in sorted(kept)], sorted(findings, key=lambda item: item[0])


def _finding(run: Run, other: Run, same: int) -> Finding:
    text = f"the same recording as {other.name}: {same} of its rows are equal to the last digit; it was used once, "
    return Finding("same_recording", f"{text}for a copy is no further evidence; give each recording once", same)


def _marks(run: Run) -> NDArray[np.float64]:
    """One number for each different row, (different rows,)."""
    parts = [np.concatenate([states, actions], axis=1) for _, states, actions in run.parts()]
    rows = np.concatenate(parts) if parts else np.zeros((0, 1))
    weights = np.random.default_rng(7).uniform(1.0, 2.0, rows.shape[1])
    total = np.zeros(len(rows))
    for weight, column in zip(weights.tolist(), rows.T, strict=True):
        total = total + weight * column  # column by column: the same sum whatever stands beside it
    return np.unique(total)
