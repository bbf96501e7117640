"""Stopping manoeuvres: h is the clearance to hazards while a robot stops, and the distance in which a servo brakes.

``StoppingBarrier`` is for a robot with thrust along its heading, which stops and then holds against the wind.

With the acceleration that would end the motion (thrust and turn rate are the only inputs):

    wanted = -velocity / time - (wind - drag velocity)
    thrust acceleration = clip(wanted . heading, +-strongest)
    turn = clip(gain angle from heading, or its opposite, to wanted, +-fastest)

it turns its nose, or its tail, into the direction of the required thrust, pushes as far as its heading allows, and ends
at rest against the wind. h_i is the smallest distance to hazard i along the manoeuvre, less its radius; of nose-first
and tail-first the one with more clearance to the nearest hazard counts. The manoeuvre's own action lowers no h_i, for
all hazards at once, so the constraints can always be satisfied together. Source: the backup control barrier function of
Gurriet, Mote, Singletary, Feron, Ames, A Scalable Safety Critical Control Framework for Nonlinear Systems, IEEE Access
2020.

The manoeuvre of one robot is also computed in Python floats, in a tenth of the time of arrays with one entry.

``Braking`` is the guaranteed braking of a speed servo, by which barriers of obstacles and walls look ahead.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, cos, expm1, isfinite, sin, sqrt
from typing import Any, Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.operations import FLOATS, Operations, Scalar
from safedpa.safety.barriers.base import AbstractBarrier

__all__ = [
    "ALIKE",
    "ENDS",
    "NUDGE",
    "Braking",
    "Motion",
    "StoppingBarrier",
    "minimum_clearances",
    "nearer_end",
    "stop_seconds",
    "stopping_action",
    "stopping_distance",
    "stopping_path",
    "stopping_room",
]


# A step of 0.04 s is short against the 0.15 s in which the velocity ends, and long enough for 40 steps to be fast.
STEP_SECONDS: Final = 0.04
STEPS: Final = 40
"""1.6 s: half a second to turn by a right angle, half to stop from full speed, the rest to settle."""
ENDS: Final = np.array([1.0, -1.0])
"""Nose first, tail first."""
STOP_SECONDS: Final = 0.15
"""Time constant [s] of the deceleration."""
# Times STEP_SECONDS this is below 1: each step removes half of the angle, so that the heading does not overshoot.
GAIN: Final = 12.0
"""Proportional gain [1/s] of the turn rate."""
FAINT: Final = 0.05
"""Required acceleration [m/s2] below which the turn rate fades: a robot at rest in still air need not turn."""
NUDGE: Final = 1e-4
"""Step of each state entry, in its own unit, for central differences."""
ALIKE: Final = 1e-6
"""Difference of clearance [m] below which the end that needs the smaller turn is chosen."""


@final
@dataclass(frozen=True)
class Motion:
    """Parameters of the robots' motion: numbers, or arrays with one entry per robot."""

    wind: Any
    """(2,) or (2, robots): acceleration by the wind [m/s2], in the world."""
    drag: Any
    """1/s: deceleration over velocity."""
    strongest: Any
    """m/s2 of thrust along the heading, forwards and backwards."""
    fastest: float
    """rad/s of turning."""
    ahead: float = 0.0
    """Distance [m] of the state's position, the centre of mass, ahead of the middle, whose clearance counts."""

    def of(self, which: Any) -> Motion:
        """The parameters of the robots of these indices; a number that holds for all stays a number."""
        wind, drag, strongest = (np.asarray(part, dtype=np.float64) for part in (self.wind, self.drag, self.strongest))
        return Motion(
            wind[:, which] if wind.ndim > 1 else wind,
            drag[which] if drag.ndim else drag,
            strongest[which] if strongest.ndim else strongest,
            self.fastest,
            self.ahead,
        )


