"""Circles without load, recorded from the pymunk car: the few real data that a learned model is tuned on.

The paper says "circles without load" and no more. Here a circle is a target speed and a steer that are held for 1 to
3 s; then both are drawn anew from the whole range of commands. So every radius and speed comes, the lag of the steering
and of the motor shows at each change, and so do reverse and braking. What is towed in the experiment never occurs here.
"""

from __future__ import annotations

from collections.abc import Callable
from math import pi

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import InputError
from safedpa.records import Run, Stretch
from safedpa.robots.car.system import CAR
from safedpa_sim.robots.car_parameters import CAR_PARAMETERS
from safedpa_sim.robots.world import CarWorld

__all__ = ["PERIOD", "circle_commands", "record_circles"]

PERIOD = 0.05
"""s."""

_HOLD = (1.0, 3.0)
"""s; shortest and longest time for which a circle is driven."""
_STANDING = 0.05
"""Share of the circles that are a stop: standing occurs in every drive, and draws from a range would never give it."""
_FIELD = (-1e3, 1e3, -1e3, 1e3)
"""m; no wall is ever reached."""

Floats = NDArray[np.float64]


def record_circles(
    pairs: int,
    seed: int,
    run_pairs: int = 1000,
    on_run: Callable[[int, int], None] = lambda _done, _all: None,
) -> tuple[Run, ...]:
    """Runs of ``run_pairs`` transitions each, at least ``pairs`` in all; the same seed gives the same runs.

    Raises InputError when fewer than one run or no transition is asked for.
    """
    if pairs < 1 or run_pairs < 2:
        raise InputError(f"circles: got {pairs} pairs in runs of {run_pairs}, wanted at least 1 in runs of 2 or more")
    count = -(-pairs // run_pairs)
    runs = []
    for index in range(count):
        runs.append(_recorded(f"circles_{index:02d}", np.random.default_rng([seed, index]), run_pairs))
        on_run(index + 1, count)
    return tuple(runs)


def circle_commands(random: np.random.Generator, rows: int) -> Floats:
    """Actions (rows, 2): target speed [m/s] and steer [rad], held for 1 to 3 s each."""
    car = CAR_PARAMETERS
    actions = np.empty((rows, 2))
    at = 0
    while at < rows:
        count = round(float(random.uniform(*_HOLD)) / PERIOD)
        speed = float(random.uniform(car.speed_low, car.speed_high))
        steer = float(random.uniform(-car.steer_limit, car.steer_limit))
        actions[at : at + count] = (0.0 if random.random() < _STANDING else speed), steer
        at += count
    return actions


def _recorded(name: str, random: np.random.Generator, pairs: int) -> Run:
    """One run of pairs + 1 rows from a standing start; the last row's action is that of the row before."""
    world = CarWorld((0.0, 0.0, float(random.uniform(-pi, pi))), _FIELD)
    actions = circle_commands(random, pairs)
    states = np.empty((pairs + 1, len(CAR.state)))
    states[0] = world.state
    for row, (speed, steer) in enumerate(actions.tolist()):
        world.advance(speed, steer, PERIOD)
        states[row + 1] = world.state
    t = PERIOD * np.arange(pairs + 1, dtype=np.float64)
    return Run(name, CAR, t, states, np.vstack([actions, actions[-1:]]), (Stretch(0, pairs + 1),))
