"""A controller that knows its goal and nothing of obstacles: whatever keeps it from hitting them is the filter.

Towards the goal it follows an arc (pure pursuit): with the goal at distance d and bearing b from the heading,

    steer = atan(2 wheelbase sin(b) / d),   target_speed = min(cruise, approach d) max(cos(b), slow)

A goal inside the turning circle of its side (radius wheelbase / tan(steer limit)) would be circled for ever; there it
first makes room, backwards with the wheels turned away; where that has led nowhere three times it passes the goal by,
to one side and then the other. Where it makes no headway (the filter holds it back, or it stands against a wall) it
backs off, by a way and not by a time: a robot that tows is slow in reverse. Then it heads
past the goal's direction to one side, to the other side the next time; but where the goal lies abeam or behind, it
turns round in several moves, always to the same side. Held back again meanwhile, it tries the next thing at once:
backwards first with the wheels turned the other way.
Source of pure pursuit: Coulter, CMU-RI-TR-92-01, 1992.

The goal seeker of the car, whose nominal actions the model with the newest latent turns into what brings them about.

With a speed servo it makes up for a towed load: it drives so that the loaded robot behaves as the unloaded one would.

Let v be the entry of the state that an action's entry u steers directly (the speed, for a target speed). The nominal
model, with the latent at the values of its file, would move it to v+ under the nominal action u. With the estimated latent z the
model says v+ = f_v(x, z) + g_v(x, z) u', so u' = (v+ - f_v) / g_v does the same with load, as far as the bounds allow.

Without a servo a speed controller in between asks the model for the throttle.
"""

from __future__ import annotations

import contextlib
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.bus import StateMessage
from safedpa.dynamics import PhysicsModel
from safedpa.errors import InputError, MessageError
from safedpa.robots.car.dynamics.throttle import throttle_for

__all__ = [
    "GoalSeeker",
    "GoalSeekerSettings",
    "InverseDynamicsGoalSeeker",
    "SpeedCompensation",
    "ThrottledGoalSeeker",
]


@dataclass(frozen=True)
class GoalSeekerSettings:
    """How the goal seeker drives: SI units, radians."""

    wheelbase: float = 0.32
    steer_limit: float = 0.34
    cruise_speed: float = 1.6
    reverse_speed: float = -0.5
    slowest_target: float = -0.6
    fastest_target: float = 2.0
    """Limits of the robot's speed command, within which a load may be made up for."""
    lookahead: float = 1.2
    """m; a goal farther away is steered for as if it were so near: turned towards at once, then straight ahead."""
    approach_gain: float = 1.5
    """1/s; target speed per metre to the goal."""
    slowest_share: float = 0.35
    """Of the speed, where the goal lies abeam or behind."""
    patience_seconds: float = 1.0
    """Without headway for so long, it backs off."""
    headway: float = 0.12
    """m within the patience that count as headway."""
    reverse_headway: float = 0.04
    """The same backwards, where what it tows is slow to move."""
    back_off_seconds: float = 1.4
    """At least, unless it makes no headway backwards either."""
    back_off_way: float = 0.6
    """m from where it was held back that it makes at the first attempt, and as much more at each of the next two."""
    back_off_longest: float = 5.0
    """s for each such way."""
    room_seconds: float = 4.0
    """Longest time to make room; then something is behind it, and it tries a detour."""
    rooms: int = 3
    """How often it makes room for one goal before it takes a detour after each: what hinders it is still there."""
    turning_bearing: float = 1.3
    """rad from the heading to the goal, beyond which it turns round in several moves."""
    turning_moves: int = 6
    """So many at most for one goal; then it tries detours."""
    reach: float = 0.2
    """m; how near the turning circle a goal may lie and is still reached on it."""
    detour_seconds: float = 1.6
    detour_bearing: float = 1.0
    """rad to the side of the goal that a detour heads for."""

    def __post_init__(self) -> None:
        if not (self.steer_limit > 0.0 and self.wheelbase > 0.0 and self.cruise_speed > 0.0 > self.reverse_speed):
            raise InputError(f"goal seeker: got {self}, wanted positive limits and a negative reverse speed")


