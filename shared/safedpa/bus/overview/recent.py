"""Counts over the last seconds, in memory that does not grow with the rate."""

from __future__ import annotations

from collections import Counter, deque

__all__ = ["RECENT_SECONDS", "Recent"]

RECENT_SECONDS = 10.0
"""s; shares and rates are told over so long: long enough for a share of a percent, short enough to be the present."""
_SLICE_SECONDS = 0.5


class Recent:
    """How often each kind of thing happened within the last ``seconds``, kept in slices of half a second."""

    def __init__(self, seconds: float = RECENT_SECONDS) -> None:
        self._seconds = seconds
        self._slices: deque[tuple[float, Counter[str]]] = deque()
        self._first: float | None = None

    def add(self, kind: str, at: float) -> None:
        """One more of ``kind`` at the time ``at`` [s], which does not run backwards."""
        if self._first is None:
            self._first = at
        begin = at - at % _SLICE_SECONDS
        if not self._slices or self._slices[-1][0] < begin:
            self._slices.append((begin, Counter()))
        self._slices[-1][1][kind] += 1
        self._drop(at)

    def counts(self, now: float) -> Counter[str]:
        """The counts by kind within the last seconds before ``now`` [s]."""
        self._drop(now)
        total: Counter[str] = Counter()
        for _, counted in self._slices:
            total.update(counted)
        return total

    def share(self, kind: str, now: float) -> float:
        """count(kind) / count(all); 0 while nothing was counted."""
        counted = self.counts(now)
        return counted[kind] / counted.total() if counted else 0.0

    def rate(self, now: float) -> float:
        """Everything counted over the time in which it was, in 1/s; 0 while that is shorter than a slice."""
        counted = self.counts(now).total()
        span = min(self._seconds, now - self._first) if self._first is not None else 0.0
        return counted / span if span >= _SLICE_SECONDS else 0.0

    def _drop(self, now: float) -> None:
        while self._slices and self._slices[0][0] <= now - self._seconds:
            self._slices.popleft()
