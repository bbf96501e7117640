"""Nominal policies that try to make a system crash."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa_lab.experiments.adversary.example_systems import ControlSystem

NominalPolicy = Callable[[FloatArray], FloatArray]

_HELD: Final = 8
"""Periods for which an adversary holds its nominal action in its mind."""
_LEG: Final = 12
"""Periods between two changes of a bang-bang nominal action."""


def _towards(system: ControlSystem, random: np.random.Generator) -> NominalPolicy:
    """The corner of the box that brings the least h down furthest if it is held for a while."""
    corners = _corners(system)

    def lowest(state: FloatArray, corner: FloatArray) -> float:
        least, at = float("inf"), state
        for _ in range(_HELD):
            reached = system.after(at, corner[None])[0]
            least, at = min(least, system.least_on_the_way(at, reached)), reached
        return least

    def nominal_action(state: FloatArray) -> FloatArray:
        then = np.array([lowest(state, corner) for corner in corners])
        return np.asarray(corners[int(np.argmin(then + 1e-12 * random.uniform(size=len(then))))])

    return nominal_action


def _anything(system: ControlSystem, random: np.random.Generator) -> NominalPolicy:
    low, high = np.array(system.low), np.array(system.high)
    return lambda _: random.uniform(low - 0.5 * (high - low), high + 0.5 * (high - low))


def _bang_bang(system: ControlSystem, random: np.random.Generator) -> NominalPolicy:
    def legs() -> Iterator[FloatArray]:
        corners = _corners(system)
        while True:
            yield from [corners[int(random.integers(len(corners)))]] * _LEG

    held = legs()
    return lambda _: next(held)


def _broken(system: ControlSystem, random: np.random.Generator) -> NominalPolicy:
    """Towards the obstacle, and NaN or infinity in every tenth period."""
    towards = _towards(system, random)

    def nominal_action(state: FloatArray) -> FloatArray:
        wanted = towards(state).copy()
        if random.uniform() < 0.1:
            wanted[int(random.integers(len(wanted)))] = random.choice([np.nan, np.inf, -np.inf])
        return wanted

    return nominal_action


def _corners(system: ControlSystem) -> FloatArray:
    sides = [np.array(side) for side in zip(system.low, system.high, strict=True)]
    return np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, len(sides))


NOMINAL_POLICIES: Final[dict[str, Callable[[ControlSystem, np.random.Generator], NominalPolicy]]] = {
    "towards": _towards,
    "random": _anything,
    "bang-bang": _bang_bang,
    "NaN now and then": _broken,
}
"""By name; episode n has the (n modulo their number)-th."""
