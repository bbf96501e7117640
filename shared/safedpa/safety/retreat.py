"""An action that keeps all conditions, brought back towards the wish one entry at a time.

Tangents say how far an action has to go, and where an actuator saturates or h bends they say too much: the action found
keeps all, and one of its entries stands somewhere on a plateau on which it changes nothing. An action that is the
nearest has no entry that could come nearer by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Protocol

from safedpa.safety.conditions import Outcome, Plain
from safedpa.safety.program_rows import Side, within

__all__ = ["STEP", "retreated"]

STEP: Final = 0.1
"""Share of an entry's range that it is tried to come nearer by; what is nearer than that to its wish is left alone."""

_HALVINGS: Final = 5
"""Of the way on which an entry that came nearer by a step is followed."""


class _Foretold(Protocol):
    """What is needed of ``Conditions``."""

    def outcome(self, action: Plain) -> Outcome:
        """What the action leads to."""


def retreated(conditions: _Foretold, sides: tuple[Side, ...], wish: Plain, kept: Outcome) -> Outcome:
    """``kept``, or what keeps all conditions with entries nearer to the ``wish`` (actions,), the furthest first."""
    wanted = within(wish, sides)
    for entry in _far_entries(sides, wanted, kept.action):
        kept = _entry_back(conditions, entry, wanted[entry], sides[entry][2], kept)
    return kept


def _far_entries(sides: Sequence[Side], wanted: Plain, action: Plain) -> list[int]:
    """Those further than a step from what is wanted, the furthest first."""
    far: list[tuple[float, int]] = []
    for index in range(len(sides)):
        away: float = (action[index] - wanted[index]) / sides[index][2]
        if away > STEP or away < -STEP:
            far.append((-abs(away), index))
    far.sort()
    return [index for _, index in far]


def _entry_back(conditions: _Foretold, entry: int, wanted: float, width: float, kept: Outcome) -> Outcome:
    """With this entry as near to what is wanted as keeps all, to a few halvings; ``kept`` if not a step nearer."""
    start: float = kept.action[entry]
    low, high = STEP * width / abs(wanted - start), 1.0
    best = _at(conditions, kept, entry, start + low * (wanted - start))
    if not best.kept:
        return kept
    for _ in range(_HALVINGS):
        share = 0.5 * (low + high)
        tried = _at(conditions, kept, entry, start + share * (wanted - start))
        if tried.kept:
            best, low = tried, share
        else:
            high = share
    return best


def _at(conditions: _Foretold, about: Outcome, entry: int, value: float) -> Outcome:
    action = list(about.action)
    action[entry] = value
    return conditions.outcome(action)
