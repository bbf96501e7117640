"""What is used of the recordings: each of them once, and of long ones parts, evenly spread.

A recording given twice would count as evidence twice; and hours of logs make a page no clearer than minutes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from safedpa.records.run import Finding, Run, Stretch

__all__ = ["first_seconds", "subsample_runs", "without_duplicates"]

_SHORTEST, _LONGEST = 5.0, 10.0
"""s; the longer a piece, the less counts an actuator's unknown past at its beginning; the shorter, the more pieces
tell of the whole log."""
_HORIZONS = 3.0
"""Horizons that fit into the shortest piece at least."""


def subsample_runs(runs: Sequence[Run], most_rows: int, horizon: float = 1.0) -> list[Run]:
    """The runs as they are, or every n-th piece of 5 to 10 s of each, with about ``most_rows`` rows in all.

    Pieces hold three horizons at least. The first piece of each run is kept, so time counts from where it did; of more
    runs than there is room for pieces every n-th run is kept, three at least.
    """
    rows = sum(len(part) for run in runs for part in run.stretches)
    if rows <= most_rows:
        return list(runs)
    room = max(3, most_rows // max(_shortest(run, horizon) for run in runs))
    retained = list(runs)[:: -(-len(runs) // room)]
    rows = sum(len(part) for run in retained for part in run.stretches)
    every = max(1, -(-rows // most_rows))
    return [replace(run, stretches=_pieces(run, every, horizon)[::every]) for run in retained]


def _shortest(run: Run, horizon: float) -> int:
    """Rows of the shortest piece."""
    return max(2, round(max(_SHORTEST, _HORIZONS * horizon) / run.period))


def _pieces(run: Run, every: int, horizon: float) -> tuple[Stretch, ...]:
    """Stretches, the long ones cut into pieces of equal length."""
    shortest = _shortest(run, horizon)
    longest = max(shortest, round(_LONGEST / run.period))
    length = max(shortest, min(longest, sum(len(part) for part in run.stretches) // every))
    pieces = []
    for part in run.stretches:
        count = max(1, len(part) // length)
        edges = [part.start + len(part) * number // count for number in range(count + 1)]
        pieces += [Stretch(low, high) for low, high in pairwise(edges)]
    return tuple(pieces)


def first_seconds(runs: Sequence[Run], seconds: float) -> list[Run]:
    """The first ``seconds`` of each run; the first stretch of each is kept whole up to there."""
    retained = []
    for run in runs:
        first = run.t[run.stretches[0].start]
        parts = []
        for part in run.stretches:
            stop = part.start + int((run.t[part.start : part.stop] <= first + seconds).sum())
            if stop > part.start:
                parts.append(Stretch(part.start, stop))
        retained.append(replace(run, stretches=tuple(parts)))
    return retained


_SHARE = 0.5
"""Of the different rows of a run: from there on it is a copy, or a piece of one."""
_FEWEST = 20
"""Different rows, without which nothing is said."""


def without_duplicates(runs: Sequence[Run]) -> tuple[list[Run], list[tuple[str, Finding]]]:
    """The runs without those whose rows an earlier, longer or equal one has already, and what was left out.

    Rows are the same where every state and action is, to the last digit: noise never repeats itself. When they were
    recorded does not count, so a copy with another clock is a copy.
    """
    marks = [_marks(run) for run in runs]
    order = sorted(range(len(runs)), key=lambda index: -len(marks[index]))
    retained: list[int] = []
    found = {}
    for index in order:
        for other in retained:
            same = int(np.isin(marks[index], marks[other]).sum())
            if len(marks[index]) >= _FEWEST and same > _SHARE * len(marks[index]):
                found[index] = other, same
                break
        else:
            retained.append(index)
    findings = [(runs[index].name, _finding(runs[index], runs[found[index][0]], found[index][1])) for index in found]
    return [runs[index] for index in sorted(retained)], sorted(findings, key=lambda item: item[0])


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
        total = total + weight * column  # column by column: the same sum whatever stands next to it
    return np.unique(total)