class _Mode(Enum):
    SEEK = "seek"
    MAKE_ROOM = "make_room"
    BACK_OFF = "back_off"
    DETOUR = "detour"


@dataclass
class GoalSeeker:
    """The controller of one robot; ``nominal`` is called once per period."""

    settings: GoalSeekerSettings = field(default_factory=GoalSeekerSettings)

    def __post_init__(self) -> None:
        self._mode = _Mode.SEEK
        self._mode_ends = self._earliest = 0.0
        self._held_at = (0.0, 0.0)
        self._side = 1.0
        self._attempts = self._moves = self._rooms = 0
        self._turns_round = self._turned_over = False
        self._goal: tuple[float, ...] = ()
        self._history: deque[tuple[float, float, float]] = deque()

    @property
    def mode(self) -> str:
        """What it is about: seek, make_room, back_off or detour."""
        return self._mode.value

    def nominal_action(self, time: float, state: tuple[float, ...], goal: tuple[float, ...]) -> tuple[float, float]:
        """(target_speed [m/s], steer [rad]) at robot time [s] for state (x, y, yaw, speed) and goal (x, y)."""
        x, y, yaw, _ = state
        if goal != self._goal:
            self._goal, self._mode, self._turned_over = goal, _Mode.SEEK, False
            self._attempts = self._moves = self._rooms = 0
            self._history.clear()
        distance = math.hypot(goal[0] - x, goal[1] - y)
        bearing = _wrapped(math.atan2(goal[1] - y, goal[0] - x) - yaw)
        self._change_mode(time, x, y, distance, bearing)
        if self._mode in (_Mode.BACK_OFF, _Mode.MAKE_ROOM):
            side = -self._side if self._turned_over else self._side
            return self.settings.reverse_speed, -side * self.settings.steer_limit
        if self._mode is _Mode.DETOUR:
            bearing = _wrapped(bearing + self._side * self.settings.detour_bearing)
        return self._pursue(distance, bearing)

    def _pursue(self, distance: float, bearing: float) -> tuple[float, float]:
        settings = self.settings
        ahead = min(max(distance, 0.05), settings.lookahead)
        steer = math.atan(2.0 * settings.wheelbase * math.sin(bearing) / ahead)
        if abs(bearing) > math.pi / 2:
            steer = math.copysign(settings.steer_limit, bearing)
        speed = min(settings.cruise_speed, settings.approach_gain * distance)
        speed *= max(math.cos(bearing), settings.slowest_share)
        return speed, max(-settings.steer_limit, min(settings.steer_limit, steer))

    def _change_mode(self, time: float, x: float, y: float, distance: float, bearing: float) -> None:
        stuck, mode = self._is_stuck(time, x, y), self._mode
        outside = self._outside_circle(distance, bearing)
        if stuck and mode in (_Mode.SEEK, _Mode.DETOUR):
            self._choose_side(bearing)
            self._held_at = x, y
            longest = self.settings.back_off_longest * self._persistence
            self._enter(_Mode.BACK_OFF, time + longest, time + self.settings.back_off_seconds)
        elif mode is _Mode.SEEK and outside < -self.settings.reach:
            self._side = _side_of(bearing)
            self._enter(_Mode.MAKE_ROOM, time + self.settings.room_seconds)
        elif mode is _Mode.MAKE_ROOM and (stuck or time >= self._mode_ends or outside > 0.0):
            self._leave_room(time, made=outside > 0.0)
        elif mode is _Mode.BACK_OFF and stuck and not self._turned_over and not self._turns_round:
            self._turned_over = True
            self._history.clear()
        elif mode is _Mode.BACK_OFF and (stuck or time >= self._mode_ends or self._is_back(time, x, y)):
            ahead = 0.0 if self._turns_round else self.settings.detour_seconds * min(self._attempts, 4)
            self._enter(_Mode.SEEK if self._turns_round else _Mode.DETOUR, time + ahead)
        elif mode is _Mode.DETOUR and time >= self._mode_ends:
            self._enter(_Mode.SEEK, time)

    def _leave_room(self, time: float, *, made: bool) -> None:
        """Towards the goal where room was ``made``, unless that has led nowhere so often that it passes the goal."""
        self._rooms += made
        if made and self._rooms <= self.settings.rooms:
            self._enter(_Mode.SEEK, time)
            return
        self._attempts += 1
        if made and self._attempts % 2 == 0:
            self._side = -self._side
        self._enter(_Mode.DETOUR, time + self.settings.detour_seconds * (min(self._attempts, 4) if made else 1))

    def _choose_side(self, bearing: float) -> None:
        """Which way the nose turns while it backs off, and whether it goes on turning afterwards."""
        self._turns_round = abs(bearing) > self.settings.turning_bearing and self._moves < self.settings.turning_moves
        if self._turns_round:
            self._moves += 1
            self._side = _side_of(bearing)
            return
        self._attempts += 1
        self._side = _side_of(bearing) if self._attempts == 1 else -self._side

    def _is_back(self, time: float, x: float, y: float) -> bool:
        """Whether it has backed off for long enough and far enough."""
        way = math.hypot(x - self._held_at[0], y - self._held_at[1])
        return time >= self._earliest and way >= self.settings.back_off_way * self._persistence

    @property
    def _persistence(self) -> int:
        return 1 if self._turns_round else min(self._attempts, 3)

    def _enter(self, mode: _Mode, ends: float, earliest: float = 0.0) -> None:
        self._mode, self._mode_ends, self._earliest, self._turned_over = mode, ends, earliest, False
        self._history.clear()

    def _outside_circle(self, distance: float, bearing: float) -> float:
        """How far the goal lies outside the turning circle of its side [m]; negative inside."""
        radius = self.settings.wheelbase / math.tan(self.settings.steer_limit)
        aside = distance * abs(math.sin(bearing))
        return math.hypot(distance * math.cos(bearing), aside - radius) - radius

    def _is_stuck(self, time: float, x: float, y: float) -> bool:
        self._history.append((time, x, y))
        while self._history[-1][0] - self._history[0][0] > self.settings.patience_seconds:
            self._history.popleft()
        oldest, past_x, past_y = self._history[0]
        watched = time - oldest >= 0.9 * self.settings.patience_seconds
        backwards = self._mode in (_Mode.BACK_OFF, _Mode.MAKE_ROOM)
        headway = self.settings.reverse_headway if backwards else self.settings.headway
        return watched and math.hypot(x - past_x, y - past_y) < headway


