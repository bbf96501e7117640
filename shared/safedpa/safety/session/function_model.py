"""The user's own functions as the model of a session: no actuators with memory, and a period that the user states."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from types import SimpleNamespace
from typing import Any, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.safety.prediction.predictor import Prediction
from safedpa.safety.validation import Plausible
from safedpa.systems import System, Variable

__all__ = ["FunctionModel", "system_of_functions"]


def system_of_functions(state_range: Plausible | None, states: int, actions: int) -> System:
    """A system without units for functions that do not name theirs; names from ``state_range`` if there is one."""
    names = tuple(f"entry {index}" for index in range(states)) if state_range is None else state_range.names
    return System(
        "",
        tuple(Variable(name, "", -inf, inf) for name in names),
        tuple(Variable(f"action {index}", "", -inf, inf) for index in range(actions)),
    )


@final
class FunctionModel:
    """The part of ``PhysicsModel`` that a session uses, for a prediction of functions."""

    def __init__(self, prediction: Prediction, system: System, period: float) -> None:
        self._prediction, self.system, self.period = prediction, system, period
        self.latent = np.zeros(0)
        self.clock = SimpleNamespace(seconds=0.0)

    def initial_memory(self, action: FloatArray, latent: FloatArray | None = None) -> tuple[()]:
        """Always empty: functions have no actuators with memory."""
        del action, latent
        return ()

    def felt(
        self, action: Sequence[float], memory: Any, latent: Sequence[float] | None = None, *, period: float
    ) -> tuple[list[float], Any]:
        """The action itself (actions,), and no memory."""
        del latent, period
        return list(action), memory

    def scalar_step(self, period: float) -> None:
        """None: there are no recorded equations."""
        del period

    def advance(
        self,
        state: FloatArray,
        action: FloatArray,
        memory: Any,
        latent: FloatArray | None,
        *,
        period: float | None = None,
    ) -> tuple[FloatArray, Any]:
        """The state (states,) after ``period`` [s]; for a part of the model's own period, that share of its change."""
        free = None if latent is None or not len(latent) else tuple(latent.tolist())
        after = np.array(self._prediction.next_state_floats(tuple(state.tolist()), action.tolist(), free, None))
        share = 1.0 if period is None else period / self.period
        return (after if share == 1.0 else state + share * (after - state)), memory

    def rollout_held(
        self,
        state: FloatArray,
        action: FloatArray,
        memory: Any,
        latent: FloatArray | None,
        steps: int,
        *,
        period: float,
    ) -> tuple[list[list[float]], Any]:
        """States (steps, states) under a held action."""
        rows = []
        for _ in range(steps):
            state, memory = self.advance(state, action, memory, latent, period=period)
            rows.append(state.tolist())
        return rows, memory
