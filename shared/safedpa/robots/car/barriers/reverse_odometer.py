"""How far a robot was driven backwards, net of forwards: what its filter remembers of what it tows."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite

from safedpa.bus import StateMessage
from safedpa.errors import InputError
from safedpa.reversing import distance_reversed
from safedpa.robots.car.barriers.trailer import TrailerEnvelope

__all__ = ["ReverseOdometer"]

_LONGEST_GAP = 0.5
"""s without a state, after which no one knows how the robot moved meanwhile."""
_MOST = 1.0
"""m; no load needs a longer way backwards to stand at any angle."""


@dataclass
class ReverseOdometer:
    """w [m], from one state to the next: w+ = clip(w - e'(p+ - p), 0, end), e the heading and p the position before.

    ``end`` is the way after which what is towed may stand at any angle: there is no more to remember. At the start, and
    wherever the robot was not watched, w is unknown and taken to be the most. A robot that counts itself is believed:
    its odometry goes on where a filter dies.
    """

    way: float = _MOST
    _epoch: int = -1
    _tick: int = -1
    _pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    _towed: tuple[float, ...] = ()

    def follow(self, state: StateMessage) -> None:
        """Takes in the next state (x, y, yaw, ...); the same one twice, and one with NaN, change nothing."""
        if (state.epoch, state.tick) == (self._epoch, self._tick) or len(state.values) < 3:
            return
        x, y, yaw = state.values[:3]
        if not isfinite(x + y + yaw):
            return
        ticks = state.tick - self._tick if state.epoch == self._epoch else inf
        most = state.towed[1] if len(state.towed) == 3 else _MOST
        watched = 0 < ticks * state.period <= _LONGEST_GAP and state.towed == self._towed
        if state.distance_reversed >= 0.0:
            self.way = min(state.distance_reversed, most)
        else:
            self.way = distance_reversed(self.way, self._pose, (x, y), most) if watched else most
        self._epoch, self._tick, self._pose, self._towed = state.epoch, state.tick, (x, y, yaw), state.towed

    def reach(self, state: StateMessage) -> TrailerEnvelope | None:
        """What is towed, as the barriers need it; None without. Raises InputError for lengths that are none."""
        if not state.towed:
            return None
        if len(state.towed) != 3 or len(state.footprint) != 3 or len(state.values) != 4:
            raise InputError(
                f"towed: got {len(state.towed)} numbers, wanted 3 (begin, end, reach) of a robot with a footprint"
            )
        begin, end, reach = state.towed
        if not 0.0 <= begin < end:
            raise InputError(f"towed: got the ways {begin} and {end} m, wanted 0 <= begin < end")
        if end > _MOST:
            raise InputError(f"towed: got {end} m until it may stand at any angle, wanted at most {_MOST:g} m")
        most = max(reach - state.footprint[2], 0.0)
        return TrailerEnvelope(begin, end, most, self.way, self._pose) if most > 0.0 else None
