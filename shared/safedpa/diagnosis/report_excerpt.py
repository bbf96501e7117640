"""Parts of long runs, evenly spread: hours of logs make a page no clearer than minutes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

from safedpa.records.run import Run, Stretch

__all__ = ["excerpt", "heads"]

_SHORTEST, _LONGEST = 5.0, 10.0
"""s; the longer a piece, the less counts an actuator's unknown past at its beginning; the shorter, the more pieces
tell of the whole log."""
_HORIZONS = 3.0
"""Horizons that fit into the shortest piece at least."""


def excerpt(runs: Sequence[Run], most_rows: int, horizon: float = 1.0) -> list[Run]:
    """The runs as they are, or every n-th piece of 5 to 10 s of each, with about ``most_rows`` rows in all.

    Pieces hold three horizons at least. The first piece of each run is kept, so time counts from where it did; of more
    runs than there is room for pieces every n-th run is kept, three at least.
    """
    rows = sum(len(part) for run in runs for part in run.stretches)
    if rows <= most_rows:
        return list(runs)
    room = max(3, most_rows // max(_shortest(run, horizon) for run in runs))
    kept = list(runs)[:: -(-len(runs) // room)]
    rows = sum(len(part) for run in kept for part in run.stretches)
    every = max(1, -(-rows // most_rows))
    return [replace(run, stretches=_pieces(run, every, horizon)[::every]) for run in kept]


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
