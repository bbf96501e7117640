"""The transition from the margins of one model to those of another: reported before, and ramped while the robot moves.

A margin epsilon lets a stationary robot (h does not change) satisfy its constraints only if h >= epsilon / eta. A wider
margin that applied at once, at a smaller h, would make every constraint infeasible and stop the robot. Until the whole
margin applies, the margin of a kind of barrier is therefore half of what its smallest h allows,

    epsilon[t] = max(old, min(new, eta h[t] / 2)),

never less than the old one: the robot may be stationary wherever it might before, and h may still fall, half as fast.
Once h >= 1.5 new / eta the new margin applies for good. A narrower one applies at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf
from typing import Final, final

from safedpa.safety.barriers.base import AbstractBarrierSet

__all__ = ["MarginRamp", "margin_change", "margin_table", "min_h_by_kind"]


_TABLE_HEAD: Final = ("margin of", "now", "then", "h now", "takes effect")
_APPLIES_AT_ONCE: Final = "at once"
_WOULD_STOP: Final = "at once it would stop the robot here"
_RAMP_SHARE: Final = 0.5
"""Share of eta h that the margin takes meanwhile; the rest lets h fall."""
_FULL_AT: Final = 1.5
"""Multiple of new / eta from which all of it applies: at 1 the next error would lead below it."""


def min_h_by_kind(barriers: AbstractBarrierSet, state: Sequence[float]) -> dict[str, float]:
    """The smallest h of each kind at ``state`` (states,)."""
    h = barriers.h_floats(state) if barriers.names else []
    return {kind: min(h[row] for row in rows) for kind, rows in barriers.rows.items() if rows}


def margin_change(old: Mapping[str, float], new: Mapping[str, float], h: Mapping[str, float], eta: float) -> str:
    """Describes for each kind: old and new margin, h now, and whether the robot would have to stop; empty: no change.

    A kind that is not in ``h`` has no barrier around the robot now.
    """
    reported = [
        f"the margin of {kind} goes from {_format(old.get(kind, 0.0))} to {_format(value)}{_h_phrase(h.get(kind, inf))}"
        f"{_effect_phrase(_takes_effect(old.get(kind, 0.0), value, h.get(kind, inf), eta))}"
        for kind, value in _changed_margins(old, new)
    ]
    # Kinds that would stop the robot come first: an operator reads the beginning of the sentence.
    return "; ".join(sorted(reported, key=lambda line: _WOULD_STOP not in line))


def margin_table(old: Mapping[str, float], new: Mapping[str, float], h: Mapping[str, float], eta: float) -> str:
    """The changes of ``margin_change`` as a table: a line for each kind below one of headings; empty: no change.

    Cells are separated by `` | ``. Margins and h have the unit of the barrier's h.
    """
    rows = []
    for kind, value in _changed_margins(old, new):
        before, now = old.get(kind, 0.0), h.get(kind, inf)
        effect = _takes_effect(before, value, now, eta) or "once such a barrier is near"
        rows.append((kind, _format(before), _format(value), "-" if now == inf else _format(now), effect))
    rows.sort(key=lambda cells: _WOULD_STOP not in cells[-1])
    return "\n".join(" | ".join(cells) for cells in (_TABLE_HEAD, *rows)) if rows else ""


def _changed_margins(old: Mapping[str, float], new: Mapping[str, float]) -> list[tuple[str, float]]:
    # Compared as shown: a change that the operator cannot see is no change.
    return [(kind, value) for kind, value in new.items() if _format(old.get(kind, 0.0)) != _format(value)]


def _h_phrase(h: float) -> str:
    return "" if h == inf else f" where h is {_format(h)}"


def _effect_phrase(effect: str) -> str:
    return effect and (f", {effect}" if effect == _APPLIES_AT_ONCE else f": {effect}")


def _takes_effect(old: float, new: float, h: float, eta: float) -> str:
    """When the new margin applies; empty: no barrier of the kind is around the robot."""
    if h == inf:
        return ""
    full_at = _FULL_AT * new / eta
    # A narrower margin is safe at any h; a wider one only far enough inside.
    if new <= old or h >= full_at:
        return _APPLIES_AT_ONCE
    why = _WOULD_STOP if new > eta * h else "at once it would leave the robot hardly any room"
    return f"{why}, so it follows h, all of it from {_format(full_at)} on"


def _format(value: float) -> str:
    return f"{value:.3g}"


@final
class MarginRamp:
    """The margins between the old ones and those of a new model; call ``rise`` once per tick."""

    def __init__(self, old: Mapping[str, float], new: Mapping[str, float], eta: float) -> None:
        self._old, self._new, self._eta = dict(old), dict(new), eta
        self._limited_to = {kind: old.get(kind, 0.0) for kind, value in new.items() if value > old.get(kind, 0.0)}
        """The present margins of the kinds whose new margin does not apply yet."""
        self.seconds = 0.0
        """Time [s] since the new model is used."""

    def rise(self, h: Mapping[str, float], period: float) -> None:
        """Advances by one tick of ``period`` [s], with the smallest ``h`` of each kind now."""
        for kind in self.waiting:
            new, allowed = self._new[kind], self._eta * h.get(kind, inf)
            # Removed for good: a margin that came and went with h would make h oscillate.
            if allowed >= _FULL_AT * new:
                del self._limited_to[kind]
            else:
                self._limited_to[kind] = max(self._old.get(kind, 0.0), min(new, _RAMP_SHARE * allowed))
        self.seconds += period

    @property
    def waiting(self) -> tuple[str, ...]:
        """The kinds whose new margin does not apply yet."""
        return tuple(self._limited_to)

    def limited(self, online: Mapping[str, float]) -> dict[str, float]:
        """The margins in force. A margin that errors have widened beyond the new one is not limited."""
        return {
            # Errors are newer information than the calibration of the new model.
            kind: self._limited_to.get(kind, value) if value <= self._new.get(kind, 0.0) else value
            for kind, value in online.items()
        }

    @property
    def sentence(self) -> str:
        """Which margins are not complete yet, and for how long; for the verdict."""
        reported = [
            f"{kind} {_format(limited_to)} of {_format(self._new[kind])}"
            for kind, limited_to in self._limited_to.items()
        ]
        return (
            f"Not the whole margin for {self.seconds:.1f} s, until h allows: {', '.join(reported)}." if reported else ""
        )
