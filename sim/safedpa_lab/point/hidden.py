"""Point robots with something about them that no model knows, and logs that show it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, final

import numpy as np

from safedpa.dynamics import load_model
from safedpa.records.run import Run, Stretch
from safedpa_sim.point.body import CONTROL_SECONDS, POINT_BODY
from safedpa_sim.point.body_steps import centre_state, controls_of
from safedpa_sim.point.point_model import ACTION_SCALE
from safedpa_sim.point.simulation import PointSimulation

__all__ = ["HIDDEN", "HiddenPoint", "hide", "point_logs"]

_HELD: Final = 25
"""Periods for which an action is held."""
_NOISE: Final = np.array([0.001, 0.001, 0.002, 0.005, 0.005])
"""m, rad, m/s; standard deviations of what the sensors add."""


@final
@dataclass(frozen=True)
class HiddenPoint:
    """A robot as it is, and what the library calls it; the shipped model knows its mass alone."""

    force: tuple[float, float]
    """N, constant in the world."""
    effects: Mapping[str, Mapping[str, float]]


_SLOPE: Final = (-0.0042, 0.0042)
HIDDEN: Final = {
    "force and drag": HiddenPoint(
        force=_SLOPE,
        effects={
            "constant_force": {"ax": _SLOPE[0] / POINT_BODY.mass, "ay": _SLOPE[1] / POINT_BODY.mass},
            "viscous_drag": {"coefficient": POINT_BODY.slide_damping / POINT_BODY.mass},
        },
    ),
}
"""By name: 0.006 N towards 135 degrees, as on a sloping table, and the damping of the slides."""


def hide(hidden: HiddenPoint, simulation: PointSimulation) -> None:
    """Makes all robots of a simulation like this."""
    simulation.force[:] = np.array(hidden.force)[:, np.newaxis]


def point_logs(hidden: HiddenPoint, seed: int, count: int, seconds: float) -> list[Run]:
    """Runs in open space under thrust and turn at random, each held for half a second, read by noisy sensors."""
    random, rows = np.random.default_rng([seed, 47]), round(seconds / CONTROL_SECONDS)
    simulation = PointSimulation(count)
    hide(hidden, simulation)
    simulation.pose[2] = random.uniform(-np.pi, np.pi, count)
    states, actions = np.empty((rows, count, 5)), np.empty((rows, count, 2))
    for row in range(rows):
        if row % _HELD == 0:
            action = random.uniform(-0.8, 0.8, (count, 2)) * ACTION_SCALE
        states[row], actions[row] = centre_state(simulation), action
        simulation.advance(controls_of(action))
    seen = np.asarray(states + random.normal(0.0, 1.0, states.shape) * _NOISE, dtype=np.float64)
    t = CONTROL_SECONDS * np.arange(rows, dtype=np.float64)
    system = load_model("point").system
    return [
        Run(f"log {index + 1}", system, t, seen[:, index], actions[:, index], (Stretch(0, rows),))
        for index in range(count)
    ]
