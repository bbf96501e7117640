"""Room that is left to hazards while a robot with thrust along its heading stops and stands against the wind.

The manoeuvre (thrust and turn are all that it has): with the acceleration that would end the motion,

    wanted = -velocity / time - (wind - drag velocity)
    thrust acceleration = clip(wanted . heading, +-strongest)
    turn = clip(gain angle from heading, or its opposite, to wanted, +-fastest)

it turns its nose, or its tail, to where it has to push, pushes as well as it already can, and ends at rest with the
wind held. h_i = least distance to hazard i along the manoeuvre, less its radius; of nose and tail first, the one that
leaves more room to the nearest hazard. Anyone who takes the manoeuvre's own action keeps every h_i from falling, for all
hazards at once: the conditions can always be met together.
Source: the backup control barrier function of Gurriet, Mote, Singletary, Feron, Ames, A Scalable Safety Critical
Control Framework for Nonlinear Systems, IEEE Access 2020.

The stopping manoeuvre of one robot in plain numbers: a tenth of the time that arrays of one entry take.

How far a robot still moves when it brakes: the stretch that barriers of obstacles and walls look ahead.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, cos, isfinite, sin, sqrt
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
    "stopping_action",
    "stopping_distance",
    "stopping_path",
    "stopping_room",
]


STEP_SECONDS: Final = 0.04
STEPS: Final = 40
"""1.6 s: half a second to turn by a right angle, half to stop from full speed, the rest to stand."""
ENDS: Final = np.array([1.0, -1.0])
"""Nose first, tail first."""
STOP_SECONDS: Final = 0.15
"""s in which the velocity shall end."""
GAIN: Final = 12.0
"""1/s of the turning."""
FAINT: Final = 0.05
"""m/s2 of wanted acceleration below which the turning fades: a robot at rest in still air need not turn."""
NUDGE: Final = 1e-4
"""Of each entry of the state, in its own unit: for the slopes."""
ALIKE: Final = 1e-6
"""m; where either end leaves the same room the one that has less to turn is taken."""


@final
@dataclass(frozen=True)
class Motion:
    """What is known of how the robots move; numbers, or arrays with one entry a robot."""

    wind: Any
    """(2,) or (2, robots): acceleration by the wind [m/s2], in the world."""
    drag: Any
    """1/s: deceleration over velocity."""
    strongest: Any
    """m/s2 of thrust along the heading, forwards and backwards."""
    fastest: float
    """rad/s of turning."""
    ahead: float = 0.0
    """m by which the position of the state, the centre of mass, lies ahead of the middle, whose room counts."""

    def of(self, which: Any) -> Motion:
        """The same for the robot of an index, or for those of several; a number that holds for all stays as it is."""
        wind, drag, strongest = (np.asarray(part, dtype=np.float64) for part in (self.wind, self.drag, self.strongest))
        return Motion(
            wind[:, which] if wind.ndim > 1 else wind,
            drag[which] if drag.ndim else drag,
            strongest[which] if strongest.ndim else strongest,
            self.fastest,
            self.ahead,
        )


def stopping_action(state: FloatArray, motion: Motion, end: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(thrust acceleration [m/s2], turn [rad/s]) of the manoeuvre for states (5, robots).

    ``end`` (robots,): 1 where the nose shall point to where the robot has to push, -1 where the tail shall. It is kept
    all the way: where it changed along the way h would jump with the state, and with what is believed of the wind, from
    one side of the change to the other.
    """
    return _slowing(state, np.cos(state[2]), np.sin(state[2]), motion, end)


