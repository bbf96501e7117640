"""Many runs side by side: one lane a run, one number a lane for every parameter, and commands for each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa_lab.hidden.case import Effects


@dataclass(frozen=True)
class Commands:
    """What the driver of one run wants, row by row: (rows,) each."""

    drive: FloatArray
    """m/s for a car, N m for a pendulum."""
    steer: FloatArray
    """rad"""
    coast: NDArray[np.bool_]
    """Rows in which a driver with a throttle lets it go."""


def car_commands(random: np.random.Generator, rows: int, period: float, largest_steer: float) -> Commands:
    """Speeds from -0.6 to 2.4 m/s in changes of at most 1.8 m/s, steer over its whole range."""
    drive = reference(random, rows, period, (-0.6, 2.4), 1.8, (0.8, 3.0))
    steer = reference(random, rows, period, (-largest_steer, largest_steer), 2 * largest_steer, (0.4, 1.8))
    blocks = -(-rows // round(1.2 / period))
    coast = np.repeat(random.random(blocks) < 0.25, round(1.2 / period))[:rows]
    return Commands(drive, steer, coast)


def pendulum_commands(random: np.random.Generator, rows: int, period: float) -> Commands:
    """Torques of up to 3 N m either way."""
    drive = reference(random, rows, period, (-3.0, 3.0), 4.0, (0.2, 1.2))
    return Commands(drive, np.zeros(rows), np.zeros(rows, dtype=bool))


def wheels_commands(random: np.random.Generator, rows: int, period: float) -> Commands:
    """Speeds from -0.2 to 0.5 m/s, turn rates of up to 1.9 rad/s, which stand where the steer does."""
    drive = reference(random, rows, period, (-0.2, 0.5), 0.5, (0.5, 2.5))
    turn = reference(random, rows, period, (-1.9, 1.9), 2.5, (0.4, 1.8))
    return Commands(drive, turn, np.zeros(rows, dtype=bool))


def reference(
    random: np.random.Generator,
    rows: int,
    period: float,
    limits: tuple[float, float],
    largest_change: float,
    lengths: tuple[float, float],
) -> FloatArray:
    """Blocks of ``lengths`` seconds, each a step, a ramp or a sum of sines from the last value to a new one."""
    low, high = limits
    values = np.empty(rows)
    now, at = float(random.uniform(low, high)), 0
    while at < rows:
        count = min(rows - at, max(2, round(float(random.uniform(*lengths)) / period)))
        goal = float(np.clip(now + random.uniform(-largest_change, largest_change), low, high))
        kind = random.integers(3)
        along = np.arange(1, count + 1) / count
        if kind == 0:
            block = np.full(count, goal)
        elif kind == 1:
            block = now + (goal - now) * along
        else:
            block = goal + _sines(random, count, period, 0.25 * (high - low)) * np.sin(np.pi * along)
        values[at : at + count] = np.clip(block, low, high)
        now, at = float(values[at + count - 1]), at + count
    return values


def _sines(random: np.random.Generator, count: int, period: float, amplitude: float) -> FloatArray:
    """Three sines between 0.3 and 2 Hz with random phases; ``amplitude`` is the largest that they reach."""
    time = np.arange(count) * period
    waves = [np.sin(2 * np.pi * random.uniform(0.3, 2.0) * time + random.uniform(0, 2 * np.pi)) for _ in range(3)]
    return np.asarray(amplitude / 3 * sum(waves))


@dataclass(frozen=True)
class Lane:
    """One run to simulate."""

    effects: Effects
    commands: Commands
    start: tuple[float, ...]
    gain: float
    """1/s of the speed servo, m/s2 of the throttle; unused by a pendulum."""
    throttle: bool = False
    disturbance: FloatArray | None = None
    """(rows, 2): acceleration [m/s2] and yaw rate [rad/s] (pendulum: rad/s2 and nothing) that no one commanded."""


@dataclass(frozen=True)
class Trajectories:
    """True states (lanes, rows, states) as a perfect sensor shows them, and the actions (lanes, rows, actions)."""

    states: FloatArray
    actions: FloatArray


def gathered(lanes: Sequence[Lane], effect: str, parameter: str, neutral: float = 0.0) -> FloatArray:
    """One parameter of one effect in every lane, ``neutral`` where it is not hidden, shape (lanes,)."""
    return np.array([lane.effects.get(effect, {}).get(parameter, neutral) for lane in lanes], dtype=np.float64)


def per_lane(lanes: Sequence[Lane]) -> FloatArray:
    """The lanes' disturbances, zeros where there are none, shape (lanes, rows + 1, 2)."""
    rows = len(lanes[0].commands.drive)
    none = np.zeros((rows, 2))
    stacked = np.stack([none if lane.disturbance is None else lane.disturbance for lane in lanes])
    return np.concatenate([stacked, stacked[:, -1:]], axis=1)


def markov(random: np.random.Generator, rows: int, period: float, sizes: tuple[float, float]) -> FloatArray:
    """First-order Markov noise with a correlation time of 1 s: d[k+1] = a d[k] + sqrt(1 - a^2) size n, (rows, 2)."""
    keep = np.exp(-period / 1.0)
    drawn = random.standard_normal((rows, 2))
    values = np.empty((rows, 2))
    values[0] = drawn[0]
    for row in range(1, rows):
        values[row] = keep * values[row - 1] + np.sqrt(1.0 - keep**2) * drawn[row]
    return np.asarray(values * np.array(sizes))