def stop_seconds(drag: float, period: float) -> float:
    """The time constant [s] with which a robot that acts once a ``period`` stops within the predicted distance.

    The prediction holds each action for a step of 40 ms, and stops from v within v (STOP_SECONDS - STEP_SECONDS / 2).
    An action that is held for the period T against the drag d stops, with A = (1 - exp(-d T)) / d, within

        v (T seconds / A - (T - A) / (d A)),   without drag v (seconds - T / 2):

    with the same time constant a robot with a period of 20 ms would need 9 % more than predicted.
    """
    gained = -expm1(-drag * period) / drag
    return (STOP_SECONDS - 0.5 * STEP_SECONDS) * gained / period + (period - gained) / (drag * period)


def stopping_action(
    state: FloatArray, motion: Motion, end: FloatArray, seconds: float = STOP_SECONDS
) -> tuple[FloatArray, FloatArray]:
    """(thrust acceleration [m/s2], turn rate [rad/s]) of the manoeuvre for states (5, robots).

    ``end`` (robots,): 1 if the nose turns into the direction of thrust, -1 if the tail does. It is fixed for the whole
    manoeuvre: if it could change on the way, h would jump with the state and with the estimated wind. ``seconds`` is
    the time constant of the deceleration, see ``stop_seconds``.
    """
    return _action_with_heading(state, np.cos(state[2]), np.sin(state[2]), motion, end, seconds)


def _action_with_heading(
    state: FloatArray,
    ahead: FloatArray,
    sideways: FloatArray,
    motion: Motion,
    end: FloatArray,
    seconds: float = STOP_SECONDS,
) -> tuple[FloatArray, FloatArray]:
    """``stopping_action`` if cosine and sine of the heading are known."""
    wanted_x = -state[3] / seconds - motion.wind[0] + motion.drag * state[3]
    wanted_y = -state[4] / seconds - motion.wind[1] + motion.drag * state[4]
    along = wanted_x * ahead + wanted_y * sideways
    across = wanted_y * ahead - wanted_x * sideways
    size = np.sqrt(along * along + across * across)
    # size / (size + FAINT) removes the turn where the direction of a tiny vector is noise.
    # With end = -1 the angle is measured to the tail, so that the same law turns the tail into the thrust direction.
    error = np.arctan2(end * across, end * along) * size / (size + FAINT)
    thrust = np.minimum(np.maximum(along, -motion.strongest), motion.strongest)  # np.clip takes five times as long
    return thrust, np.minimum(np.maximum(GAIN * error, -motion.fastest), motion.fastest)


def nearer_end(state: FloatArray, motion: Motion) -> Any:
    """1 if the nose at ``state`` (5,) or (5, robots) is nearer to the direction of thrust, else -1."""
    wanted = [-state[3 + axis] / STOP_SECONDS - motion.wind[axis] + motion.drag * state[3 + axis] for axis in (0, 1)]
    return np.where(wanted[0] * np.cos(state[2]) + wanted[1] * np.sin(state[2]) >= 0.0, 1.0, -1.0)


def stopping_path(state: FloatArray, motion: Motion, end: FloatArray) -> FloatArray:
    """Positions (1 + STEPS, 2, robots) of the middle along the manoeuvre from states (5, robots).

    In the precision of the states: single precision takes a third of the time for many robots, and differs by 1 um.
    """
    # A copy: the integration below writes into it.
    now = np.array(state)
    path = np.empty((STEPS + 1, 2, now.shape[1]), dtype=now.dtype)
    ahead, sideways = np.cos(now[2]), np.sin(now[2])
    _write_middle(path[0], now, ahead, sideways, motion.ahead)
    for step in range(1, STEPS + 1):
        thrust, turn = _action_with_heading(now, ahead, sideways, motion, end)
        # The thrust acts along the heading at mid-step: a midpoint rule, second-order accurate while the robot turns.
        middle = now[2] + 0.5 * STEP_SECONDS * turn
        now[2] += STEP_SECONDS * turn
        for axis, heading in ((0, np.cos(middle)), (1, np.sin(middle))):
            push = thrust * heading + motion.wind[axis] - motion.drag * now[3 + axis]
            now[axis] += STEP_SECONDS * (now[3 + axis] + 0.5 * STEP_SECONDS * push)
            now[3 + axis] += STEP_SECONDS * push
        ahead, sideways = np.cos(now[2]), np.sin(now[2])
        _write_middle(path[step], now, ahead, sideways, motion.ahead)
    return path


