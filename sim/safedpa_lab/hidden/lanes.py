"""Many runs side by side: one lane a run, one number a lane for every parameter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from safedpa.arrays import FloatArray
from safedpa_lab.hidden.case import Effects
from safedpa_lab.hidden.excitation import Commands

__all__ = ["Lane", "Trajectories", "gathered", "markov", "per_lane"]


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
