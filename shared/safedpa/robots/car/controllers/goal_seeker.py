"""The goal seeker: drives to its goal and ignores obstacles, which are left to the safety filter; compiled by mypyc.

It follows an arc to the goal (pure pursuit). With the goal at distance d and bearing b from the heading,

    steer = atan(2 wheelbase sin(b) / d),   target_speed = min(cruise, approach d) max(cos(b), slow)

``GoalSeeker`` is a state machine with recovery behaviours:

- make_room: the car would circle a goal inside its turning circle (radius wheelbase / tan(steer limit)) forever, so it
  first reverses with the wheels turned away. After three attempts it detours past the goal instead, on alternating
  sides.
- back_off: without progress (the filter holds it, or a wall) it reverses by a distance, not for a time, because a car
  with a load is slow in reverse. If it is held in reverse too, it first turns the wheels the other way.
- detour: then it heads to one side of the goal, to the other side the next time. If the goal is abeam or behind, it
  turns round in several moves instead, always to the same side.

``InverseDynamicsGoalSeeker`` compensates a towed load, so that the loaded car behaves like the unloaded one. Let v be
the state entry that an action entry u controls (the speed, for a target speed). The nominal model moves it to v+ under
u. With the estimated latent z the model is v+ = f_v(x, z) + g_v(x, z) u', so u' = (v+ - f_v) / g_v has the same effect
with the load, within the bounds. ``ThrottledGoalSeeker`` inverts the model for the throttle of a car without a speed
servo.

Source of pure pursuit: Coulter, CMU-RI-TR-92-01, 1992.
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


@dataclass(frozen=True)
class GoalSeekerSettings:
    """Settings of the goal seeker: SI units, radians."""

    wheelbase: float = 0.32
    steer_limit: float = 0.34
    cruise_speed: float = 1.6
    reverse_speed: float = -0.5
    slowest_target: float = -0.6
    fastest_target: float = 2.0
    """Limits of the speed command when a load is compensated."""
    lookahead: float = 1.2
    """m; upper bound of the distance in pure pursuit, so that the car turns towards a far goal at once."""
    approach_gain: float = 1.5
    """1/s; target speed per metre to the goal."""
    slowest_share: float = 0.35
    """Least share of the speed, when the goal is abeam or behind."""
    patience_seconds: float = 1.0
    """After this time without progress the car backs off."""
    headway: float = 0.12
    """m within the patience that count as progress."""
    reverse_headway: float = 0.04
    """The same in reverse, where a load is slow to move."""
    back_off_seconds: float = 1.4
    """Least time of backing off, unless the car makes no progress in reverse either."""
    back_off_way: float = 0.6
    """m to back off at the first attempt; twice and three times as much at the next two."""
    back_off_longest: float = 5.0
    """s; longest time for each such distance."""
    room_seconds: float = 4.0
    """Longest time of make_room; then something is behind the car, and it tries a detour."""
    rooms: int = 3
    """Number of make_room attempts per goal; after that, each is followed by a detour, as the obstruction persists."""
    turning_bearing: float = 1.3
    """rad; for a goal at a larger bearing the car turns round in several moves."""
    turning_moves: int = 6
    """Largest number of such moves per goal; then it tries detours."""
    reach: float = 0.2
    """m; a goal this far inside the turning circle still counts as reachable."""
    detour_seconds: float = 1.6
    detour_bearing: float = 1.0
    """rad between the direction of a detour and the goal."""

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
        """The current behaviour: seek, make_room, back_off or detour."""
        return self._mode.value

    def nominal_action(self, time: float, state: tuple[float, ...], goal: tuple[float, ...]) -> tuple[float, float]:
        """Returns target speed [m/s] and steer [rad] at robot time [s] for state (x, y, yaw, speed) and goal (x, y)."""
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
        """Leaves make_room: seeks the goal if room was ``made`` and attempts are left, otherwise takes a detour."""
        self._rooms += made
        if made and self._rooms <= self.settings.rooms:
            self._enter(_Mode.SEEK, time)
            return
        self._attempts += 1
        if made and self._attempts % 2 == 0:
            self._side = -self._side
        self._enter(_Mode.DETOUR, time + self.settings.detour_seconds * (min(self._attempts, 4) if made else 1))

    def _choose_side(self, bearing: float) -> None:
        """Chooses the side to which the nose turns while backing off, and whether the car turns round."""
        self._turns_round = abs(bearing) > self.settings.turning_bearing and self._moves < self.settings.turning_moves
        if self._turns_round:
            self._moves += 1
            self._side = _side_of(bearing)
            return
        self._attempts += 1
        self._side = _side_of(bearing) if self._attempts == 1 else -self._side

    def _is_back(self, time: float, x: float, y: float) -> bool:
        """Returns whether the car has backed off long and far enough."""
        way = math.hypot(x - self._held_at[0], y - self._held_at[1])
        return time >= self._earliest and way >= self.settings.back_off_way * self._persistence

    @property
    def _persistence(self) -> int:
        return 1 if self._turns_round else min(self._attempts, 3)

    def _enter(self, mode: _Mode, ends: float, earliest: float = 0.0) -> None:
        self._mode, self._mode_ends, self._earliest, self._turned_over = mode, ends, earliest, False
        self._history.clear()

    def _outside_circle(self, distance: float, bearing: float) -> float:
        """Returns the distance [m] of the goal from the turning circle on its side; negative inside."""
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
"""m/s of target speed; step of the finite difference."""
_WEAKEST = 1e-3
"""Below this sensitivity d(v+)/du the action does not control the speed, and the nominal action is not changed."""

_GAIN: Final = 3.0
"""1/s; gain of the speed controller."""
_MOST: Final = 2.0
"""m/s2; largest acceleration that it requests."""
_BOUNDS: Final = (-1.0, 1.0)
"""Bounds of the throttle."""


@final
class SpeedCompensation:
    """Replaces the target speed of a nominal action by the one with the same effect under the estimated latent."""

    def __init__(self, model: PhysicsModel) -> None:
        self.model = model
        self._nominal = model.latent
        self._nominal_entries: list[float] = model.latent.tolist()
        self._speed = model.system.state_names.index("speed")
        self._target = model.system.action_names.index("target_speed")

    def target(self, state: Sequence[float], nominal: Sequence[float], latent: Sequence[float]) -> float:
        """Returns the compensated target speed [m/s], over plain floats."""
        loaded, unloaded, hold = self._speeds(state, nominal, latent)
        asked = nominal[self._target]
        return asked + (unloaded - loaded) / hold if hold > _WEAKEST else asked

    def _speeds(
        self, state: Sequence[float], nominal: Sequence[float], latent: Sequence[float]
    ) -> tuple[float, float, float]:
        """Returns the speed after the nominal action with and without load, and its derivative with load.

        Both code paths below, scalar and array, give bit-identical results, so that runs stay reproducible no matter
        when the scalar step becomes available.
        """
        nudged = list(nominal)
        nudged[self._target] += _NUDGE
        step, speed = self.model.scalar_step(self.model.period), self._speed
        if step is not None:
            with contextlib.suppress(ValueError, ArithmeticError):  # the array path below handles these values
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
    """The goal seeker with compensation of a towed load by the estimated latent."""

    def __init__(self, model: PhysicsModel, settings: GoalSeekerSettings) -> None:
        self._compensation = SpeedCompensation(model)
        self._settings = settings
        self._seeker = GoalSeeker(settings)

    def nominal_action(self, state: StateMessage, latent: NDArray[np.float64] | None) -> tuple[tuple[float, ...], str]:
        """Returns target speed [m/s] and steer [rad], and a name with the behaviour, such as ``goal_seeker:seek``."""
        if len(state.values) != 4 or len(state.goal) != 2:
            raise MessageError(f"state: got {len(state.values)} values and a goal of {len(state.goal)}, wanted 4 and 2")
        values = self._seeker.nominal_action(state.robot_time, state.values, state.goal)
        if latent is not None and self._compensation.model.system.is_plausible_floats(state.values):
            self._compensation.model.clock.seconds = state.robot_time
            speed = self._compensation.target(state.values, values, latent.tolist())
            values = min(max(speed, self._settings.slowest_target), self._settings.fastest_target), values[1]
        return values, f"goal_seeker:{self._seeker.mode}"


@final
class ThrottledGoalSeeker:
    """The goal seeker for a car with a throttle.

    The target speed gives an acceleration clip(3/s (target - speed), +-2 m/s2), and the model with the newest latent is
    inverted for the throttle.
    """

    def __init__(self, model: PhysicsModel, settings: GoalSeekerSettings) -> None:
        self._model, self._seeker = model, GoalSeeker(settings)

    def nominal_action(self, state: StateMessage, latent: NDArray[np.float64] | None) -> tuple[tuple[float, ...], str]:
        """Returns throttle and steer [rad], and a name with the behaviour, such as ``goal_seeker:seek``."""
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