def _write_middle(
    position: FloatArray, state: FloatArray, ahead: FloatArray, sideways: FloatArray, lies_ahead: float
) -> None:
    """Writes the middle's position (2, robots) for states (5, robots) of the centre of mass."""
    if lies_ahead == 0.0:
        position[:] = state[:2]
        return
    np.subtract(state[0], lies_ahead * ahead, out=position[0])
    np.subtract(state[1], lies_ahead * sideways, out=position[1])


def stopping_room(path: FloatArray, hazards: FloatArray, radii: FloatArray) -> FloatArray:
    """h (robots, hazards) [m] of paths (steps, 2, robots) among hazards (robots, hazards, 2).

    ``radii`` (hazards,) or (robots, hazards).
    """
    # In-place operations on contiguous arrays: this loop is the largest part of a batch decision.
    positions = np.ascontiguousarray(hazards.transpose(2, 1, 0), dtype=path.dtype)
    nearest = np.full(positions.shape[1:], np.inf, dtype=path.dtype)
    squares, part = np.empty_like(nearest), np.empty_like(nearest)
    for position in path:
        np.subtract(positions[0], position[0], out=squares)
        np.multiply(squares, squares, out=squares)
        np.subtract(positions[1], position[1], out=part)
        np.multiply(part, part, out=part)
        np.add(squares, part, out=squares)
        np.minimum(nearest, squares, out=nearest)
    # One square root at the end: the minimum of the squares is at the same step.
    room: FloatArray = np.sqrt(nearest).T - np.asarray(radii, dtype=path.dtype)
    return room


