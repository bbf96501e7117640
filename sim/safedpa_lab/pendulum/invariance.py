"""Whether the corridor can always be kept: for every state in it and every wind there is a torque within the bounds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import PhysicsModel
from safedpa_lab.pendulum.rollouts import physics_in_any_wind
from safedpa_sim.pendulum.task import AHEAD, BALANCING, TORQUE


@dataclass(frozen=True)
class Reserve:
    """The least torque left over in the set, and where: angle [rad], rate [rad/s] and wind direction [rad]."""

    torque: float
    angle: float
    rate: float
    direction: float


def reserve(state: FloatArray, wind: FloatArray, edges: tuple[float, float], eta: float, epsilon: float) -> FloatArray:
    """Torque [N m] (n,) by which the bounds exceed what the barrier's condition needs, negative where they fall short.

    With s = angle + AHEAD rate the condition asks s[t+1] to lie in [(1 - eta) s + eta low + epsilon,
    (1 - eta) s + eta high - epsilon]. s[t+1] rises with the torque, so that the interval is met by some torque exactly
    when the least torque does not overshoot its end and the largest reaches its beginning. ``state`` (n, 2),
    ``wind`` (n, 2) as speed and upward [m/s].
    """
    model = physics_in_any_wind()
    low, high = edges
    ahead = state[:, 0] + AHEAD * state[:, 1]
    lowest, highest = (_ahead_after(model, state, wind, torque) for torque in (-TORQUE, TORQUE))
    first, last = (1 - eta) * ahead + eta * low + epsilon, (1 - eta) * ahead + eta * high - epsilon
    per_torque = (highest - lowest) / (2.0 * TORQUE)
    room = np.minimum(last - lowest, highest - first) / per_torque
    return np.where(first <= last, room, -np.inf)


def _ahead_after(model: PhysicsModel, state: FloatArray, wind: FloatArray, torque: float) -> FloatArray:
    action = np.full((len(state), 1), torque)
    following = model.advance(state, action, model.initial_memory(action, wind), wind)[0]
    return np.asarray(following[:, 0] + AHEAD * following[:, 1])


def least_reserve(
    strength: float,
    edges: tuple[float, float] = BALANCING,
    eta: float = 0.5,
    epsilon: float = 0.0,
    cells: int = 41,
    directions: int = 36,
) -> Reserve:
    """The least reserve over the whole set {edges hold angle and s} and all directions of a wind of ``strength`` [m/s].

    On a grid of ``cells`` angles and values of s, both ends included, and ``directions`` winds.
    """
    grid = np.linspace(*edges, cells)
    angle, ahead, direction = (
        axis.ravel() for axis in np.meshgrid(grid, grid, 2 * np.pi * np.arange(directions) / directions)
    )
    state = np.stack((angle, (ahead - angle) / AHEAD), axis=1)
    wind = strength * np.stack((np.cos(direction), np.sin(direction)), axis=1)
    left = reserve(state, wind, edges, eta, epsilon)
    worst = int(np.argmin(left))
    return Reserve(float(left[worst]), *(float(value) for value in (*state[worst], direction[worst])))


def largest_wind(edges: tuple[float, float] = BALANCING, eta: float = 0.5, epsilon: float = 0.0) -> float:
    """The strongest wind [m/s] in which the whole set can be kept, by bisection to 1 mm/s; 0 when none is too weak."""
    low, high = 0.0, 15.0
    if least_reserve(low, edges, eta, epsilon).torque < 0.0:
        return 0.0
    while high - low > 1e-3:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if least_reserve(middle, edges, eta, epsilon).torque >= 0.0 else (low, middle)
    return low
