"""A system: names, units, bounds and angles of a robot's state and action."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from safedpa.result import one_line


@dataclass(frozen=True)
class Variable:
    """One quantity: ``name``, ``unit``, ``low`` and ``high`` of its plausible range, and whether it is an ``angle``.

    Raises InputError for a range that is empty.

    Example:

        >>> safedpa.Variable("speed", "m/s", -1.0, 5.0)
        Variable(name='speed', unit='m/s', low=-1.0, high=5.0, angle=False)
    """

    name: str
    unit: str
    low: float
    high: float
    angle: bool = False


@dataclass(frozen=True, repr=False)
class System:
    """State and action of one kind of robot: its ``name``, the variables of ``state`` and of ``action``, in order.

    Bounds of the state are the range outside which a measurement is rejected as implausible; bounds of the action are
    what the actuator accepts. ``rotations`` names the entries (w, x, y, z) of each unit quaternion of the state: a
    model keeps their length 1, and q and -q are the same attitude.

    Example:

        >>> height, thrust = safedpa.Variable("height", "m", 0.0, 9.0), safedpa.Variable("thrust", "N", 0.0, 20.0)
        >>> safedpa.System("rocket", (height,), (thrust,))
        System(name=rocket, state=height, action=thrust)
    """

    name: str
    state: tuple[Variable, ...]
    action: tuple[Variable, ...]
    rotations: tuple[tuple[str, str, str, str], ...] = ()

    def __repr__(self) -> str:
        names = {"state": ", ".join(self.state_names), "action": ", ".join(self.action_names)}
        return one_line("System", {"name": self.name, **names})

    @cached_property
    def state_names(self) -> tuple[str, ...]:
        """Names of the state's entries, in order."""
        return tuple(variable.name for variable in self.state)

    @cached_property
    def action_names(self) -> tuple[str, ...]:
        """Names of the action's entries, in order."""
        return tuple(variable.name for variable in self.action)

    @cached_property
    def angles(self) -> tuple[int, ...]:
        """Indices of the state's angles."""
        return tuple(index for index, variable in enumerate(self.state) if variable.angle)

    @cached_property
    def action_low(self) -> NDArray[np.float64]:
        """Lower actuator bounds, shape (actions,)."""
        return np.array([variable.low for variable in self.action])

    @cached_property
    def action_high(self) -> NDArray[np.float64]:
        """Upper actuator bounds, shape (actions,)."""
        return np.array([variable.high for variable in self.action])

    @cached_property
    def state_low(self) -> NDArray[np.float64]:
        """Lower plausible bounds of the state, shape (states,)."""
        return np.array([variable.low for variable in self.state])

    @cached_property
    def state_high(self) -> NDArray[np.float64]:
        """Upper plausible bounds of the state, shape (states,)."""
        return np.array([variable.high for variable in self.state])

    def is_plausible(self, state: NDArray[np.float64]) -> bool:
        """Returns whether a measured state (states,) is finite and within the plausible bounds."""
        return self.is_plausible_floats(state.tolist())

    def is_plausible_floats(self, state: Sequence[float]) -> bool:
        """Returns ``is_plausible`` for Python floats: for a few entries faster than arrays."""
        for value, (low, high) in zip(state, self._state_bounds, strict=True):
            if not (isfinite(value) and low <= value <= high):
                return False
        return True

    @cached_property
    def _rotations(self) -> list[list[int]]:
        return [[self.state_names.index(name) for name in names] for names in self.rotations]

    @cached_property
    def _state_bounds(self) -> tuple[tuple[float, float], ...]:
        return tuple(zip(self.state_low.tolist(), self.state_high.tolist(), strict=True))

    def difference(self, later: NDArray[np.float64], earlier: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns later - earlier (..., states), with differences of angles wrapped to [-pi, pi).

        Of quaternions, the sign of ``later`` is the one that is nearer: the length of their difference is then
        2 sin(angle / 4), half the angle in rad of a small rotation.
        """
        change = np.asarray(later - earlier, dtype=np.float64)
        for entries in self._rotations:
            one, other = np.broadcast_arrays(later[..., entries], earlier[..., entries])
            sign = np.where((one * other).sum(axis=-1, keepdims=True) < 0.0, -1.0, 1.0)
            change[..., entries] = sign * one - other
        for index in self.angles:
            change[..., index] = (change[..., index] + np.pi) % (2 * np.pi) - np.pi
        return change
