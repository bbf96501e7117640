"""What another model's margin means for a robot that drives: told before it is used, and brought into force by steps.

A margin epsilon keeps a robot that stands (h does not change) within its conditions only where h >= epsilon / eta. A
wider margin that came at once, where h is less than that, would make every condition infeasible and leave the robot
where it is. So until all of it is in force, the margin of a kind of barrier takes half of what its least h allows,

    epsilon[t] = max(old, min(new, eta h[t] / 2)),

never less than the old one: the robot may stand wherever it might before, and h may still fall, half as fast. Once
h >= 1.5 new / eta, half as much again as standing takes, the new margin is in force for good. So is a narrower one at
once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf
from typing import Final, final

from safedpa.safety.barriers.base import AbstractBarrierSet

__all__ = ["MarginRamp", "least_by_kind", "margin_change"]


_STOPS = "at once it would stop the robot here"
_SHARE: Final = 0.5
"""Of eta h that the margin takes meanwhile."""
_ROOM: Final = 1.5
"""Of new / eta from which all of it is in force: at 1 the next error would lead below it."""


def least_by_kind(barriers: AbstractBarrierSet, state: Sequence[float]) -> dict[str, float]:
    """The least h of each kind at ``state`` (states,)."""
    h = barriers.heights(state) if barriers.names else []
    return {kind: min(h[row] for row in rows) for kind, rows in barriers.rows.items() if rows}


def margin_change(old: Mapping[str, float], new: Mapping[str, float], h: Mapping[str, float], eta: float) -> str:
    """In words, for each kind: old and new margin, h now, and whether the robot would have to stand; empty: no change.

    A kind that is not in ``h`` has no barrier around the robot now.
    """
    reported = [_of_kind(kind, old.get(kind, 0.0), value, h.get(kind, inf), eta) for kind, value in new.items()]
    return "; ".join(sorted((line for line in reported if line), key=lambda line: _STOPS not in line))


def _of_kind(kind: str, old: float, new: float, h: float, eta: float) -> str:
    if _shown(old) == _shown(new):
        return ""
    text = f"the margin of {kind} goes from {_shown(old)} to {_shown(new)}"
    if h == inf:
        return text
    text += f" where h is {_shown(h)}"
    whole = _ROOM * new / eta
    if new <= old or h >= whole:
        return f"{text}, at once"
    why = _STOPS if new > eta * h else "at once it would leave the robot hardly any room"
    return f"{text}: {why}, so it follows h, all of it from {_shown(whole)} on"


def _shown(value: float) -> str:
    return f"{value:.3g}"


@final
class MarginRamp:
    """The margins between the old ones and those of a new model; ``period`` [s] between two calls of ``rise``."""

    def __init__(self, old: Mapping[str, float], new: Mapping[str, float], eta: float) -> None:
        self._old, self._new, self._eta = dict(old), dict(new), eta
        self._held = {kind: old.get(kind, 0.0) for kind, value in new.items() if value > old.get(kind, 0.0)}
        """Of the kinds that are not in force as a whole: what is."""
        self.seconds = 0.0
        """Since the new model is used."""

    def rise(self, h: Mapping[str, float], period: float) -> None:
        """One tick of ``period`` [s] on, with the least ``h`` of each kind that there is now."""
        for kind in self.waiting:
            new, allowed = self._new[kind], self._eta * h.get(kind, inf)
            if allowed >= _ROOM * new:
                del self._held[kind]
            else:
                self._held[kind] = max(self._old.get(kind, 0.0), min(new, _SHARE * allowed))
        self.seconds += period

    @property
    def waiting(self) -> tuple[str, ...]:
        """The kinds whose new margin is not in force yet."""
        return tuple(self._held)

    def limited(self, watched: Mapping[str, float]) -> dict[str, float]:
        """The margins in force. One that was widened beyond the new one, by errors that were seen, is not held back."""
        return {
            kind: self._held.get(kind, value) if value <= self._new.get(kind, 0.0) else value
            for kind, value in watched.items()
        }

    @property
    def sentence(self) -> str:
        """For the verdict: which margins are not the full ones yet, and for how long that has been so."""
        reported = [f"{kind} {_shown(held)} of {_shown(self._new[kind])}" for kind, held in self._held.items()]
        return (
            f"Not the whole margin for {self.seconds:.1f} s, until h allows: {', '.join(reported)}." if reported else ""
        )
