"""The route follower: drives along the fastest route to the goal through the perceived surroundings.

It receives the same surroundings as the filter. A map (``TimeToGoMap``) holds T(pose), the remaining time to the goal
with turning circle and reversing. A metre costs more near stationary obstacles, and near moving or hidden ones as much
more as the filter will slow the car down. In each period arcs of several curvatures and lengths are evaluated, and the
arc with the least

    cost-weighted seconds on the arc + T(its end) + penalty for a change of direction

is chosen. So the car avoids corners that may hide someone, and dead ends from which it would have to reverse: with a
load that hides the area behind it, the filter prevents reversing, and the map accounts for this. If the car makes no
progress anyway, the attempted route counts as blocked for a while. Its actions are not trusted: the safety filter
corrects them.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from math import cos, hypot, inf, sin
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.bus import StateMessage, SurroundingsMessage
from safedpa.dynamics import PhysicsModel
from safedpa.errors import MessageError
from safedpa.robots.car.controllers.goal_seeker import GoalSeekerSettings, SpeedCompensation
from safedpa.robots.car.controllers.route_cost import Clearances, ClearanceSettings, VisibleObstacles, visible_obstacles
from safedpa.robots.car.controllers.time_to_goal import TimeToGoMap

_STEP: Final = 0.15
"""m between evaluated positions on an arc."""
_FEWEST: Final = 3
"""Steps of the shortest arc."""
_NEAR: Final = 3.0
"""m; obstacles farther away are ignored for arcs."""


@final
@dataclass(frozen=True)
class RouteFollowerSettings:
    """Settings of the route follower: SI units, radians."""

    seen: ClearanceSettings = field(default_factory=ClearanceSettings)
    wheelbase: float = 0.32
    steer_limit: float = 0.34
    arcs: int = 11
    steps: int = 8
    """Steps of a forward arc; half as many for a reverse arc."""
    reverse_speed: float = 0.5
    reckoned_reverse_speed: float = 0.15
    """m/s assumed in planning instead, because each change of direction takes time."""
    blind_reverse_speed: float = 0.08
    """m/s assumed in planning when the area behind the car is not visible."""
    over: float = 1.6
    """Requested speed over the planned speed limit near movers; the filter knows the actual limit better."""
    turning_over: float = 1.5
    """s; penalty for a change of driving direction."""
    commits: float = 2.0
    """s; after a change of direction the penalty decreases from three times to its value over this time, so that the
    car does not dither."""
    map_seconds: float = 0.1
    """s between map updates, which alternate between stationary obstacles and movers."""
    patience_seconds: float = 2.5
    headway: float = 0.08
    """m; with less progress within the patience the route counts as blocked ..."""
    closed_seconds: float = 5.0
    closed_radius: float = 0.2


@final
class RouteFollower:
    """The controller of one car; without surroundings it assumes free space."""

    def __init__(self, model: PhysicsModel, settings: RouteFollowerSettings | None = None) -> None:
        self.settings = own = settings or RouteFollowerSettings()
        self._limits = GoalSeekerSettings()
        self._compensation = SpeedCompensation(model)
        self._seen: SurroundingsMessage | None = None
        self._map: TimeToGoMap | None = None
        self._taken, self._moves_next = -inf, False
        self._forwards, self._turned = True, -inf
        self._history: deque[tuple[float, float, float]] = deque()
        self._closed: list[tuple[float, float, float, float]] = []
        """x, y, radius [m], and until when [s]."""
        steers = np.linspace(-own.steer_limit, own.steer_limit, own.arcs)
        self._ahead = _arcs(np.tan(steers) / own.wheelbase, own.steps, 1.0)
        self._back = _arcs(np.tan(steers[::2]) / own.wheelbase, own.steps // 2, -1.0)
        self._steers = steers

    def look(self, seen: SurroundingsMessage | None) -> None:
        """Sets the surroundings for the next state; None keeps the last ones."""
        self._seen = seen if seen is not None else self._seen

    def nominal_action(self, state: StateMessage, latent: NDArray[np.float64] | None) -> tuple[tuple[float, ...], str]:
        """Returns target speed [m/s] and steer [rad]. Raises MessageError for an invalid state."""
        if len(state.values) != 4 or len(state.goal) != 2 or len(state.footprint) != 3:
            raise MessageError(
                f"state: got {len(state.values)} values, a goal of {len(state.goal)} and a footprint of "
                f"{len(state.footprint)} numbers, wanted 4, 2 and 3"
            )
        if not np.isfinite([*state.values, *state.goal, *state.footprint]).all():
            raise MessageError(f"state: got numbers that are not finite in {state.values}, wanted finite ones")
        room, sees_behind = self._around(state)
        way = self._mapped(state, room, sees_behind)
        speed, steer = self._chosen(state, room, way)
        self._watch(state, speed)
        if latent is not None and self._compensation.model.system.is_plausible(np.array(state.values)):
            self._compensation.model.clock.seconds = state.robot_time
            target = self._compensation.target(state.values, (speed, steer), latent.tolist())
            speed = min(max(target, self._limits.slowest_target), self._limits.fastest_target)
        return (speed, steer), f"way_seeker:{'ahead' if self._forwards else 'back'}"

    def _around(self, state: StateMessage) -> tuple[VisibleObstacles, bool]:
        now = state.robot_time
        self._closed = [one for one in self._closed if now < one[3] <= now + self.settings.closed_seconds]
        if self._seen is None:
            empty = np.empty((0, 3))
            return VisibleObstacles(empty, empty, 0.0, state.footprint[2], self.settings.seen), True
        room, sees_behind = visible_obstacles(state, self._seen, self.settings.seen)
        return room.blocked([one[:3] for one in self._closed]), sees_behind

    def _mapped(self, state: StateMessage, room: VisibleObstacles, sees_behind: bool) -> TimeToGoMap:
        own, now = self.settings, state.robot_time
        position, goal = (state.values[0], state.values[1]), (state.goal[0], state.goal[1])
        speeds = own.seen.cruise, own.reckoned_reverse_speed if sees_behind else own.blind_reverse_speed
        if self._map is None or not self._map.holds(position, goal):
            rear, front, radius = state.footprint
            self._map, self._taken = TimeToGoMap(position, goal, (rear, front, radius), room, speeds), now
            return self._map
        if speeds != self._map.speeds:
            self._map.drive_at(*speeds)
        if not 0.0 <= now - self._taken < own.map_seconds:
            self._map.take(room, moves=self._moves_next)
            self._taken, self._moves_next = now, not self._moves_next
        self._map.refine()
        return self._map

    def _chosen(self, state: StateMessage, room: VisibleObstacles, way: TimeToGoMap) -> tuple[float, float]:
        """Returns speed [m/s] and steer [rad] of the best arc."""
        own, near = self.settings, room.near(state.values[0], state.values[1], _NEAR)
        ahead, allowed = self._seconds(state, near, way, self._ahead, own.seen.cruise)
        back, _ = self._seconds(state, near, way, self._back, way.speeds[1])
        lately = max(0.0, 1.0 - abs(state.robot_time - self._turned) / own.commits)
        (back if self._forwards else ahead)[:] += own.turning_over * (1.0 + 2.0 * lately)
        forwards = bool(ahead.min() <= back.min())
        if forwards != self._forwards:
            self._forwards, self._turned = forwards, state.robot_time
        if not self._forwards:
            return -own.reverse_speed, float(self._steers[::2][int(np.argmin(back))])
        best = int(np.argmin(ahead))
        return float(min(own.seen.cruise, own.over * allowed[best])), float(self._steers[best])

    def _seconds(
        self, state: StateMessage, room: VisibleObstacles, way: TimeToGoMap, arcs: FloatArray, speed: float
    ) -> tuple[FloatArray, FloatArray]:
        """Returns the least time [s] to the goal along each of the ``arcs`` (n, steps, 3), and the speed [m/s] allowed
        at its beginning, (n,)."""
        x0, y0, yaw0, _ = state.values
        x = x0 + cos(yaw0) * arcs[..., 0] - sin(yaw0) * arcs[..., 1]
        y = y0 + sin(yaw0) * arcs[..., 0] + cos(yaw0) * arcs[..., 1]
        yaw = yaw0 + arcs[..., 2]
        rear, front, _ = state.footprint
        at = np.array((-rear, 0.5 * (front - rear), front))[:, np.newaxis, np.newaxis]
        body_x, body_y = x + at * np.cos(yaw), y + at * np.sin(yaw)
        rest = room.to_rest(body_x, body_y).min(axis=0)
        leads = slice(1, 3) if arcs[0, 0, 0] > 0.0 else slice(0, 2)
        moves = room.to_moves(body_x[leads], body_y[leads]).min(axis=0)
        seconds = _STEP * np.cumsum(room.seconds_each_metre(Clearances(rest, moves), speed), axis=1)
        total = seconds + way.time(x, y, yaw)
        return total[:, _FEWEST - 1 :].min(axis=1), np.maximum(room.fastest_alongside(moves)[:, 0], 0.3)

    def _watch(self, state: StateMessage, speed: float) -> None:
        """Marks the area ahead as blocked when there was no progress for some time."""
        own, now = self.settings, state.robot_time
        x, y, yaw, _ = state.values
        if self._history and not now >= self._history[-1][0]:
            self._history.clear()
        self._history.append((now, x, y))
        while now - self._history[0][0] > own.patience_seconds:
            self._history.popleft()
        oldest, past_x, past_y = self._history[0]
        if now - oldest < 0.9 * own.patience_seconds or hypot(x - past_x, y - past_y) >= own.headway:
            return
        rear, front, radius = state.footprint
        reach = front + radius + own.closed_radius if speed >= 0.0 else -(rear + radius + own.closed_radius)
        self._closed.append((x + reach * cos(yaw), y + reach * sin(yaw), own.closed_radius, now + own.closed_seconds))
        self._history.clear()


def _arcs(curvatures: FloatArray, steps: int, sign: float) -> FloatArray:
    """Returns x, y [m], yaw [rad] after each step along arcs of ``curvatures`` (n,) [1/m], (n, steps, 3), from 0."""
    way = sign * _STEP * np.arange(1, steps + 1)
    turned = curvatures[:, np.newaxis] * way
    tight = np.where(np.abs(curvatures) < 1e-6, 1e-6, curvatures)[:, np.newaxis]
    return np.stack([np.sin(tight * way) / tight, (1.0 - np.cos(tight * way)) / tight, turned], axis=-1)
