"""Suites of hidden-effect cases."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import Final

import numpy as np

from safedpa.errors import InputError, did_you_mean
from safedpa_lab.hidden.bad_data import BAD
from safedpa_lab.hidden.case import Case
from safedpa_lab.hidden.laws import LAWS
from safedpa_lab.hidden.strengths import CAR_EFFECTS, PENDULUM_EFFECTS, WHEELS_EFFECTS
from safedpa_sim.robots.car.loads import LOADS

__all__ = ["INSEPARABLE", "SUITES", "cases_of"]

INSEPARABLE: Final[tuple[frozenset[str], ...]] = tuple(
    frozenset(pair)
    for pair in (
        # (a - m d) / (1 + m): payload and rolling resistance together are a towed load, and any two make a third
        ("payload", "towed_load"),
        ("payload", "rolling_resistance"),
        ("towed_load", "rolling_resistance"),
        # two delays of one channel add up, a lag is a delay to first order
        ("actuator_delay", "steering_delay"),
        ("actuator_delay", "drive_delay"),
        ("actuator_delay", "steering_lag"),
        ("actuator_delay", "drive_lag"),
        ("steering_delay", "drive_delay"),
        ("steering_lag", "steering_delay"),
        ("drive_lag", "drive_delay"),
        # beyond the stops nothing is left of a gain
        ("steering_gain", "steering_saturation"),
        # k (g u - v) against k (u - v) - c v: equal but for the pole, k against k + c
        ("viscous_drag", "speed_command_gain"),
    )
)
"""Pairs that are not hidden together: their sum is, exactly or to first order, that of other effects."""


def cases_of(suite: str, count: int, seed: int = 0) -> list[Case]:
    """``count`` cases of a suite, each different; the same ones for the same seed. Raises InputError."""
    if suite not in SUITES:
        raise InputError(f"suite '{suite}': {did_you_mean(suite, [*SUITES, 'all'])}")
    number = list(SUITES).index(suite)
    made = []
    for index in range(count):
        own = int(np.random.SeedSequence([seed, number, index]).generate_state(1)[0])
        made.append(SUITES[suite](index, own))
    return made


def _single(suite: str, index: int, seed: int, share: float, hard: bool) -> Case:
    name = list(CAR_EFFECTS)[index % len(CAR_EFFECTS)]
    strength = CAR_EFFECTS[name]
    effects = {name: strength.drawn(np.random.default_rng(seed), share)}
    return Case(suite, seed, effects, drive=strength.drive, hard=hard)


def _several(suite: str, seed: int, count: int) -> Case:
    random = np.random.default_rng(seed)
    while True:
        names = [str(name) for name in random.choice(list(CAR_EFFECTS), count, replace=False)]
        drives = {CAR_EFFECTS[name].drive for name in names}
        if any(frozenset(pair) in INSEPARABLE for pair in combinations(names, 2)):
            continue
        if "throttle" in drives and "speed_command_gain" in names:
            continue  # it scales the command of a speed servo
        effects = {name: CAR_EFFECTS[name].drawn(random) for name in names}
        return Case(suite, seed, effects, drive="throttle" if "throttle" in drives else "speed_servo")


def _ordinary(index: int, seed: int) -> Case:
    return _single("ordinary", index, seed, 1.0, False)


def _fifth(index: int, seed: int) -> Case:
    return _single("fifth", index, seed, 0.2, False)


def _hard(index: int, seed: int) -> Case:
    return _single("hard", index, seed, 1.0, True)


def _two(index: int, seed: int) -> Case:
    del index
    return _several("two", seed, 2)


def _three(index: int, seed: int) -> Case:
    del index
    return _several("three", seed, 3)


def _none(index: int, seed: int) -> Case:
    return Case("none", seed, {}, drive="throttle" if index % 4 == 3 else "speed_servo")


def _none_hard(index: int, seed: int) -> Case:
    return Case("none_hard", seed, {}, drive="throttle" if index % 4 == 3 else "speed_servo", hard=True)


def _pendulum(index: int, seed: int) -> Case:
    name = list(PENDULUM_EFFECTS)[index % len(PENDULUM_EFFECTS)]
    effects = {name: PENDULUM_EFFECTS[name].drawn(np.random.default_rng(seed))}
    return Case("pendulum", seed, effects, "pendulum", seconds=20.0)


def _wheels(index: int, seed: int) -> Case:
    name = list(WHEELS_EFFECTS)[index % len(WHEELS_EFFECTS)]
    effects = {name: WHEELS_EFFECTS[name].drawn(np.random.default_rng(seed))}
    return Case("wheels", seed, effects, "differential_drive", runs=4, seconds=30.0)


def _wheels_none(index: int, seed: int) -> Case:
    del index
    return Case("wheels_none", seed, {}, "differential_drive", runs=4, seconds=30.0)


def _towing(index: int, seed: int) -> Case:
    load = LOADS["chair" if index % 2 == 0 else "large_chair"]
    hidden = {"towed_load": {"mass_ratio": load.mass_ratio, "deceleration": load.deceleration}}
    return Case("towing", seed, hidden, load=load.name)


def _bad(index: int, seed: int) -> Case:
    fault = list(BAD)[index % len(BAD)]
    throttle = fault == "percent" or (index // len(BAD)) % 2 == 1
    return Case("bad", seed, {}, drive="throttle" if throttle else "speed_servo", runs=3, fault=fault)


SUITES: Final[dict[str, Callable[[int, int], Case]]] = {
    "ordinary": _ordinary,
    "fifth": _fifth,
    "two": _two,
    "three": _three,
    "hard": _hard,
    "none": _none,
    "none_hard": _none_hard,
    "pendulum": _pendulum,
    "towing": _towing,
    **LAWS,
    "bad": _bad,
    "wheels": _wheels,
    "wheels_none": _wheels_none,
}
"""By name: the case with a number and a seed. One effect in turn at ordinary strength or a fifth of it, or in hard
logs; two or three drawn ones; nothing; a pendulum's; the pymunk car with a chair hitched; effects in a place, that sag,
and with the speed; nothing, but one of the runs gone bad; a differential drive's, and one with nothing hidden."""
