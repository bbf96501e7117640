"""A problem whose every answer can be checked: motion and barriers affine in state and action."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.safety import FilterSettings, FunctionBarrier, SafetyFilter, Verdict

__all__ = ["LinearProblem"]


@final
@dataclass(frozen=True, eq=False)
class LinearProblem:
    """x+ = f + g a and h = P x + q at one state, with a nominal action: what a filter is asked about, once.

    f and state (states,), g (states, actions), P (rows, states), q and epsilon (rows,), the rest (actions,).
    """

    shape: str
    """How it was drawn."""
    state: FloatArray
    f: FloatArray
    g: FloatArray
    P: FloatArray
    q: FloatArray
    low: FloatArray
    high: FloatArray
    nominal: FloatArray
    weights: FloatArray
    eta: float
    epsilon: FloatArray
    gradient: bool
    """Whether the filter is told the gradient of h."""
    witness: FloatArray | None = None
    """(actions,) an action that satisfies all conditions by construction."""

    def heights(self, state: FloatArray) -> FloatArray:
        """h (rows,) at a state (states,)."""
        return np.array([float(p @ state) + q for p, q in zip(self.P, self.q.tolist(), strict=True)])

    def after(self, action: FloatArray) -> FloatArray:
        """x+ (states,) under an action (actions,)."""
        return np.asarray(self.f + self.g @ action)

    def settings(self) -> FilterSettings:
        """The filter's settings for this problem: one margin a row, the middle of the box as the backup."""
        return FilterSettings(
            action_low=tuple(self.low.tolist()),
            action_high=tuple(self.high.tolist()),
            weights=tuple(self.weights.tolist()),
            backup_action=tuple(np.clip(0.5 * (self.low + self.high), self.low, self.high).tolist()),
            eta=self.eta,
            epsilon={f"row {index}": margin for index, margin in enumerate(self.epsilon.tolist())},
        )

    def barriers(self) -> list[FunctionBarrier]:
        """One barrier a row."""
        return [self._barrier(index) for index in range(len(self.q))]

    def filter(self) -> SafetyFilter:
        """The library's filter for this problem."""
        return SafetyFilter(lambda _: (self.f, self.g), self.barriers(), self.settings())

    def decide(self) -> Verdict:
        """What the library's filter says."""
        return self.filter().decide(self.state, nominal=self.nominal)

    def scaled(self, heights: FloatArray, states: FloatArray, actions: FloatArray) -> LinearProblem:
        """The same problem in other units: h_i times heights_i, x_j times states_j, a_k times actions_k."""
        return replace(
            self,
            state=self.state * states,
            f=self.f * states,
            g=self.g * states[:, None] / actions,
            P=self.P * heights[:, None] / states,
            q=self.q * heights,
            epsilon=self.epsilon * heights,
            low=self.low * actions,
            high=self.high * actions,
            nominal=self.nominal * actions,
            witness=None if self.witness is None else self.witness * actions,
        )

    def as_dict(self) -> dict[str, Any]:
        """Everything of it, for JSON."""
        return {
            name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in ((name, getattr(self, name)) for name in self.__dataclass_fields__)
        }

    def _barrier(self, index: int) -> FunctionBarrier:
        p, q = self.P[index], float(self.q[index])
        gradient = (lambda _: p) if self.gradient else None
        return FunctionBarrier(lambda x: float(p @ x) + q, gradient, (f"row {index}",), f"row {index}")
