"""Systems with one action: a mass on a line, a pendulum, adaptive cruise, a drive that answers late."""

from __future__ import annotations

import numpy as np

from safedpa.arrays import FloatArray
from safedpa_lab.experiments.adversary.control_system import PERIOD, ControlSystem

__all__ = ["adaptive_cruise", "double_integrator", "late_drive", "pendulum", "room_before_the_wall"]


_HALF_SQUARE = 0.5 * PERIOD**2
_LATE = 3
"""Periods until an action acts."""


def double_integrator() -> ControlSystem:
    """A mass before a wall at 1 m: (x [m], v [m/s]), acceleration of 1 m/s2 either way."""
    return ControlSystem(
        name="double integrator",
        f=lambda x: np.array([x[0] + PERIOD * x[1], x[1]]),
        g=lambda _: np.array([[_HALF_SQUARE], [PERIOD]]),
        h=room_before_the_wall,
        start=lambda random: np.array([random.uniform(-1.0, 0.5), random.uniform(-0.5, 0.5)]),
        low=(-1.0,),
        high=(1.0,),
        backup=lambda x: [-20.0 * x[1]],
        margin=0.002,
    )


def pendulum() -> ControlSystem:
    """An inverted pendulum of 1 m kept within 0.5 rad: (angle [rad], rate [rad/s]), torque by inertia of 12 rad/s2."""

    def f(x: FloatArray) -> FloatArray:
        pull = 9.81 * np.sin(x[0])
        return np.array([x[0] + PERIOD * x[1] + _HALF_SQUARE * pull, x[1] + PERIOD * pull])

    def h(x: FloatArray) -> FloatArray:
        sides = [_room_to_stop(0.5 - sign * x[:, 0], sign * x[:, 1], 6.0) for sign in (1.0, -1.0)]
        return np.stack(sides, axis=1)

    return ControlSystem(
        name="pendulum",
        f=f,
        g=lambda _: np.array([[_HALF_SQUARE], [PERIOD]]),
        h=h,
        start=lambda random: np.array([random.uniform(-0.2, 0.2), random.uniform(-0.3, 0.3)]),
        low=(-12.0,),
        high=(12.0,),
        backup=lambda x: [-9.81 * np.sin(x[0]) - 18.0 * x[1] - 20.0 * x[0]],
        margin=0.005,
        count=2,
    )


def adaptive_cruise() -> ControlSystem:
    """Behind a slower car: (gap [m], own speed, its speed [m/s]), acceleration of -6 to 3 m/s2."""

    def f(x: FloatArray) -> FloatArray:
        return np.array([x[0] + PERIOD * (x[2] - x[1]), x[1], x[2]])

    return ControlSystem(
        name="adaptive cruise",
        f=f,
        g=lambda _: np.array([[-_HALF_SQUARE], [PERIOD], [0.0]]),
        h=lambda x: _room_to_stop(x[:, 0] - 2.0, x[:, 1] - x[:, 2], 5.0)[:, None],
        start=lambda random: np.array(
            [random.uniform(15.0, 40.0), random.uniform(5.0, 15.0), random.uniform(3.0, 9.0)]
        ),
        low=(-6.0,),
        high=(3.0,),
        backup=lambda x: [-20.0 * (x[1] - x[2])],
        margin=0.02,
    )


def late_drive(*, looking_ahead: bool) -> ControlSystem:
    """The mass before a wall, three actions on their way: (x, v, a that acts next, then, then).

    ``looking_ahead``: h is judged at the state in which a new action begins to act; else here and now.
    """

    def f(x: FloatArray) -> FloatArray:
        moved = [x[0] + PERIOD * x[1] + _HALF_SQUARE * x[2], x[1] + PERIOD * x[2]]
        return np.array([*moved, *x[3 : 2 + _LATE], 0.0])

    def ahead(x: FloatArray) -> FloatArray:
        place, speed = x[:, 0], x[:, 1]
        for pending in x[:, 2:].T:
            place, speed = place + PERIOD * speed + _HALF_SQUARE * pending, speed + PERIOD * pending
        return room_before_the_wall(np.stack([place, speed], axis=1))

    return ControlSystem(
        name="delay, judged when it acts" if looking_ahead else "delay, plain barrier",
        f=f,
        g=lambda _: np.array([[0.0]] * (1 + _LATE) + [[1.0]]),
        h=room_before_the_wall,
        start=lambda random: np.array([random.uniform(-1.0, 0.0), random.uniform(-0.5, 0.3), *[0.0] * _LATE]),
        low=(-1.0,),
        high=(1.0,),
        backup=lambda x: [-5.0 * (x[1] + PERIOD * x[2:].sum())],
        margin=0.002,
        judged=ahead if looking_ahead else None,
        invariant=looking_ahead,
    )


def room_before_the_wall(x: FloatArray) -> FloatArray:
    """(n, 1) of states (n, 2 or more): position and speed come first, the wall is at 1 m."""
    return _room_to_stop(1.0 - x[:, 0], x[:, 1], 0.8)[:, None]


def _room_to_stop(room: FloatArray, speed: FloatArray, braking: float) -> FloatArray:
    """Room less the stopping distance v^2 / (2 b) and a tenth of a second of driving on."""
    fast = np.maximum(speed, 0.0)
    return np.asarray(room - fast**2 / (2.0 * braking) - 0.1 * fast)
