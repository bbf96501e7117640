"""What another model's margin means for a robot that drives: told before it is used, and brought into force by steps.

A margin epsilon keeps a robot that stands (h does not change) within its conditions only where h >= epsilon / eta. A
wider margin that came at once, where h is less than that, would make every condition infeasible and leave the robot
where it is. So the margin in force rises with the room that there is, for each kind of barrier:

    epsilon[t] = max(epsilon[t-1], min(epsilon of the new model, eta h[t])),   epsilon[0] = the old one,

h[t] the least of the kind. It never falls below the old margin, and standing keeps each condition that it kept before:
if h[t] >= epsilon[t-1] / eta then h[t] >= epsilon[t] / eta. A narrower margin is in force at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf
from typing import final

from safedpa.safety.barrier import AbstractStack

__all__ = ["PhasedMargin", "least_by_kind", "margin_change"]


_STOPS = "at once it would stop the robot here"


def least_by_kind(barriers: AbstractStack, state: Sequence[float]) -> dict[str, float]:
    """The least h of each kind at ``state`` (states,)."""
    h = barriers.heights(state) if barriers.names else []
    return {kind: min(h[row] for row in rows) for kind, rows in barriers.rows.items() if rows}


def margin_change(old: Mapping[str, float], new: Mapping[str, float], h: Mapping[str, float], eta: float) -> str:
    """In words, for each kind: old and new margin, h now, and whether the robot would have to stand; empty: no change.

    A kind that is not in ``h`` has no barrier around the robot now.
    """
    told = [_of_kind(kind, old.get(kind, 0.0), value, h.get(kind, inf), eta) for kind, value in new.items()]
    return "; ".join(sorted((line for line in told if line), key=lambda line: _STOPS not in line))


def _of_kind(kind: str, old: float, new: float, h: float, eta: float) -> str:
    if _shown(old) == _shown(new):
        return ""
    text = f"the margin of {kind} goes from {_shown(old)} to {_shown(new)}"
    if h == inf:
        return text
    text += f" where h is {_shown(h)}"
    if new <= old or new <= eta * h:
        return f"{text}, at once"
    return f"{text}: {_STOPS}, so it rises as h does, all of it from {_shown(new / eta)} on"


def _shown(value: float) -> str:
    return f"{value:.3g}"


@final
class PhasedMargin:
    """The margins between the old ones and those of a new model; ``period`` [s] between two calls of ``rise``."""

    def __init__(self, old: Mapping[str, float], new: Mapping[str, float], eta: float) -> None:
        self._new, self._eta = dict(new), eta
        self._reached = {kind: min(value, old.get(kind, 0.0)) for kind, value in new.items()}
        self.seconds = 0.0
        """Since the new model is used."""

    def rise(self, h: Mapping[str, float], period: float) -> None:
        """One tick of ``period`` [s] on, with the least ``h`` of each kind that there is now."""
        for kind, reached in self._reached.items():
            room = self._eta * h.get(kind, inf)
            self._reached[kind] = max(reached, min(self._new[kind], room))
        self.seconds += period

    @property
    def waiting(self) -> tuple[str, ...]:
        """The kinds whose new margin is not in force yet."""
        return tuple(kind for kind, value in self._new.items() if self._reached[kind] < value)

    def limited(self, watched: Mapping[str, float]) -> dict[str, float]:
        """The margins in force. One that was widened beyond the new one, by errors that were seen, is not held back."""
        return {
            kind: self._reached[kind] if value <= self._new.get(kind, 0.0) else value for kind, value in watched.items()
        }

    @property
    def sentence(self) -> str:
        """For the verdict: which margins are not the full ones yet, and for how long that has been so."""
        told = [f"{kind} {_shown(self._reached[kind])} of {_shown(self._new[kind])}" for kind in self.waiting]
        return f"Not the whole margin for {self.seconds:.1f} s, until h allows: {', '.join(told)}." if told else ""
