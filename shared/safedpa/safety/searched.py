"""The last whole search for the least unsafe action, which a short period has no time for in every tick.

Where no action keeps every condition some seventy are looked at, and a robot that stands in its margin's boundary layer
is in that place for seconds on end. At 20 ticks a second each tick looks anew. A robot of a shorter period looks as
often, and in the ticks between holds what was found, as long as it is no worse than when it was found.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from typing import Final, Protocol, final

from safedpa.safety.conditions import Outcome, Plain

__all__ = ["LASTS", "Searched"]

LASTS: Final = 0.05
"""s after a whole search within which no other is needed."""

_ROUNDING: Final = 1e-6
"""Of that time."""
_WORSE: Final = 0.01
"""Share by which what is missing may have grown since, and the least h fallen."""


class _Posed(Protocol):
    """What is needed of ``Conditions``."""

    def outcome(self, action: Plain) -> Outcome:
        """What the action leads to."""

    def tightest(self, found: Outcome) -> float:
        """Its least residual, as a share of the barrier's scale."""


@final
class Searched:
    """What the last whole search of one robot found; empty at first."""

    def __init__(self) -> None:
        self._action: Sequence[float] = ()
        self._seconds = inf
        """By the robot's clock, of the tick that was searched in."""
        self._tightest = self._least = inf
        """Least residual as a share of the barrier's scale, and least h, that were predicted then."""
        self.said = ""
        """What a verdict has to say beyond the barriers that are not kept."""

    def note(self, conditions: _Posed, found: Outcome, seconds: float, said: str) -> None:
        """Remembers what a search at ``seconds`` found."""
        self._action, self._seconds, self.said = found.action, seconds, said
        self._tightest, self._least = conditions.tightest(found), found.least

    def still(self, conditions: _Posed, seconds: float) -> Outcome | None:
        """What the action found leads to now; None where it was found too long ago, or not before now, or is worse now.

        Worse: it misses a condition by more than a hundredth more of its scale, or leads to an h that is lower by more
        than a hundredth, or below 0.
        """
        since = seconds - self._seconds
        if not 0.0 < since < (1.0 - _ROUNDING) * LASTS:
            return None
        now = conditions.outcome(self._action)
        if not (now.usable and now.least >= (1.0 - _WORSE) * self._least >= 0.0):
            return None
        return now if conditions.tightest(now) >= (1.0 + _WORSE) * self._tightest else None
