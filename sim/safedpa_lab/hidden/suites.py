"""Suites of hidden-effect cases; in some an effect acts somewhere only, or its number changes with time or speed.

Borders are sharp where the library's models round them off.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import combinations
from typing import Any, Final

import numpy as np

from safedpa.errors import InputError, did_you_mean
from safedpa_lab.hidden.bad_data import BAD
from safedpa_lab.hidden.case import CAR_EFFECTS, PENDULUM_EFFECTS, WHEELS_EFFECTS, Case, Robot, Strength
from safedpa_sim.robots.car.loads import LOADS

_JITTER = 0.1
"""Relative half width within which numbers vary from case to case."""


def _patches(index: int, seed: int) -> Case:
    """A carpet: a circle, all that lies beyond a line, all that lies before one."""
    random = np.random.default_rng(seed)
    pull = 1.1 * _about(random)
    if index % 3 == 0:
        at_x, at_y = (float(value) for value in random.uniform(-2.0, 2.0, 2))
        own = {"at_x": at_x, "at_y": at_y, "radius": 1.5 * _about(random)}
        phrase = "where circle"
    else:
        axis, side = str(random.choice(["x", "y"])), "above" if index % 3 == 1 else "below"
        own, phrase = {f"{axis}_{side}": float(random.uniform(-1.5, 1.5))}, f"where {axis} {side}"
    effects = {"rolling_resistance": {"deceleration": pull, **own}}
    return Case("patches", seed, effects, laws={"rolling_resistance": phrase})


def _sags(index: int, seed: int) -> Case:
    """Top speed, steering or dry friction falls with the time since the start."""
    random = np.random.default_rng(seed)
    name, number, at, rate = (
        ("speed_command_gain", "gain", 1.0, -0.004),
        ("steering_gain", "gain", 1.0, -0.004),
        ("rolling_resistance", "deceleration", 0.9, -0.015),
    )[index % 3]
    at = at if name != "rolling_resistance" else at * _about(random)
    effects = {name: {number: at, f"{number}_per_time": rate * _about(random)}}
    return Case("sags", seed, effects, laws={name: f"varies {number} with time"})


def _speed_gains(index: int, seed: int) -> Case:
    """Steering that gives less the faster the car goes, or from one speed on; a motor that gives less as it turns."""
    random = np.random.default_rng(seed)
    if index % 3 == 0:
        effects = {"steering_gain": {"gain": 1.0, "gain_per_abs_speed": -0.08 * _about(random)}}
        return Case("speed_gains", seed, effects, laws={"steering_gain": "varies gain with abs_speed"})
    if index % 3 == 1:
        effects = {"torque_gain": {"gain": 1.0, "gain_per_abs_rate": -0.04 * _about(random)}}
        laws = {"torque_gain": "varies gain with abs_rate"}
        return Case("speed_gains", seed, effects, "pendulum", seconds=20.0, laws=laws)
    effects = {"steering_gain": {"gain": 1.0 - 0.2 * _about(random), "abs_speed_above": 1.2 * _about(random)}}
    return Case("speed_gains", seed, effects, laws={"steering_gain": "where abs_speed above"})


def _about(random: np.random.Generator) -> float:
    return 1.0 + float(random.uniform(-_JITTER, _JITTER))


LAWS: Final[dict[str, Callable[[int, int], Case]]] = {"patches": _patches, "sags": _sags, "speed_gains": _speed_gains}
"""By name of the suite: the case with a number and a seed."""


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


def _none(suite: str, index: int, seed: int, hard: bool) -> Case:
    return Case(suite, seed, {}, drive="throttle" if index % 4 == 3 else "speed_servo", hard=hard)


def _in_turn(suite: str, robot: Robot, effects: Mapping[str, Strength], index: int, seed: int, **length: Any) -> Case:
    name = list(effects)[index % len(effects)]
    return Case(suite, seed, {name: effects[name].drawn(np.random.default_rng(seed))}, robot, **length)


def _towing(index: int, seed: int) -> Case:
    load = LOADS["chair" if index % 2 == 0 else "large_chair"]
    hidden = {"towed_load": {"mass_ratio": load.mass_ratio, "deceleration": load.deceleration}}
    return Case("towing", seed, hidden, load=load.name)


def _one_log(seed: int) -> Case:
    """Side wind and a speed servo that reaches too little, in one log: greedy search named a third effect."""
    random = np.random.default_rng(seed)
    effects = {name: CAR_EFFECTS[name].drawn(random) for name in ("constant_force", "speed_command_gain")}
    return Case("one_log", seed, effects, runs=1)


def _bad(index: int, seed: int) -> Case:
    fault = list(BAD)[index % len(BAD)]
    throttle = fault == "percent" or (index // len(BAD)) % 2 == 1
    return Case("bad", seed, {}, drive="throttle" if throttle else "speed_servo", runs=3, fault=fault)


SUITES: Final[dict[str, Callable[[int, int], Case]]] = {
    "ordinary": lambda index, seed: _single("ordinary", index, seed, 1.0, False),
    "fifth": lambda index, seed: _single("fifth", index, seed, 0.2, False),
    "two": lambda _, seed: _several("two", seed, 2),
    "three": lambda _, seed: _several("three", seed, 3),
    "hard": lambda index, seed: _single("hard", index, seed, 1.0, True),
    "none": lambda index, seed: _none("none", index, seed, False),
    "none_hard": lambda index, seed: _none("none_hard", index, seed, True),
    "pendulum": lambda index, seed: _in_turn("pendulum", "pendulum", PENDULUM_EFFECTS, index, seed, seconds=20.0),
    "towing": _towing,
    **LAWS,
    "bad": _bad,
    "wheels": lambda index, seed: _in_turn(
        "wheels", "differential_drive", WHEELS_EFFECTS, index, seed, runs=4, seconds=30.0
    ),
    "wheels_none": lambda _, seed: Case("wheels_none", seed, {}, "differential_drive", runs=4, seconds=30.0),
    "one_log": lambda _, seed: _one_log(seed),
}
"""By name: the case with a number and a seed. One effect in turn at ordinary strength or a fifth of it, or in hard
logs; two or three drawn ones; nothing; a pendulum's; the pymunk car with a chair hitched; effects in a place, that sag,
and with the speed; nothing, but one of the runs gone bad; a differential drive's, and one with nothing hidden;
side wind and a reduced speed in one log."""
