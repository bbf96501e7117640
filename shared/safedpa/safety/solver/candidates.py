"""Actions spread over the whole of their range: where else to look when the way from the nominal action leads nowhere.

The last whole search for the least-violation action, which a short period has no time for in every tick.

Where no action satisfies every condition some seventy are looked at, and a robot that stands in its margin's boundary layer
is in that place for seconds on end. At 20 ticks a second each tick looks again. A robot of a shorter period looks as
often, or more, and in the ticks between holds what was found, as long as that breaks no other condition than it did,
and none of them more.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from math import inf
from typing import Final, Protocol, final

from safedpa.safety.solver.constraints import ActionCandidate, Plain
from safedpa.safety.solver.qp_scaling import Side, within

__all__ = [
    "LASTS",
    "NEARBY",
    "HeldSolution",
    "action_grid",
    "grid_around",
]

_POINTS: Final = {1: 9, 2: 5, 3: 3}
"""By the number of actions: how many values of each, where the model is not affine in them."""
_MOST_CORNERS: Final = 4
"""Actions up to which all corners are taken; of more there are too many to be tried within a period."""
NEARBY: Final = (0.24, 0.12, 0.06, 0.03, 0.015, 0.006)
"""Shares of an entry's range by which an action is moved to look about it where tangents do not say what comes of it:
an actuator that saturates has them lead along a plateau and past the ridge that lies across it, and where a robot
stands h may bend."""


def action_grid(sides: tuple[Side, ...], *, affine: bool) -> list[tuple[float, ...]]:
    """Evenly spread actions (actions,), all corners of their range among them; of many actions none.

    Of an ``affine`` model the corners alone: what lies between follows from them.
    """
    if len(sides) > _MOST_CORNERS:
        return []
    points = 2 if affine else _POINTS.get(len(sides), 2)
    return list(product(*[_values(low, high, width, points) for low, high, width in sides]))


def grid_around(sides: tuple[Side, ...], action: Sequence[float], share: float) -> list[tuple[float, ...]]:
    """``action`` with each of its entries moved down and up by this share of its range, as far as the bounds allow."""
    moved: list[tuple[float, ...]] = []
    for index, (_, _, width) in enumerate(sides):
        for step in (-share * width, share * width):
            other = within([*action[:index], action[index] + step, *action[index + 1 :]], sides)
            if other[index] != action[index]:
                moved.append(other)
    return moved


def _values(low: float, high: float, width: float, points: int) -> list[float]:
    return [*[low + width * index / (points - 1) for index in range(points - 1)], high]


LASTS: Final = 0.05
"""s for which an action is in force that one whole search found, at the most."""

_ROUNDING: Final = 1e-6
"""Of that time."""
_WORSE: Final = 0.01
"""Share by which what a condition misses may have grown since, and its h fallen."""


class _SolutionConstraints(Protocol):
    """What is needed of ``Conditions``."""

    def outcome(self, action: Plain) -> ActionCandidate:
        """What the action leads to."""


@final
class HeldSolution:
    """What the last whole search of one robot found; empty at first."""

    def __init__(self) -> None:
        self._found: ActionCandidate | None = None
        self._seconds = self._asked = inf
        """By the robot's clock, of the tick that was searched in, and of the last one."""
        self.notice = ""
        """What a verdict has to say beyond the barriers that are not kept."""

    def note(self, found: ActionCandidate, seconds: float, notice: str) -> None:
        """Remembers what a search at ``seconds`` found."""
        self._found, self._seconds, self._asked, self.notice = found, seconds, seconds, notice

    def still(self, conditions: _SolutionConstraints, sides: Sequence[Side], seconds: float) -> ActionCandidate | None:
        """What the action found leads to now; None where another search is due, or it is worse now.

        Due: the action would be in force for longer than ``LASTS`` by the next tick, or the clock was set back. Worse:
        it breaks a condition that it did not, misses one by a hundredth more, or leads to an h of such a one that is
        lower by a hundredth, or to any h below 0. Each condition is compared with itself: what one barrier is short of
        says nothing of another.
        """
        found, since, step = self._found, seconds - self._seconds, seconds - self._asked
        self._asked = seconds
        if found is None or not 0.0 < since <= (1.0 + _ROUNDING) * LASTS - step:
            return None
        action = tuple(found.action)
        if len(action) != len(sides) or within(action, tuple(sides)) != action:  # of another filter
            return None
        now = conditions.outcome(action)
        return now if now.usable and now.least >= 0.0 and _no_worse(now, found) else None


def _no_worse(now: ActionCandidate, then: ActionCandidate) -> bool:
    """Whether each condition that is broken now was broken then, and by as much."""
    if len(now.residual) != len(then.residual):
        return False
    for row in now.broken:
        if row not in then.broken or now.residual[row] < (1.0 + _WORSE) * then.residual[row]:
            return False
        if now.h_next[row] < (1.0 - _WORSE) * then.h_next[row]:
            return False
    return True