def _side_of(bearing: float) -> float:
    return 1.0 if bearing >= 0.0 else -1.0


def _wrapped(angle: float) -> float:
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


_NUDGE = 1e-3
"""m/s of target speed, for the slope."""
_WEAKEST = 1e-3
"""Below this sensitivity d(v+)/du the action has no hold on the speed, and the nominal action stays as it is."""

_GAIN: Final = 3.0
"""1/s; of the speed controller."""
_MOST: Final = 2.0
"""m/s2 that it asks for at most."""
_BOUNDS: Final = (-1.0, 1.0)
"""Of the throttle."""


@final
class SpeedCompensation:
    """Replaces the target speed of a nominal action by the one that has the requested effect under the latent."""

    def __init__(self, model: PhysicsModel) -> None:
        self.model = model
        self._nominal = model.latent
        self._nominal_entries: list[float] = model.latent.tolist()
        self._speed = model.system.state_names.index("speed")
        self._target = model.system.action_names.index("target_speed")

    def compensated(self, state: FloatArray, nominal: FloatArray, latent: FloatArray) -> FloatArray:
        """The nominal action (actions,) with another target speed [m/s], for state (states,) and latent (latents,)."""
        changed = nominal.copy()
        changed[self._target] = self.target(state.tolist(), nominal.tolist(), latent.tolist())
        return changed

    def target(self, state: Sequence[float], nominal: Sequence[float], latent: Sequence[float]) -> float:
        """The target speed alone, over plain numbers."""
        loaded, unloaded, hold = self._speeds(state, nominal, latent)
        asked = nominal[self._target]
        return asked + (unloaded - loaded) / hold if hold > _WEAKEST else asked

    def _speeds(
        self, state: Sequence[float], nominal: Sequence[float], latent: Sequence[float]
    ) -> tuple[float, float, float]:
        """The speed after the nominal action with the load and without, and its slope over the target speed with the load.

        Three steps of the model, which are the same to the last bit on each of its roads: a run repeats itself,
        whenever the straight line of arithmetic is ready.
        """
        nudged = list(nominal)
        nudged[self._target] += _NUDGE
        step, speed = self.model.straight(self.model.period), self._speed
        if step is not None:
            with contextlib.suppress(ValueError, ArithmeticError):  # numbers that the other road answers
                now = self.model.clock.seconds
                loaded = step(state, nominal, latent, now)[speed]
                beyond = step(state, nudged, latent, now)[speed]
                return loaded, step(state, nominal, self._nominal_entries, now)[speed], (beyond - loaded) / _NUDGE
        at, nominal_values, further, known = np.array(state), np.array(nominal), np.array(nudged), np.array(latent)
        memory = self.model.initial_memory(nominal_values, known)
        loaded = self._speed_after(at, nominal_values, memory, known)
        slope = (self._speed_after(at, further, memory, known) - loaded) / _NUDGE
        unloaded = self._speed_after(
            at, nominal_values, self.model.initial_memory(nominal_values, self._nominal), self._nominal
        )
        return loaded, unloaded, slope

    def _speed_after(self, state: FloatArray, nominal: FloatArray, memory: Any, latent: FloatArray) -> float:
        return float(self.model.advance(state, nominal, memory, latent)[0][self._speed])


