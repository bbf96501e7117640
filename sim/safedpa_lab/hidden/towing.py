"""The pymunk car with a load hitched, driven about an empty field: rigid bodies, tyres, a drawbar."""

from __future__ import annotations

from math import atan, atan2, cos, hypot, sin, tan

import numpy as np

from safedpa.arrays import FloatArray
from safedpa_lab.hidden.lanes import reference
from safedpa_sim.robots.car.loads import load_named
from safedpa_sim.robots.car.world import CarWorld

_FIELD = (-200.0, 200.0, -200.0, 200.0)
_LATERAL = 2.5
"""m/s2; faster curves would throw the load about."""
_STEER = 0.3
"""rad"""
_SETTLES, _PERIOD = 200, 0.05
"""Periods until a curve is steady, and as many that are measured; s."""


def drive_towing(load: str, random: np.random.Generator, rows: int, period: float) -> tuple[FloatArray, FloatArray]:
    """States (rows, 4) and actions (rows, 2) of one run, forwards only: a load that is pushed back folds up."""
    return drive_in(
        CarWorld((0.0, 0.0, float(random.uniform(-3.0, 3.0))), _FIELD, (), load_named(load)), random, rows, period
    )


def turning_share(load: str, speed: float, steer: float, wheelbase: float = 0.32) -> tuple[float, float]:
    """The speed [m/s] of a steady curve at a nominal speed [m/s] and a steer [rad], and yaw rate * wheelbase / (speed *
    tan(steer)) there with the load, over the same without it at the same speed.

    Without a load the share is 1 / (1 + K speed^2), whose K is measured next to it.
    """
    reached, turned = _steady(load, speed, steer, wheelbase)
    bare, own = _steady("none", reached, steer, wheelbase)
    gradient = (1.0 / own - 1.0) / bare**2
    return reached, turned * (1.0 + gradient * reached**2)


def _steady(load: str, speed: float, steer: float, wheelbase: float) -> tuple[float, float]:
    world = CarWorld((0.0, 0.0, 0.0), _FIELD, (), load_named(load))
    for _ in range(_SETTLES):
        world.advance(speed, steer, _PERIOD)
    yaw, speeds = [], []
    for _ in range(_SETTLES):
        yaw.append(world.state[2])
        speeds.append(world.state[3])
        world.advance(speed, steer, _PERIOD)
    turned = np.unwrap(yaw)
    rate, mean = float(turned[-1] - turned[0]) / ((_SETTLES - 1) * _PERIOD), float(np.mean(speeds))
    return mean, rate * wheelbase / (mean * tan(steer))


def drive_in(world: CarWorld, random: np.random.Generator, rows: int, period: float) -> tuple[FloatArray, FloatArray]:
    """The same in a world that there is: states (rows, 4) and actions (rows, 2)."""
    speeds = reference(random, rows, period, (0.0, 2.0), 1.5, (0.8, 3.0))
    steers = reference(random, rows, period, (-_STEER, _STEER), 2 * _STEER, (0.6, 2.0))
    states, actions = np.empty((rows, 4)), np.empty((rows, 2))
    for row in range(rows):
        states[row] = world.state
        actions[row] = speeds[row], _steer(float(steers[row]), *world.state)
        world.advance(float(actions[row, 0]), float(actions[row, 1]), period)
    return states, actions


def _steer(wanted: float, x: float, y: float, yaw: float, speed: float) -> float:
    """The plan's steer, back to the middle from far out, wider when fast."""
    home = atan2(-y, -x) - yaw
    home = atan2(sin(home), cos(home))
    if hypot(x, y) > 6.0 and abs(home) > 0.6:
        wanted = max(-_STEER, min(_STEER, 1.5 * home))
    most = atan(_LATERAL * 0.32 / max(speed * speed, 0.1))
    return max(-most, min(most, wanted))
