"""What a car sees around it, as a price of driving there: how much longer a metre takes near what it has to keep from.

Near what is at rest the price rises within a berth; near what may move by itself, or hides, the filter lets the car
drive no faster than it can stand before that is there, so the price is the cruise over that speed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.bus import StateMessage, SurroundingsMessage
from safedpa.operations import NUMPY
from safedpa.robots.car.dynamics.limits import ReversalBraking

__all__ = ["ClearanceSettings", "Clearances", "VisibleObstacles", "visible_obstacles"]


_SPEEDS: Final[FloatArray] = np.linspace(0.0, 2.0, 41)
"""m/s at which it is known what room they need."""
_WEDGE: Final = 1.0
"""m aside for each metre behind the hitch: what hides there hides behind the load, and moves with it."""
_ALONGSIDE_LOAD: Final = 0.5
"""m that the load's own shadow is wider than what it reaches to."""


@final
@dataclass(frozen=True)
class ClearanceSettings:
    """SI units; what the filter will keep, as far as a controller may count on it."""

    cruise: float = 1.6
    room: float = 0.18
    """m to what is at rest: the filter's clearance and margin."""
    berth: float = 0.3
    """m beyond that, in which it costs up to ``grazing`` more."""
    grazing: float = 1.0
    through: float = 20.0
    """A metre where there is no room counts as so many: who got too near still knows which way leads out."""
    inside: float = 30.0
    """s/m on an arc where there is no room, and ..."""
    deeper: float = 400.0
    """s/m more for each metre that lacks."""
    slowest: float = 0.08
    """m/s that is reckoned with near what may move: it gives way, or shows itself, in the end."""
    own_radius: float = 0.12
    """m, of the car itself; what it tows is behind it, where no one who moves is driven into."""
    margin: float = 0.1
    """m to what may move: the filter's clearance and margin."""
    late: float = 0.1
    """s that it goes on meanwhile: one period, and until the action acts."""
    braking: ReversalBraking = field(default_factory=lambda: ReversalBraking(2.0, 2.5, 0.6))


class Clearances(NamedTuple):
    """m to the nearest disc of each kind, from the body's surface; any one shape."""

    rest: FloatArray
    moves: FloatArray
    """From its foremost part, in the direction that it drives in."""


