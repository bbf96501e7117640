"""Pendulums with something in them that no model knows, and swings that show it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import PhysicsModel, Setting, load_model
from safedpa.effects import effect
from safedpa.records.run import Run, Stretch
from safedpa_sim.robots.pendulum.world import PendulumParameters, PendulumWorld

__all__ = ["HIDDEN", "PERIOD", "HiddenPendulum", "oracle_model", "swing_at_random", "swings_all_around"]

PERIOD: Final = 0.01
"""s"""
_TORQUE: Final = 10.0
"""N m; the motor's."""
_HELD: Final = (5, 40)
"""Periods for which a torque is held."""


@dataclass(frozen=True)
class HiddenPendulum:
    """The robot's own numbers, and the effects of the library that say so."""

    parameters: PendulumParameters
    effects: Mapping[str, Mapping[str, float]]


HIDDEN: Final = {
    "payload": HiddenPendulum(PendulumParameters(payload=0.5), {"tip_mass": {"mass": 0.5}}),
    "dry friction": HiddenPendulum(PendulumParameters(dry_friction=1.5), {"coulomb_friction": {"torque": 1.5}}),
    "both": HiddenPendulum(
        PendulumParameters(payload=0.5, dry_friction=1.5),
        {"tip_mass": {"mass": 0.5}, "coulomb_friction": {"torque": 1.5}},
    ),
}
"""By name: half a kilogram more on one, a hinge that rubs."""


def oracle_model(hidden: HiddenPendulum) -> PhysicsModel:
    """The shipped model, its wind free, with what is hidden added to it."""
    model = load_model("pendulum")
    for name, values in hidden.effects.items():
        model = model.with_effect(effect("pendulum", name), {key: Setting(value) for key, value in values.items()})
    return model


def swings_all_around(
    hidden: HiddenPendulum, wind: tuple[float, float], seed: int, count: int, seconds: float
) -> list[Run]:
    """Runs as an engineer makes them to see what a pendulum does: torques at random, each held for a while.

    ``wind`` [m/s] along x and y blows through all of them.
    """
    rows, system = round(seconds / PERIOD), load_model("pendulum").system
    runs = []
    for number in range(count):
        random = np.random.default_rng([seed, number, 6])
        world = PendulumWorld(float(random.uniform(-np.pi, np.pi)), wind, hidden.parameters)
        states, torques = swing_at_random(world, random, rows, _TORQUE, _HELD)
        t = np.arange(rows, dtype=np.float64) * PERIOD
        runs.append(Run(f"swing {number + 1}", system, t, states, torques, (Stretch(0, rows),)))
    return runs


def swing_at_random(
    world: PendulumWorld, random: np.random.Generator, rows: int, largest: float, held: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """States (rows, 2) [rad, rad/s] and the torques (rows, 1) that follow them, uniform within +- ``largest`` [N m].

    Each is held for a number of periods that lies within ``held``, its upper end not included.
    """
    states, torques = np.empty((rows, 2)), np.empty((rows, 1))
    left, torque = 0, 0.0
    for row in range(rows):
        if left == 0:
            left, torque = int(random.integers(*held)), float(random.uniform(-largest, largest))
        left -= 1
        states[row], torques[row] = (world.angle, world.rate), torque
        world.advance(torque, PERIOD)
    return states, torques
