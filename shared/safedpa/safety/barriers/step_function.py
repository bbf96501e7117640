"""A user's ``step(x, a, operations)`` as the filter's model: compiled to C with its slopes in the action."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.native import NoKernelError
from safedpa.native.captured import Captured
from safedpa.native.library import remark
from safedpa.native.step import StepKernel
from safedpa.native.tracing import OverNumpy, record

__all__ = ["StepFunction"]

_NUDGE: Final = 1e-6
"""Step of a central difference in the action, times max(1, |a|): the cube root of the rounding error."""


@final
class StepFunction:
    """x[t+1] = step(x, a, operations), and f + g a about an action.

    Without a compiler, or if the function cannot be recorded, ``step`` calls it with the operations of NumPy, and g is
    a central difference. The same holds as soon as anything else that it reads has changed.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        self._plain = OverNumpy(function)
        self._watched = Captured(function)
        self._known: dict[tuple[int, int], StepKernel | None] = {}

    def step(self, state: FloatArray, action: FloatArray) -> FloatArray:
        """x[t+1] (states,)."""
        kernel = self._kernel(len(state), len(action))
        if kernel is None:
            return np.asarray(self._plain(state, action), dtype=np.float64)
        return np.array(kernel.step(state.tolist(), action.tolist(), (), 0.0))

    def affine(self, state: FloatArray, *, around: FloatArray) -> tuple[FloatArray, FloatArray]:
        """f (states,) and g (states, actions), tangent to the step at the action ``around``."""
        kernel = self._kernel(len(state), len(around))
        if kernel is None:
            value, g = self.step(state, around), self._differences(state, around)
        else:
            value, g = map(np.array, kernel.tangent(state.tolist(), around.tolist(), (), 0.0))
        return value - g @ around, g

    def compiled_step(self, states: int, actions: int) -> Any:
        """The compiled step and tangent as one object for the compiled search; None without a compiler."""
        kernel = self._kernel(states, actions)
        return None if kernel is None else kernel.compiled_step()

    def prepare(self, states: int, actions: int) -> None:
        """Compiles now, rather than while a robot drives."""
        self._kernel(states, actions)

    def _differences(self, state: FloatArray, around: FloatArray) -> FloatArray:
        columns = []
        for index, nudge in enumerate(_NUDGE * np.maximum(1.0, np.abs(around))):
            up, down = around.copy(), around.copy()
            up[index] += nudge
            down[index] -= nudge
            columns.append((self.step(state, up) - self.step(state, down)) / (up[index] - down[index]))
        return np.array(columns).T

    def _kernel(self, states: int, actions: int) -> StepKernel | None:
        if not self._watched.unchanged():
            self._watched, self._known = Captured(self.function), {}
        sizes = states, actions
        if sizes not in self._known:
            self._known[sizes] = None if self._watched.impure else self._compiled(*sizes)
        return self._known[sizes]

    def _compiled(self, states: int, actions: int) -> StepKernel | None:
        sizes = [("s", states), ("a", actions), ("z", 0), ("t", 1)]

        def step(s: Any, a: Any, z: Any, t: Any, operations: Any) -> Any:
            return self.function(s, a, operations=operations)

        try:
            recording = record(step, sizes)
            return StepKernel.compiled(recording) if len(recording.results) == states else None
        except NoKernelError as error:
            remark(str(error))
            return None
        except Exception:  # noqa: BLE001 - a user's function raises anything while it is recorded
            return None

    def __getstate__(self) -> dict[str, Any]:
        """A loaded library cannot be pickled; the receiving process compiles it again, or finds it in the cache."""
        return {**self.__dict__, "_known": {}}
