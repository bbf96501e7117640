"""The distance that a robot with a load was driven backwards, net of forward motion; compiled by mypyc."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite

from safedpa.bus import StateMessage
from safedpa.errors import InputError
from safedpa.reversing import distance_reversed
from safedpa.robots.car.barriers.body import TrailerEnvelope

_LONGEST_GAP = 0.5
"""s; after a longer gap between states the motion in between counts as unknown."""
_MOST = 1.0
"""m; after this distance backwards any load may be at any angle."""


@dataclass
class ReverseOdometer:
    """Tracks w [m] from state to state: w+ = clip(w - e'(p+ - p), 0, end), e the heading and p the position before.

    ``end`` is the distance after which the load may be at any angle, so that larger values do not matter. At the start,
    and after a gap in the states, w is unknown and assumed to be ``end``. A value reported by the robot itself takes
    precedence, because it survives a restart of the filter.
    """

    way: float = _MOST
    _epoch: int = -1
    _tick: int = -1
    _pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    _towed: tuple[float, ...] = ()

    def follow(self, state: StateMessage) -> None:
        """Updates w with the next state (x, y, yaw, ...); a repeated state or one with NaN is ignored."""
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
        """Returns the load's envelope for the barriers; None without a load. Raises InputError for invalid lengths."""
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
            raise InputError(f"towed: got {end} m until the load may be at any angle, wanted at most {_MOST:g} m")
        most = max(reach - state.footprint[2], 0.0)
        return TrailerEnvelope(begin, end, most, self.way, self._pose) if most > 0.0 else None
