"""Cases in which an effect acts somewhere only, or its number changes with the time or the speed.

Borders are sharp where the library's models round them off.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from safedpa_lab.hidden.case import Case

__all__ = ["LAWS"]

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


LAWS: Final[dict[str, Callable[[int, int], Case]]] = {
    "patches": _patches,
    "sags": _sags,
    "speed_gains": _speed_gains,
}
"""By name of the suite: the case with a number and a seed."""