@final
class InverseDynamicsGoalSeeker:
    """The goal seeker, which makes up for what the robot tows as far as the latent is known."""

    def __init__(self, model: PhysicsModel, settings: GoalSeekerSettings) -> None:
        self._compensation = SpeedCompensation(model)
        self._settings = settings
        self._seeker = GoalSeeker(settings)

    def nominal_action(self, state: StateMessage, latent: NDArray[np.float64] | None) -> tuple[tuple[float, ...], str]:
        """Target speed [m/s] and steer [rad]; the name tells what it is about, such as ``goal_seeker:seek``."""
        if len(state.values) != 4 or len(state.goal) != 2:
            raise MessageError(f"state: got {len(state.values)} values and a goal of {len(state.goal)}, wanted 4 and 2")
        values = self._seeker.nominal_action(state.robot_time, state.values, state.goal)
        if latent is not None and self._compensation.model.system.believes(state.values):
            self._compensation.model.clock.seconds = state.robot_time
            speed = self._compensation.target(state.values, values, latent.tolist())
            values = min(max(speed, self._settings.slowest_target), self._settings.fastest_target), values[1]
        return values, f"goal_seeker:{self._seeker.mode}"


@final
class ThrottledGoalSeeker:
    """The goal seeker; its target speed becomes a nominal acceleration clip(3/s (target - speed), +-2 m/s2), and that,
    by the model with the newest latent, a throttle.
    """

    def __init__(self, model: PhysicsModel, settings: GoalSeekerSettings) -> None:
        self._model, self._seeker = model, GoalSeeker(settings)

    def nominal_action(self, state: StateMessage, latent: NDArray[np.float64] | None) -> tuple[tuple[float, ...], str]:
        """Throttle and steer [rad]; the name tells what it is about, such as ``goal_seeker:seek``."""
        if len(state.values) != 4 or len(state.goal) != 2:
            raise MessageError(f"state: got {len(state.values)} values and a goal of {len(state.goal)}, wanted 4 and 2")
        target, steer = self._seeker.nominal_action(state.robot_time, state.values, state.goal)
        values, wanted = np.array(state.values), min(max(_GAIN * (target - state.values[3]), -_MOST), _MOST)
        throttle = 0.0
        if self._model.system.is_plausible(values):
            self._model.clock.seconds = state.robot_time
            try:
                throttle = throttle_for(self._model, values, steer, wanted, _BOUNDS, latent)
            except InputError as error:
                raise MessageError(f"state: {error}") from error
        return (throttle, steer), f"goal_seeker:{self._seeker.mode}"
