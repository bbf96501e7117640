"""Driving costs around perceived obstacles: how much longer a metre takes near them.

Near stationary obstacles the cost increases within a margin. Near moving or hidden ones the filter limits the speed
such that the car can stop in time, so the cost is the cruise speed over this limit.
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

_SPEEDS: Final[FloatArray] = np.linspace(0.0, 2.0, 41)
"""m/s; speeds at which the required clearance is tabulated."""
_WEDGE: Final = 1.0
"""Widening of the load's shadow, m to each side per metre behind the hitch."""
_ALONGSIDE_LOAD: Final = 0.5
"""m by which the shadow is wider than the load's reach at the hitch."""


@final
@dataclass(frozen=True)
class ClearanceSettings:
    """Clearances that the filter will enforce, and costs around them; SI units."""

    cruise: float = 1.6
    room: float = 0.18
    """m to stationary obstacles: clearance and margin of the filter."""
    berth: float = 0.3
    """m beyond ``room`` in which the cost factor is up to ``grazing`` larger."""
    grazing: float = 1.0
    through: float = 20.0
    """Cost factor without clearance; finite, so that a car that came too close still knows the way to leave."""
    inside: float = 30.0
    """s/m on an arc without clearance, and ..."""
    deeper: float = 400.0
    """s/m more per metre of missing clearance."""
    slowest: float = 0.08
    """m/s; least speed assumed near movers, because they give way or become visible eventually."""
    own_radius: float = 0.12
    """m; radius of the car itself, used for movers: a towed load is behind the car and cannot hit them."""
    margin: float = 0.1
    """m to movers: clearance and margin of the filter."""
    late: float = 0.1
    """s until an action takes effect: one period plus the dead time."""
    braking: ReversalBraking = field(default_factory=lambda: ReversalBraking(2.0, 2.5, 0.6))


class Clearances(NamedTuple):
    """Distances [m] from the body's surface to the nearest disc of each kind; arrays of the same shape."""

    rest: FloatArray
    moves: FloatArray
    """From the leading part of the body, in the driving direction."""


@final
class VisibleObstacles:
    """Stationary discs (n, 3) and discs (m, 3) that may move at up to ``fastest`` [m/s]; lengths in m."""

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
        """Returns the distance [m] from a body of the footprint's radius at positions (any shape) to discs at rest."""
        return self._to(self.rest, x, y) - self.radius

    def to_moves(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Returns the distance [m] from a body of the car's own radius at positions (any shape) to movers."""
        return self._to(self.moves, x, y) - self.own_radius

    def _to(self, discs: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
        """Returns the distance [m] to the nearest disc; 100 m if there is none."""
        if not len(discs):
            return np.full(np.shape(x), 100.0)
        apart_x, apart_y = x[..., np.newaxis] - discs[:, 0], y[..., np.newaxis] - discs[:, 1]
        found: FloatArray = (np.sqrt(apart_x * apart_x + apart_y * apart_y) - discs[:, 2]).min(axis=-1)
        return found

    def fastest_alongside(self, moves: FloatArray) -> FloatArray:
        """Returns the speed [m/s] that the filter allows at the distances ``moves`` [m] to movers."""
        found: FloatArray = np.interp(moves, self._needs, _SPEEDS)
        return found

    def price(self, room: Clearances) -> FloatArray:
        """Returns the cost factor (>= 1) of a second at cruise speed."""
        own = self.settings
        spare = room.rest - own.room
        still = np.where(spare < 0.0, own.through, 1.0 + own.grazing * np.clip(1.0 - spare / own.berth, 0.0, 1.0))
        speed = np.clip(self.fastest_alongside(room.moves), own.slowest, own.cruise)
        return np.asarray(np.maximum(still, own.cruise / speed))

    def seconds_each_metre(self, room: Clearances, speed: float) -> FloatArray:
        """Returns the cost [s/m] on an arc with free speed ``speed`` [m/s]. Inside a stationary obstacle it increases
        with depth, so that arcs that lead out are preferred."""
        own = self.settings
        spare = room.rest - own.room
        still = own.grazing / own.cruise * np.clip(1.0 - spare / own.berth, 0.0, 1.0)
        still = np.where(spare < 0.0, own.inside - own.deeper * spare, still)
        return np.asarray(1.0 / np.clip(self.fastest_alongside(room.moves), min(own.slowest, speed), speed) + still)

    def near(self, x: float, y: float, reach: float) -> VisibleObstacles:
        """Returns the discs that begin within ``reach`` [m] of a position."""
        return self._with(
            *(
                discs[np.hypot(discs[:, 0] - x, discs[:, 1] - y) - discs[:, 2] < reach]
                for discs in (self.rest, self.moves)
            )
        )

    def blocked(self, discs: Sequence[tuple[float, float, float]]) -> VisibleObstacles:
        """Returns a copy with additional stationary discs."""
        return self._with(np.vstack([self.rest, np.array(discs, dtype=np.float64).reshape(-1, 3)]), self.moves)

    def _with(self, rest: FloatArray, moves: FloatArray) -> VisibleObstacles:
        made = VisibleObstacles.__new__(VisibleObstacles)
        made.__dict__.update(self.__dict__, rest=rest, moves=moves)
        return made


def visible_obstacles(
    state: StateMessage, seen: SurroundingsMessage, settings: ClearanceSettings
) -> tuple[VisibleObstacles, bool]:
    """Returns the obstacles around a car at ``state``, and whether it sees the area behind it.

    A load can hide what is behind it. Hidden discs in the load's shadow are left out of the obstacles, because the
    shadow moves along with the load.
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


def _in_shadow(state: StateMessage, positions: FloatArray) -> NDArray[np.bool_]:
    """Returns which ``positions`` (n, ...) are behind the hitch, in the wedge that the load may hide."""
    x, y, yaw = state.values[:3]
    cosine, sine = np.cos(yaw), np.sin(yaw)
    along = cosine * (positions[:, 0] - x) + sine * (positions[:, 1] - y) + state.footprint[0]
    across = cosine * (positions[:, 1] - y) - sine * (positions[:, 0] - x)
    shadow: NDArray[np.bool_] = (along < 0.0) & (np.abs(across) < _ALONGSIDE_LOAD + state.towed[2] - _WEDGE * along)
    return shadow
