"""Many durations in little memory: a histogram whose percentiles are exact to one bin."""

from __future__ import annotations

from array import array
from typing import final

__all__ = ["Durations"]

_BIN_SECONDS = 1e-5
_BINS = 100_000


@final
class Durations:
    """Counts durations [s] in bins of 10 us up to one second; longer ones stand in the last bin.

    The memory is the same after a second and after a day, which is asked of a process whose memory is watched.
    """

    def __init__(self) -> None:
        self._counts = array("Q", bytes(8 * _BINS))
        self.count = 0
        self.longest = 0.0

    def add(self, seconds: float) -> None:
        """One more; a negative one counts as 0."""
        self._counts[min(max(int(seconds / _BIN_SECONDS), 0), _BINS - 1)] += 1
        self.count += 1
        self.longest = max(self.longest, seconds)

    def percentile(self, share: float) -> float | None:
        """The smallest entry [s] that ``share`` of all do not exceed, rounded up to its bin; None of nothing."""
        wanted, seen = share * self.count, 0
        for index, count in enumerate(self._counts):
            seen += count
            if seen and seen >= wanted:
                return min((index + 1) * _BIN_SECONDS, self.longest)
        return None

    def summary(self) -> dict[str, float | None]:
        """p50, p99, p99.9 and the longest, in microseconds."""
        shares = {"p50": 0.5, "p99": 0.99, "p999": 0.999}
        found = {name: self.percentile(share) for name, share in shares.items()}
        told = {name: None if value is None else round(1e6 * value) for name, value in found.items()}
        return {**told, "longest": round(1e6 * self.longest) if self.count else None}