def _slowing(
    state: FloatArray, ahead: FloatArray, aside: FloatArray, motion: Motion, end: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """``stopping_action`` where cosine and sine of the heading are known."""
    wanted_x = -state[3] / STOP_SECONDS - motion.wind[0] + motion.drag * state[3]
    wanted_y = -state[4] / STOP_SECONDS - motion.wind[1] + motion.drag * state[4]
    along = wanted_x * ahead + wanted_y * aside
    across = wanted_y * ahead - wanted_x * aside
    size = np.sqrt(along * along + across * across)
    error = np.arctan2(end * across, end * along) * size / (size + FAINT)
    thrust = np.minimum(np.maximum(along, -motion.strongest), motion.strongest)  # np.clip takes five times as long
    return thrust, np.minimum(np.maximum(GAIN * error, -motion.fastest), motion.fastest)


def nearer_end(state: FloatArray, motion: Motion) -> Any:
    """1 where the nose at ``state`` (5,) or (5, robots) is nearer to where the robot has to push, else -1."""
    wanted = [-state[3 + axis] / STOP_SECONDS - motion.wind[axis] + motion.drag * state[3 + axis] for axis in (0, 1)]
    return np.where(wanted[0] * np.cos(state[2]) + wanted[1] * np.sin(state[2]) >= 0.0, 1.0, -1.0)


def stopping_path(state: FloatArray, motion: Motion, end: FloatArray) -> FloatArray:
    """Places (1 + STEPS, 2, robots) of the middle along the manoeuvre from states (5, robots), from now on.

    In the states' own precision: single precision is a third of the work for many, and a micrometre off.
    """
    now = np.array(state)
    path = np.empty((STEPS + 1, 2, now.shape[1]), dtype=now.dtype)
    ahead, aside = np.cos(now[2]), np.sin(now[2])
    _put_middle(path[0], now, ahead, aside, motion.ahead)
    for step in range(1, STEPS + 1):
        thrust, turn = _slowing(now, ahead, aside, motion, end)
        middle = now[2] + 0.5 * STEP_SECONDS * turn
        now[2] += STEP_SECONDS * turn
        for axis, heading in ((0, np.cos(middle)), (1, np.sin(middle))):
            push = thrust * heading + motion.wind[axis] - motion.drag * now[3 + axis]
            now[axis] += STEP_SECONDS * (now[3 + axis] + 0.5 * STEP_SECONDS * push)
            now[3 + axis] += STEP_SECONDS * push
        ahead, aside = np.cos(now[2]), np.sin(now[2])
        _put_middle(path[step], now, ahead, aside, motion.ahead)
    return path


def _put_middle(place: FloatArray, state: FloatArray, ahead: FloatArray, aside: FloatArray, lies_ahead: float) -> None:
    """Writes the middle's place (2, robots) for states (5, robots) of the centre of mass."""
    if lies_ahead == 0.0:
        place[:] = state[:2]
        return
    np.subtract(state[0], lies_ahead * ahead, out=place[0])
    np.subtract(state[1], lies_ahead * aside, out=place[1])


def stopping_room(path: FloatArray, hazards: FloatArray, radii: FloatArray) -> FloatArray:
    """h (robots, hazards) [m] of paths (steps, 2, robots) among hazards (robots, hazards, 2).

    ``radii`` (hazards,) or (robots, hazards).
    """
    places = np.ascontiguousarray(hazards.transpose(2, 1, 0), dtype=path.dtype)
    nearest = np.full(places.shape[1:], np.inf, dtype=path.dtype)
    squares, part = np.empty_like(nearest), np.empty_like(nearest)
    for place in path:
        np.subtract(places[0], place[0], out=squares)
        np.multiply(squares, squares, out=squares)
        np.subtract(places[1], place[1], out=part)
        np.multiply(part, part, out=part)
        np.add(squares, part, out=squares)
        np.minimum(nearest, squares, out=nearest)
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
        self._places, self._radii, self._motion = rows[:, :2], rows[:, 2], motion

    def values(self, state: FloatArray) -> FloatArray:  # noqa: D102
        return self._best(np.asarray(state, dtype=np.float64))[0]

    def evaluate(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:  # noqa: D102
        state = np.asarray(state, dtype=np.float64)
        room, end = self._best(state)
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
        pass  # dropped

        rooms = [minimum_clearances(state, self._motion, float(end), self._places, self._radii) for end in ENDS]
        more = float(rooms[1].min() - rooms[0].min()) if self._radii.size else 0.0
        best = int(more > 0.0) if abs(more) > ALIKE else int(nearer_end(state, self._motion) < 0.0)
        return rooms[best], float(ENDS[best])

    def _rooms(self, states: FloatArray, end: FloatArray) -> FloatArray:
        path = stopping_path(states, self._motion, end)
        return stopping_room(path, np.broadcast_to(self._places, (states.shape[1], *self._places.shape)), self._radii)


def minimum_clearances(
    state: FloatArray, motion: Motion, end: float, hazards: FloatArray, radii: FloatArray
) -> FloatArray:
    """h (hazards,) [m] along the manoeuvre from ``state`` (5,) among hazards (hazards, 2): ``stopping_path`` of one."""
    path = np.array(_places([float(entry) for entry in state], motion, end))
    apart = hazards[:, np.newaxis] - path
    room: FloatArray = np.sqrt(np.einsum("hpk,hpk->hp", apart, apart).min(axis=1)) - radii
    return room


def _places(state: list[float], motion: Motion, end: float) -> list[tuple[float, float]]:
    """The middle's places along the manoeuvre, from now on; the same arithmetic as ``stopping_path``."""
    x, y, yaw, vx, vy = state
    wind_x, wind_y = float(motion.wind[0]), float(motion.wind[1])
    drag, strongest, fastest, behind = float(motion.drag), float(motion.strongest), motion.fastest, motion.ahead
    places = [(x - behind * cos(yaw), y - behind * sin(yaw))]
    for _ in range(STEPS):
        ahead, aside = cos(yaw), sin(yaw)
        wanted_x = -vx / STOP_SECONDS - wind_x + drag * vx
        wanted_y = -vy / STOP_SECONDS - wind_y + drag * vy
        along = wanted_x * ahead + wanted_y * aside
        across = wanted_y * ahead - wanted_x * aside
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
        places.append((x - behind * cos(yaw), y - behind * sin(yaw)) if behind else (x, y))
    return places


def stopping_distance(speed: Scalar, deceleration: Scalar, gain: Scalar, operations: Operations) -> Scalar:
    """The signed stopping distance D [m] at ``speed`` [m/s]; see ``Braking``."""
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

    D is once continuously differentiable: both slopes are 1/k at |v| = b/k. Raises InputError unless both are positive.
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