@final
class StoppingBarrier(AbstractBarrier):
    """h of one robot among ``hazards`` (m, 3): x, y, radius [m]; state x, y, yaw, vx, vy."""

    kind = "obstacle"
    reads = ("x", "y", "yaw", "vx", "vy")

    def __init__(self, hazards: FloatArray, motion: Motion) -> None:
        rows = np.asarray(hazards, dtype=np.float64).reshape(-1, 3)
        self.names = tuple(f"hazard {index}" for index in range(len(rows)))
        self._positions, self._radii, self._motion = rows[:, :2], rows[:, 2], motion

    def h(self, state: FloatArray) -> FloatArray:  # noqa: D102
        return self._best(np.asarray(state, dtype=np.float64))[0]

    def h_and_grad(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:  # noqa: D102
        state = np.asarray(state, dtype=np.float64)
        # ``end`` stays that of the centre: the gradient belongs to the manoeuvre that h was computed for.
        room, end = self._best(state)
        # All ten shifted states in one call: the path of many states takes hardly longer than that of one.
        around = np.repeat(state[:, np.newaxis], 10, axis=1)
        index = np.arange(5)
        around[index, index] += NUDGE
        around[index, 5 + index] -= NUDGE
        rooms = self._rooms(around, np.full(10, end))
        return room, (rooms[:5] - rooms[5:]).T / (2.0 * NUDGE)

    def best_end(self, state: FloatArray) -> float:
        """1 where the manoeuvre with the nose first leaves more room at ``state`` (5,), else -1."""
        return self._best(np.asarray(state, dtype=np.float64))[1]

    def _best(self, state: FloatArray) -> tuple[FloatArray, float]:
        rooms = [minimum_clearances(state, self._motion, float(end), self._positions, self._radii) for end in ENDS]
        # The nearest hazard decides which end goes first: it is the one whose h would fall below 0.
        more = float(rooms[1].min() - rooms[0].min()) if self._radii.size else 0.0
        best = int(more > 0.0) if abs(more) > ALIKE else int(nearer_end(state, self._motion) < 0.0)
        return rooms[best], float(ENDS[best])

    def _rooms(self, states: FloatArray, end: FloatArray) -> FloatArray:
        path = stopping_path(states, self._motion, end)
        return stopping_room(
            path, np.broadcast_to(self._positions, (states.shape[1], *self._positions.shape)), self._radii
        )


def minimum_clearances(
    state: FloatArray, motion: Motion, end: float, hazards: FloatArray, radii: FloatArray
) -> FloatArray:
    """h (hazards,) [m] along the manoeuvre from ``state`` (5,) among hazards (hazards, 2): ``stopping_path`` of one."""
    path = np.array(_positions([float(entry) for entry in state], motion, end))
    apart = hazards[:, np.newaxis] - path
    room: FloatArray = np.sqrt(np.einsum("hpk,hpk->hp", apart, apart).min(axis=1)) - radii
    return room


def _positions(state: list[float], motion: Motion, end: float) -> list[tuple[float, float]]:
    """Positions of the middle along the manoeuvre; the same arithmetic as ``stopping_path``."""
    x, y, yaw, vx, vy = state
    wind_x, wind_y = float(motion.wind[0]), float(motion.wind[1])
    drag, strongest, fastest, behind = float(motion.drag), float(motion.strongest), motion.fastest, motion.ahead
    positions = [(x - behind * cos(yaw), y - behind * sin(yaw))]
    for _ in range(STEPS):
        ahead, sideways = cos(yaw), sin(yaw)
        wanted_x = -vx / STOP_SECONDS - wind_x + drag * vx
        wanted_y = -vy / STOP_SECONDS - wind_y + drag * vy
        along = wanted_x * ahead + wanted_y * sideways
        across = wanted_y * ahead - wanted_x * sideways
        size = sqrt(along * along + across * across)
        error = atan2(end * across, end * along) * size / (size + FAINT)
        thrust = min(max(along, -strongest), strongest)
        turn = min(max(GAIN * error, -fastest), fastest)
        middle = yaw + 0.5 * STEP_SECONDS * turn
        yaw += STEP_SECONDS * turn
        push_x = thrust * cos(middle) + wind_x - drag * vx
        push_y = thrust * sin(middle) + wind_y - drag * vy
        x += STEP_SECONDS * (vx + 0.5 * STEP_SECONDS * push_x)
        y += STEP_SECONDS * (vy + 0.5 * STEP_SECONDS * push_y)
        vx += STEP_SECONDS * push_x
        vy += STEP_SECONDS * push_y
        positions.append((x - behind * cos(yaw), y - behind * sin(yaw)) if behind else (x, y))
    return positions


def stopping_distance(speed: Scalar, deceleration: Scalar, gain: Scalar, operations: Operations) -> Scalar:
    """The signed stopping distance D [m] at ``speed`` [m/s]; see ``Braking``."""
    # Below the corner speed the servo's gain limits the braking, above it the deceleration.
    corner, size = deceleration / gain, operations.absolute(speed)
    far = corner / gain + (size * size - corner * corner) / (2.0 * deceleration)
    return operations.where(size <= corner, speed / gain, operations.where(speed > 0.0, far, -far))


@final
@dataclass(frozen=True)
class Braking:
    """Guaranteed braking of a speed servo: d|v|/dt <= -min(gain |v|, deceleration).

    ``deceleration`` b [m/s2], ``gain`` k [1/s]: what the robot can do at least, with every load. The signed stopping
    distance D(v) solves D'(v) min(k |v|, b) = |v|, D(0) = 0, so that v + d(D)/dt <= 0 while braking forward:

        |v| <= b/k:  D = v / k
        beyond:      D = sign(v) (b/k^2 + (v^2 - (b/k)^2) / (2 b))

    D is once continuously differentiable: both derivatives are 1/k at |v| = b/k. Raises InputError unless both
    parameters are positive.
    """

    deceleration: float
    gain: float

    def __post_init__(self) -> None:
        for name, value in (("deceleration", self.deceleration), ("gain", self.gain)):
            if not (isfinite(value) and value > 0.0):
                raise InputError(f"braking {name}: got {value}, wanted a positive finite number")

    def distance(self, speed: float) -> float:
        """D(speed) [m], with the sign of ``speed`` [m/s]."""
        return float(stopping_distance(speed, self.deceleration, self.gain, FLOATS))
