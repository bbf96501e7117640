"""Selects what is used of recordings: each recording once, and evenly spread pieces of long ones.

A recording given twice would count twice as evidence. Hours of logs make a page no clearer than minutes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from safedpa.records.run import Finding, Run, Stretch

# Length of a piece [s]. In a long piece the unknown actuator state at its start matters less; short pieces cover more
# of the recording.
_SHORTEST, _LONGEST = 5.0, 10.0
# Horizons in the shortest piece: with fewer, most windows would be cut off at its end.
_HORIZONS = 3.0


def subsample_runs(runs: Sequence[Run], most_rows: int, horizon: float = 1.0) -> list[Run]:
    """Returns the runs unchanged, or every n-th piece of 5 to 10 s of each, with about ``most_rows`` rows in total.

    Pieces are at least three horizons long. The first piece of each run is always included, so that time counts from
    the same row. If there are more runs than pieces allowed, every n-th run is used, at least three.
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
    """Returns the number of rows of the shortest piece."""
    return max(2, round(max(_SHORTEST, _HORIZONS * horizon) / run.period))


def _pieces(run: Run, every: int, horizon: float) -> tuple[Stretch, ...]:
    """Returns the stretches of a run, long ones cut into pieces of equal length."""
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
    """Returns the first ``seconds`` of each run."""
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


# Share of a run's distinct rows found in another run, from which it is a copy or a piece of it.
_COPIED_SHARE = 0.5
# Distinct rows below which a run is not compared: a robot at rest repeats its rows.
_MIN_ROWS = 20


def without_duplicates(runs: Sequence[Run]) -> tuple[list[Run], list[tuple[str, Finding]]]:
    """Removes runs whose rows occur in another run of at least the same length; returns the rest and findings.

    Rows are equal if every state and action is equal to the last digit, which measurement noise makes impossible for
    different recordings. Time stamps are ignored, so a copy with another clock is detected.
    """
    hashes = [_row_hashes(run) for run in runs]
    order = sorted(range(len(runs)), key=lambda index: -len(hashes[index]))
    retained: list[int] = []
    found = {}
    for index in order:
        for other in retained:
            same = int(np.isin(hashes[index], hashes[other]).sum())
            if len(hashes[index]) >= _MIN_ROWS and same > _COPIED_SHARE * len(hashes[index]):
                found[index] = other, same
                break
        else:
            retained.append(index)
    findings = [(runs[index].name, _finding(runs[index], runs[found[index][0]], found[index][1])) for index in found]
    return [runs[index] for index in sorted(retained)], sorted(findings, key=lambda item: item[0])


def _finding(run: Run, other: Run, same: int) -> Finding:
    text = f"the same recording as {other.name}: {same} of its rows are equal to the last digit; it was used once, "
    return Finding("same_recording", f"{text}because a copy is not additional evidence; give each recording once", same)


def _row_hashes(run: Run) -> NDArray[np.float64]:
    """Returns one hash value for each distinct row, sorted."""
    parts = [np.concatenate([states, actions], axis=1) for _, states, actions in run.parts()]
    rows = np.concatenate(parts) if parts else np.zeros((0, 1))
    weights = np.random.default_rng(7).uniform(1.0, 2.0, rows.shape[1])
    total = np.zeros(len(rows))
    for weight, column in zip(weights.tolist(), rows.T, strict=True):
        # Column by column: a matrix product may round differently depending on the neighbouring rows.
        total = total + weight * column
    return np.unique(total)
