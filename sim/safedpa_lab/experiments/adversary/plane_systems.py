"""Systems with two actions: a unicycle, a quadrotor in the plane, a chase, a corridor, a mass before a disc."""

from __future__ import annotations

import numpy as np

from safedpa.arrays import FloatArray
from safedpa_lab.experiments.adversary.control_system import PERIOD, ControlSystem

__all__ = ["chased", "corridor", "disc_of_degree_two", "quadrotor", "unicycle"]


_AHEAD = 0.1
"""m; the point of the unicycle whose distance is kept."""
_CORRIDOR = np.array([[0.6 * (index // 2), 0.55 * (-1.0) ** index] for index in range(20)])


def unicycle() -> ControlSystem:
    """(x, y [m], heading [rad]), speed of -0.5 to 1 m/s and 2 rad/s: four discs, from a point ahead of the wheels."""
    discs = np.array([[1.0, 0.0, 0.3], [0.0, 1.2, 0.4], [-1.1, -0.3, 0.3], [0.3, -1.2, 0.4]])

    def h(x: FloatArray) -> FloatArray:
        nose = x[:, :2] + _AHEAD * np.stack([np.cos(x[:, 2]), np.sin(x[:, 2])], axis=1)
        return np.asarray(_distances(nose, discs[:, :2]) - discs[:, 2])

    def g(x: FloatArray) -> FloatArray:
        return PERIOD * np.array([[np.cos(x[2]), 0.0], [np.sin(x[2]), 0.0], [0.0, 1.0]])

    return ControlSystem(
        name="unicycle",
        f=lambda x: x.copy(),
        g=g,
        h=h,
        start=lambda random: np.array([*random.uniform(-0.3, 0.3, 2), random.uniform(-np.pi, np.pi)]),
        low=(-0.5, -2.0),
        high=(1.0, 2.0),
        backup=lambda _: [0.0, 0.0],
        margin=0.002,
        count=4,
    )


def quadrotor() -> ControlSystem:
    """(x, z, tilt, vx, vz, rate), thrust of 0 to 2 g and 30 rad/s2: a floor, a ceiling, and tilt within 0.5 rad."""

    def f(x: FloatArray) -> FloatArray:
        return np.array([*(x[:3] + PERIOD * x[3:]), x[3], x[4] - PERIOD * 9.81, x[5]])

    def g(x: FloatArray) -> FloatArray:
        columns = np.zeros((6, 2))
        columns[3, 0], columns[4, 0], columns[5, 1] = -PERIOD * np.sin(x[2]), PERIOD * np.cos(x[2]), PERIOD
        columns[:3] = 0.5 * PERIOD * columns[3:]
        return columns

    def h(x: FloatArray) -> FloatArray:
        z, tilt, vz, rate = x[:, 1], x[:, 2], x[:, 4], x[:, 5]
        rows = [
            _stop(z, -vz, 5.0),
            _stop(5.0 - z, vz, 8.0),
            _stop(0.5 - tilt, rate, 20.0),
            _stop(0.5 + tilt, -rate, 20.0),
        ]
        return np.stack(rows, axis=1)

    return ControlSystem(
        name="planar quadrotor",
        f=f,
        g=g,
        h=h,
        start=lambda random: np.array([0.0, random.uniform(1.5, 3.5), *random.uniform(-0.1, 0.1, 4)]),
        low=(0.0, -30.0),
        high=(19.62, 30.0),
        backup=lambda x: [9.81 / np.cos(x[2]) - 10.0 * x[4], -20.0 * x[5] - 40.0 * x[2]],
        margin=0.005,
        count=4,
    )


def chased() -> ControlSystem:
    """(own x, y, its x, y [m]): a disc of 0.3 m follows at 0.6 m/s, one's own speed is up to 1 m/s on each axis."""

    def f(x: FloatArray) -> FloatArray:
        apart = x[:2] - x[2:]
        return np.array([*x[:2], *(x[2:] + 0.6 * PERIOD * apart / max(float(np.hypot(*apart)), 1e-9))])

    return ControlSystem(
        name="chasing obstacle",
        f=f,
        g=lambda _: PERIOD * np.vstack([np.eye(2), np.zeros((2, 2))]),
        h=lambda x: np.hypot(x[:, 0] - x[:, 2], x[:, 1] - x[:, 3])[:, None] - 0.3,
        start=lambda random: np.array([0.0, 0.0, *(_around(random) * random.uniform(0.6, 2.0))]),
        low=(-1.0, -1.0),
        high=(1.0, 1.0),
        backup=lambda x: (x[:2] - x[2:]) / max(float(np.hypot(*(x[:2] - x[2:]))), 1e-9),
        margin=0.005,
    )


def corridor() -> ControlSystem:
    """(x, y [m]) among twenty discs of 0.4 m in two rows: passages of 0.3 m, and gaps that let nothing through."""
    return ControlSystem(
        name="corridor of 20 obstacles",
        f=lambda x: x.copy(),
        g=lambda _: PERIOD * np.eye(2),
        h=lambda x: _distances(x, _CORRIDOR) - 0.4,
        start=lambda random: np.array([random.uniform(0.0, 5.0), 0.0]),
        low=(-1.0, -1.0),
        high=(1.0, 1.0),
        backup=lambda _: [0.0, 0.0],
        margin=0.002,
        count=20,
    )


def disc_of_degree_two() -> ControlSystem:
    """(x, y, vx, vy) before a disc of 0.5 m, 1 m/s2 on each axis; h is the bare distance: it is moved too late."""
    return ControlSystem(
        name="relative degree two, plain barrier",
        f=lambda x: np.array([*(x[:2] + PERIOD * x[2:]), *x[2:]]),
        g=lambda _: np.vstack([0.5 * PERIOD**2 * np.eye(2), PERIOD * np.eye(2)]),
        h=lambda x: np.hypot(x[:, 0], x[:, 1])[:, None] - 0.5,
        start=lambda random: np.array([*(_around(random) * random.uniform(1.5, 3.0)), *random.uniform(-0.3, 0.3, 2)]),
        low=(-1.0, -1.0),
        high=(1.0, 1.0),
        backup=lambda x: -20.0 * x[2:],
        margin=0.002,
        invariant=False,
    )


def _distances(points: FloatArray, centres: FloatArray) -> FloatArray:
    return np.asarray(np.hypot(points[:, :1] - centres[:, 0], points[:, 1:2] - centres[:, 1]))


def _stop(room: FloatArray, speed: FloatArray, braking: float) -> FloatArray:
    fast = np.maximum(speed, 0.0)
    return np.asarray(room - fast**2 / (2.0 * braking) - 0.1 * fast)


def _around(random: np.random.Generator) -> FloatArray:
    bearing = random.uniform(-np.pi, np.pi)
    return np.array([np.cos(bearing), np.sin(bearing)])
