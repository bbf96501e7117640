"""Cuts the times of a log where its clock goes back or is set, in the order of the file.

Rows are never sorted across such a cut. Within a segment, rows that are late by less than half a second are sorted.
Read ``judge_clock`` first.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import BoolArray, FloatArray

__all__ = ["MAX_LATE", "Clock", "judge_clock", "late_rows"]

MAX_LATE = 0.5
"""s; a time that is further behind the one before it belongs to another segment, or is wrong."""
_MAX_AWAY = 100
"""Messages after which a clock that was interrupted by another one counts as another segment."""
_DENSER = 1.5
"""Rows are denser by this factor where a clock that was set back runs over the same times again."""
_EVEN = 0.3
"""Largest deviation of a usual step, as a share of it."""
_FEW = 3
"""Fewer single rows than this that are late by less than a period are a clock that was set back a little."""
_MAX_CUTS = 100
"""Cuts that are looked for one by one; each takes a pass over the times."""
_MAX_CHAINS = 8
"""Chains that a run of times may continue."""


@dataclass(frozen=True)
class Clock:
    """The judgement of one clock."""

    segment: NDArray[np.intp]
    """Number of the segment of each row, in the order of the file, shape (rows,)."""
    wrong: BoolArray
    """Rows whose time fits none of the times around it, such as 0 or a year ahead, shape (rows,)."""

    @property
    def cuts(self) -> NDArray[np.intp]:
        """The first row of each segment but the first."""
        return np.flatnonzero(np.diff(self.segment) != 0) + 1


@dataclass
class _Chain:
    """Runs of consecutive rows [start, stop) whose times continue each other."""

    runs: list[tuple[int, int]]
    weight: float

    @property
    def first(self) -> int:
        return self.runs[0][0]

    @property
    def last(self) -> int:
        return self.runs[-1][1] - 1

    @property
    def rows(self) -> NDArray[np.intp]:
        return np.concatenate([np.arange(*run) for run in self.runs])


def judge_clock(t: FloatArray, reference: FloatArray | None = None, weight: FloatArray | None = None) -> Clock:
    """Judges times [s] in the order of the file.

    Consecutive times are linked if they go back by at most ``MAX_LATE``, and forward by at most that or five usual
    steps. With a second clock ``reference``, they are also linked if both clocks make the same step, within
    ``MAX_LATE``, or if ``t`` makes a shorter one. Linked times form chains. Of chains that overlap in the file the one
    of more ``weight`` (default: rows) is right, and the rows of the other are wrong. Chains that follow each other are
    segments if time goes back between them or, with a reference, if it jumps.
    """
    timed = np.flatnonzero(np.isfinite(t))
    segment, wrong = np.zeros(len(t), dtype=np.intp), np.zeros(len(t), dtype=bool)
    if len(timed) < 2:
        return Clock(segment, wrong)
    own = t[timed]
    other = None if reference is None else reference[timed]
    steps = np.diff(own)
    usual = _usual_step(own if other is None else other)
    linked = _linked(steps, None if other is None else np.diff(other), max(MAX_LATE, 5.0 * usual))
    if linked.all() or (other is None and (steps >= -MAX_LATE).all()):
        kept = [_Chain([(0, len(own))], 1.0)]
    else:
        chains = _chains(own, other, linked, usual, np.ones(len(own)) if weight is None else weight[timed])
        kept = _not_overlapping(chains)
    found = np.full(len(own), -1, dtype=np.intp)
    number = -1
    for place, chain in enumerate(kept):
        rows = chain.rows
        number += place == 0 or _is_cut(own, other, kept[place - 1], chain)
        inner = _set_back(own[rows], usual)
        found[rows] = number + np.searchsorted(inner, np.arange(len(rows)), side="right")
        number += len(inner)
    wrong[timed] = found < 0
    right = timed[found >= 0]
    # rows without a right time belong to the segment of the row before them
    before = np.maximum(np.searchsorted(right, np.arange(len(t)), side="right") - 1, 0)
    segment[:] = found[found >= 0][before]
    return Clock(segment, wrong)


def late_rows(t: FloatArray, segment: NDArray[np.intp]) -> tuple[BoolArray, float]:
    """Rows whose time is before one in front of them in their segment, and the largest such delay [s]."""
    late, largest = np.zeros(len(t), dtype=bool), 0.0
    bounds = np.concatenate([[0], np.flatnonzero(np.diff(segment)) + 1, [len(t)]])
    for start, stop in pairwise(bounds):
        part = t[start:stop]
        behind = np.fmax.accumulate(part) - part if len(part) else part
        late[start:stop] = behind > 0.0
        largest = max(largest, float(np.nanmax(behind, initial=0.0)))
    return late, largest


def _usual_step(t: FloatArray) -> float:
    """Median step forward [s]; if two clocks alternate, it is that of every second or third row."""
    found = []
    for lag in (1, 2, 3):
        steps = t[lag:] - t[:-lag]
        forward = steps[steps > 0.0]
        if len(forward):
            found.append(float(np.median(forward)) / lag)
    return min(found, default=0.0)


def _linked(steps: FloatArray, other: FloatArray | None, longest: float) -> BoolArray:
    """Whether a step of one clock, and of the other one if there is one, continues a chain."""
    found = (steps >= -MAX_LATE) & (steps <= longest)
    if other is not None:
        found |= np.abs(steps - other) <= MAX_LATE
        found |= (steps >= 0.0) & (steps <= other + MAX_LATE)
    return np.asarray(found)


def _chains(
    t: FloatArray, other: FloatArray | None, linked: BoolArray, usual: float, weight: FloatArray
) -> list[_Chain]:
    """Joins runs of linked rows to chains: a run continues the newest chain whose last time it fits."""
    breaks = np.flatnonzero(~linked) + 1
    starts, stops = np.concatenate([[0], breaks]), np.concatenate([breaks, [len(t)]])
    reference = np.zeros(len(t)) if other is None else other
    ends = [values.tolist() for values in (t[starts], t[stops - 1], reference[starts], reference[stops - 1])]
    weights = np.add.reduceat(weight, starts).tolist()
    longest = max(MAX_LATE, 5.0 * usual)
    chains: list[_Chain] = []
    active: list[tuple[_Chain, float, float]] = []
    """With the last time of each on both clocks."""
    runs = zip(starts.tolist(), stops.tolist(), *ends, weights, strict=True)
    for start, stop, first, last, first_other, last_other, own in runs:
        for place in range(len(active) - 1, -1, -1):
            chain, before, before_other = active[place]
            step, other_step = first - before, first_other - before_other
            # as in _linked, for one step
            fits = -MAX_LATE <= step <= longest
            if not fits and other is not None:
                fits = abs(step - other_step) <= MAX_LATE or 0.0 <= step <= other_step + MAX_LATE
            if fits and start - chain.last <= _MAX_AWAY:
                del active[place]
                break
        else:
            chain = _Chain([], 0.0)
            chains.append(chain)
        active = [*active[1 - _MAX_CHAINS :], (chain, last, last_other)]
        chain.runs.append((start, stop))
        chain.weight += own
    return chains


def _not_overlapping(chains: list[_Chain]) -> list[_Chain]:
    """The heavier of chains that overlap in the file, in the order of the file."""
    kept: list[_Chain] = []
    for chain in sorted(chains, key=lambda one: one.first):
        if kept and chain.first < kept[-1].last:
            if chain.weight <= kept[-1].weight:
                continue
            kept.pop()
        kept.append(chain)
    return kept


def _is_cut(t: FloatArray, other: FloatArray | None, before: _Chain, after: _Chain) -> bool:
    """Whether the clock was set between two chains; if not, rows are missing between them."""
    step = t[after.first] - t[before.last]
    return bool(step < 0.0 or (other is not None and step > other[after.first] - other[before.last] + MAX_LATE))


def _set_back(t: FloatArray, usual: float) -> NDArray[np.intp]:
    """Rows at which the clock was set back by less than ``MAX_LATE``: it runs over the same times again.

    It then goes on in usual steps, also past the latest time before. Rows that are late instead fill a hole in the
    times before them, so that they are as dense there as elsewhere, and a longer step follows.
    """
    cuts: list[int] = []
    start = 0
    behind = np.maximum.accumulate(t) > t
    while behind.any():
        if len(cuts) == _MAX_CUTS:  # a cut is always safe, and these are found at once
            return np.concatenate([cuts, start + 1 + np.flatnonzero(np.diff(t[start:]) < 0.0)]).astype(np.intp)
        part = t[start:]
        top = np.maximum.accumulate(part)
        behind = part < top
        edges = np.diff(np.concatenate([[False], behind, [False]]).astype(np.int8))
        begins, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
        small = (ends - begins == 1) & (top[begins] - part[begins] < usual)
        jitter = small.sum() >= _FEW
        for begin, end, minor in zip(begins.tolist(), ends.tolist(), small.tolist(), strict=True):
            goes_on = _moves_on(part, begin, end, usual) or _is_denser(part, begin, end, float(top[begin]), usual)
            if goes_on and not (minor and jitter):
                start += begin
                cuts.append(start)
                break
        else:
            break
    return np.array(cuts, dtype=np.intp)


def _moves_on(t: FloatArray, begin: int, end: int, usual: float) -> bool:
    """Whether the rows from ``begin`` to ``end``, and the one after them, follow each other in usual steps."""
    steps = np.diff(t[begin : end + 1])
    return bool(end < len(t) and np.all(np.abs(steps - usual) <= _EVEN * usual))


def _is_denser(t: FloatArray, begin: int, end: int, top: float, usual: float) -> bool:
    """Whether the rows from ``begin`` to ``end``, which are behind ``top``, make the times there denser than usual."""
    low = float(t[begin:end].min())
    around = t[max(0, begin - 10 * (end - begin) - 10) : end]
    count = int(((around >= low) & (around <= top)).sum())
    return count > _DENSER * ((top - low) / usual + 1.0) if usual > 0.0 else False