@final
class VisibleObstacles:
    """Discs at rest (n, 3) and discs that may move (m, 3) at ``fastest`` [m/s]; lengths in m."""

    def __init__(
        self, rest: FloatArray, moves: FloatArray, fastest: float, radius: float, settings: ClearanceSettings
    ) -> None:
        self.rest, self.moves, self.settings = rest, moves, settings
        self.radius, self.own_radius = radius, min(settings.own_radius or radius, radius)
        numbers = settings.braking.numbers
        time = np.asarray(ReversalBraking.seconds(_SPEEDS, numbers, NUMPY))
        way = np.asarray(ReversalBraking.distance(_SPEEDS, numbers, NUMPY))
        self._needs = settings.margin + way + fastest * (time + settings.late)

    def to_rest(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """m from a body of the footprint's radius around places (any shape) to what is at rest."""
        return self._to(self.rest, x, y) - self.radius

    def to_moves(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """m from a body of the car's own radius around places (any shape) to what may move."""
        return self._to(self.moves, x, y) - self.own_radius

    def _to(self, discs: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
        """100 m where there is none."""
        if not len(discs):
            return np.full(np.shape(x), 100.0)
        apart_x, apart_y = x[..., np.newaxis] - discs[:, 0], y[..., np.newaxis] - discs[:, 1]
        found: FloatArray = (np.sqrt(apart_x * apart_x + apart_y * apart_y) - discs[:, 2]).min(axis=-1)
        return found

    def fastest_alongside(self, moves: FloatArray) -> FloatArray:
        """m/s that the filter allows with so much room to what may move."""
        found: FloatArray = np.interp(moves, self._needs, _SPEEDS)
        return found

    def price(self, room: Clearances) -> FloatArray:
        """What a second of cruise counts there, 1 or more."""
        own = self.settings
        spare = room.rest - own.room
        still = np.where(spare < 0.0, own.through, 1.0 + own.grazing * np.clip(1.0 - spare / own.berth, 0.0, 1.0))
        speed = np.clip(self.fastest_alongside(room.moves), own.slowest, own.cruise)
        return np.asarray(np.maximum(still, own.cruise / speed))

    def seconds_each_metre(self, room: Clearances, speed: float) -> FloatArray:
        """On an arc that is driven at ``speed`` [m/s] where nothing is in the way: the deeper in what is at rest, the
        longer, so that what leads out is found."""
        own = self.settings
        spare = room.rest - own.room
        still = own.grazing / own.cruise * np.clip(1.0 - spare / own.berth, 0.0, 1.0)
        still = np.where(spare < 0.0, own.inside - own.deeper * spare, still)
        return np.asarray(1.0 / np.clip(self.fastest_alongside(room.moves), min(own.slowest, speed), speed) + still)

    def near(self, x: float, y: float, reach: float) -> VisibleObstacles:
        """What of it begins within ``reach`` [m] of a place."""
        return self._with(
            *(
                discs[np.hypot(discs[:, 0] - x, discs[:, 1] - y) - discs[:, 2] < reach]
                for discs in (self.rest, self.moves)
            )
        )

    def blocked(self, discs: Sequence[tuple[float, float, float]]) -> VisibleObstacles:
        """With more of what is at rest."""
        return self._with(np.vstack([self.rest, np.array(discs, dtype=np.float64).reshape(-1, 3)]), self.moves)

    def _with(self, rest: FloatArray, moves: FloatArray) -> VisibleObstacles:
        made = VisibleObstacles.__new__(VisibleObstacles)
        made.__dict__.update(self.__dict__, rest=rest, moves=moves)
        return made


def visible_obstacles(
    state: StateMessage, seen: SurroundingsMessage, settings: ClearanceSettings
) -> tuple[VisibleObstacles, bool]:
    """What is around a car at ``state``, and whether it sees what is behind it: not behind a load that hides it.

    What hides in the load's shadow follows the load, and stands in no way.
    """
    rest = np.array(seen.points, dtype=np.float64).reshape(-1, 3)
    movers = np.array(seen.movers, dtype=np.float64).reshape(-1, 6)
    hidden = np.array(seen.hidden, dtype=np.float64).reshape(-1, 4)
    sees_behind = True
    if len(state.towed) == 3 and len(hidden):
        shadow = _in_shadow(state, hidden)
        near = np.hypot(hidden[:, 0] - state.values[0], hidden[:, 1] - state.values[1])
        sees_behind = not bool((shadow & (near - hidden[:, 2] < state.footprint[0] + state.towed[2] + 1.0)).any())
        hidden = hidden[~shadow]
    moves = np.vstack([movers[:, :3], hidden[:, :3]])
    speeds = np.concatenate([movers[:, 5], hidden[:, 3]])
    fastest = float(speeds.max()) if len(speeds) else 0.0
    return VisibleObstacles(rest, moves, fastest, state.footprint[2], settings), sees_behind


def _in_shadow(state: StateMessage, places: FloatArray) -> NDArray[np.bool_]:
    """Which ``places`` (n, ...) lie behind the hitch in the wedge that the load may hide."""
    x, y, yaw = state.values[:3]
    cosine, sine = np.cos(yaw), np.sin(yaw)
    along = cosine * (places[:, 0] - x) + sine * (places[:, 1] - y) + state.footprint[0]
    across = cosine * (places[:, 1] - y) - sine * (places[:, 0] - x)
    shadow: NDArray[np.bool_] = (along < 0.0) & (np.abs(across) < _ALONGSIDE_LOAD + state.towed[2] - _WEDGE * along)
    return shadow
