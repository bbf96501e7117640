"""Parts of long runs, evenly spread: hours of logs make a page no clearer than minutes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

from safedpa.records.run import Run, Stretch

__all__ = ["excerpt", "heads"]

_PIECE = (5.0, 30.0)
"""s; the longer, the less counts an actuator's unknown past at the beginning."""


def excerpt(runs: Sequence[Run], most_rows: int) -> list[Run]:
    """The runs as they are, or every n-th piece of 5 to 30 s of each, with about ``most_rows`` rows in all.

    The first piece of each run is kept, so time counts from where it did.
    """
    rows = sum(len(part) for run in runs for part in run.stretches)
    if rows <= most_rows:
        return list(runs)
    every = -(-rows // most_rows)
    return [replace(run, stretches=_pieces(run, every)[::every]) for run in runs]


def _pieces(run: Run, every: int) -> tuple[Stretch, ...]:
    """Stretches, the long ones cut into pieces of equal length."""
    shortest, longest = (round(seconds / run.period) for seconds in _PIECE)
    length = max(2, shortest, min(longest, sum(len(part) for part in run.stretches) // every))
    pieces = []
    for part in run.stretches:
        count = max(1, round(len(part) / length))
        edges = [part.start + len(part) * number // count for number in range(count + 1)]
        pieces += [Stretch(low, high) for low, high in pairwise(edges)]
    return tuple(pieces)


def heads(runs: Sequence[Run], seconds: float) -> list[Run]:
    """The first ``seconds`` of each run; the first stretch of each is kept whole up to there."""
    kept = []
    for run in runs:
        first = run.t[run.stretches[0].start]
        parts = []
        for part in run.stretches:
            stop = part.start + int((run.t[part.start : part.stop] <= first + seconds).sum())
            if stop > part.start:
                parts.append(Stretch(part.start, stop))
        kept.append(replace(run, stretches=tuple(parts)))
    return kept
