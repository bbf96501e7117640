"""A small control system with its barrier, as someone would bring it to the filter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.safety import FilterSettings, FunctionBarrier, SafetyFilter
from safedpa.safety.barriers.base import AbstractBarrier

__all__ = ["PERIOD", "ControlSystem"]


PERIOD = 0.05
"""s."""


@final
@dataclass(frozen=True, eq=False)
class ControlSystem:
    """x+ = f(x) + g(x) a in periods of 50 ms, and h (m,) >= 0 of states (n, states)."""

    name: str
    f: Callable[[FloatArray], FloatArray]
    """(states,) of a state (states,)."""
    g: Callable[[FloatArray], FloatArray]
    """(states, actions)."""
    h: Callable[[FloatArray], FloatArray]
    """(n, m) of states (n, states): what must not fall below 0 in truth."""
    start: Callable[[np.random.Generator], FloatArray]
    low: tuple[float, ...]
    high: tuple[float, ...]
    backup: Callable[[FloatArray], Any]
    """(actions,) what is done without a decision, at a state."""
    margin: float
    """Of h, in the half of the episodes that have one."""
    eta: float = 0.2
    judged: Callable[[FloatArray], FloatArray] | None = None
    """(n, m) of states (n, states): what the filter is given to keep instead of h itself."""
    barriers: Callable[[], list[AbstractBarrier]] | None = None
    """The filter's barriers where they are none of functions; slower to judge."""
    invariant: bool = True
    """Whether the barrier promises that h stays positive: not where an action moves h only after several periods."""
    count: int = 1
    """m."""
    swept: Callable[[FloatArray, FloatArray], float] | None = None
    """Least h in truth on the way from a state to the next one; without it the states at the ticks count."""

    def filter(self, margin: float) -> SafetyFilter:
        """The library's filter for this system."""
        middle = tuple(0.5 * (low + high) for low, high in zip(self.low, self.high, strict=True))
        settings = FilterSettings(
            action_low=self.low,
            action_high=self.high,
            backup_action=middle,
            eta=self.eta,
            epsilon=margin,  # type: ignore[arg-type]
        )
        return SafetyFilter(lambda x: (self.f(x), self.g(x)), self.given(), settings, backup=self._backup)

    def given(self) -> list[AbstractBarrier]:
        """The barriers that the filter is given."""
        if self.barriers is not None:
            return self.barriers()
        names, h = tuple(f"h {index}" for index in range(self.count)), self.judged or self.h
        return [FunctionBarrier(lambda x: h(x[None])[0], names=names)]

    def least_on_the_way(self, state: FloatArray, reached: FloatArray) -> float:
        """Least h in truth from one tick to the next."""
        least = float(self.h(reached[None]).min())
        return least if self.swept is None else min(least, self.swept(state, reached))

    def heights(self, states: FloatArray, since: FloatArray | None = None) -> FloatArray:
        """(n, m) what the filter is to keep, at states (n, states), which one tick leads to from ``since``."""
        if self.barriers is None:
            return (self.judged or self.h)(states)
        parts = [part if since is None else part.since(since) for part in self.barriers()]
        return np.stack([np.concatenate([part.values(state) for part in parts]) for state in states])

    def after(self, state: FloatArray, actions: FloatArray) -> FloatArray:
        """x+ (n, states) under actions (n, actions)."""
        return np.asarray(self.f(state) + actions @ self.g(state).T)

    def _backup(self, state: FloatArray | None) -> Any:
        if state is None:
            return np.array([0.5 * (low + high) for low, high in zip(self.low, self.high, strict=True)])
        return np.clip(self.backup(state), self.low, self.high)
