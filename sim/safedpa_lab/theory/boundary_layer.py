"""What holds in the boundary layer 0 <= h < epsilon / eta, where standing does not satisfy the condition.

With the rise that some action attains, r(x) = max over actions of h(x predicted) - h(x), and e the error of the step,

    h(x+) >= (1 - eta) h(x) + epsilon - e   where the condition can be kept: r(x) >= epsilon - eta h(x),
    h(x+) >= h(x) + r(x) - e                where it cannot: the filter takes the action that attains r(x).

So h stays at 0 or above as long as r(x) >= e in the layer, and with r(x) = 0, where braking only keeps h, errors add
up: h falls by their sum over the stay. The page of the docs on theory proves it. Here both are read off a drive.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from typing import final

from safedpa.errors import InputError


@final
@dataclass(frozen=True)
class Stay:
    """Successive ticks in the layer."""

    ticks: int
    entered: float
    """h at the first of them."""
    least: float
    """The least h of the stay, and of the tick after it."""
    least_rise: float
    """The least of what the chosen actions promised: h predicted - h."""
    errors: float
    """Sum of the errors h predicted - h measured, counted where the model hoped too much."""

    @property
    def fall(self) -> float:
        """By how much h fell below where the stay began; 0 where it did not."""
        return max(0.0, self.entered - self.least)


def stays_in_layer(h_now: Sequence[float], h_next: Sequence[float], depth: Sequence[float]) -> list[Stay]:
    """The stays of one drive: h measured, h predicted for the tick after, and epsilon / eta in force, each (ticks,).

    Raises InputError when they are not of one length.
    """
    if not len(h_now) == len(h_next) == len(depth):
        raise InputError(f"ticks: got {len(h_now)}, {len(h_next)} and {len(depth)} numbers, wanted as many of each")
    found: list[Stay] = []
    start: int | None = None
    for tick in range(len(h_now) + 1):
        within = tick < len(h_now) and h_now[tick] < depth[tick]
        if within and start is None:
            start = tick
        elif not within and start is not None:
            found.append(_stay(h_now, h_next, start, tick))
            start = None
    return found


def _stay(h_now: Sequence[float], h_next: Sequence[float], start: int, stop: int) -> Stay:
    after = h_now[start + 1 : stop + 1]
    errors = (max(0.0, hoped - came) for hoped, came in zip(h_next[start:stop], after, strict=False))
    rises = (hoped - now for hoped, now in zip(h_next[start:stop], h_now[start:stop], strict=True))
    return Stay(stop - start, h_now[start], min(h_now[start : stop + 1]), min(rises), sum(errors))


def least_after(h: float, rises: Sequence[float], errors: Sequence[float], eta: float) -> float:
    """What h is at least after steps that begin at ``h`` >= 0 with these attainable rises and errors, each (steps,).

    In each step h(x+) >= h + r - e, or, where the condition could be kept with an error within its margin, (1 - eta) h:
    the smaller of the two is taken. Raises InputError for lists of different length.
    """
    if len(rises) != len(errors):
        raise InputError(f"steps: got {len(rises)} rises and {len(errors)} errors, wanted as many of each")
    least = inf
    for rise, error in zip(rises, errors, strict=True):
        h = min((1.0 - eta) * h, h + rise - error) if h >= 0.0 else h + rise - error
        least = min(least, h)
    return least
