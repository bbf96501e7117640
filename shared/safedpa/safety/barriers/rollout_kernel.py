"""Compiles a rollout barrier: its model, backup and h, if all three can be recorded.

Recorded are models whose rates are written over ``Operations``, functions with a parameter ``operations``, constant
backups, and barriers that are equations. A kernel is used only as long as it agrees with the functions themselves: what
they read besides their arguments is compared at every decision, and so are one step and h at the measured state.
"""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, TypeAlias, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import PhysicsModel
from safedpa.effects.law import plain
from safedpa.native import NoKernelError
from safedpa.native.captured import Captured
from safedpa.native.library import remark
from safedpa.native.rollout import FoundMinimum, RecordedItems, RolloutKernel
from safedpa.native.tracing import OverNumpy, RecordedFunction, record, takes_operations, why_not_recorded
from safedpa.operations import FLOATS
from safedpa.safety.barriers.backup_rollout import BackupRollout, fixed
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.barriers.equation import AbstractEquationBarrier, Pattern, pattern_of, tape_of
from safedpa.safety.barriers.function import FunctionBarrier
from safedpa.safety.barriers.step_function import StepFunction
from safedpa.safety.prediction.predictor import Prediction

__all__ = ["CompiledRollout", "Found", "RolloutParts", "find_kernel"]

_MOST_STATES: Final = 40
"""States of a function's model that are tried before the first state is known."""
_AGREE: Final = 1e-9
"""Relative difference between a kernel and the functions: some operations differ in the last bit."""


@final
@dataclass(frozen=True)
class RolloutParts:
    """What a rollout barrier was made from. ``backup`` is None for a constant one."""

    model: Any
    backup: Callable[..., Any] | None
    h: AbstractBarrier
    actions: int
    """Of a constant backup; 0: not known."""
    latents: int
    """Entries of the latent; of a model without a given latent, its own."""


Found: TypeAlias = tuple[RolloutKernel | None, str, list[Captured]]
"""The kernel, or None and the reason in one line; and what the recorded functions read besides their arguments."""


def find_kernel(parts: RolloutParts, states: int | None) -> Found:
    """Returns the kernel for a state of so many entries; None: found by trying, before the first state is known."""
    reason = _not_written_over_operations(parts)
    if reason:
        return None, reason, []
    watched = _watched(parts)
    impure = next((each.impure for each in watched if each.impure), "")
    if impure:
        return None, f"a function depends on more than its arguments: {impure}", watched
    h = parts.h.function if isinstance(parts.h, FunctionBarrier) else pattern_of((parts.h,))  # type: ignore[arg-type]
    reads = tuple(each.values for each in watched)
    try:
        states = states or _states_of(parts)
        kernel, reason = _compiled(parts.model, parts.backup, h, reads, states, parts.actions, parts.latents)
    except TypeError as error:  # an object that has no hash cannot be cached
        return None, str(error), watched
    if not all(each.unchanged() for each in watched):
        return None, "a function depends on more than its arguments: it changes what it reads", watched
    return kernel, reason, watched


def _not_written_over_operations(parts: RolloutParts) -> str:
    """Returns why nothing is tried: a part that is an ordinary function, or a model with networks."""
    if isinstance(parts.model, PhysicsModel):
        reason = _why_not_model(parts.model, parts.latents)
        if reason:
            return reason
    elif not takes_operations(parts.model):
        return f"the model {_named(parts.model)} has no parameter 'operations'"
    if parts.backup is not None and not takes_operations(parts.backup):
        return f"the backup {_named(parts.backup)} has no parameter 'operations'"
    h = parts.h
    function = h.function if isinstance(h, FunctionBarrier) else None
    if function is not None and not takes_operations(function):
        return f"h {_named(function)} has no parameter 'operations'"
    if function is None and not (isinstance(h, AbstractEquationBarrier) and _is_equation(type(h))):
        return f"the barrier {type(h).__name__} is no AbstractEquationBarrier"
    return ""


def _why_not_model(model: PhysicsModel, latents: int) -> str:
    own = next((item.name for item in model.effects if not type(plain(item)).__module__.startswith("safedpa.")), "")
    if own:
        return f"the model has the effect '{own}', which is not part of safedpa"
    if not model.base.recordable:
        return f"the base model '{model.base.kind}' declares that it cannot be recorded"
    if latents != len(model.latent_names):
        return f"latent: got {latents} entries, wanted {len(model.latent_names)}"
    return ""


def _is_equation(kind: type[AbstractEquationBarrier]) -> bool:
    """Whether h follows from the equation alone: a subclass may override it."""
    base = AbstractEquationBarrier
    return kind.h is base.h and kind.h_and_grad is base.h_and_grad


def _named(function: Any) -> str:
    """Returns a function's name, file and line."""
    code = getattr(inspect.unwrap(function), "__code__", None)
    name = getattr(function, "__qualname__", type(function).__name__)
    return name if code is None else f"{name} ({code.co_filename.rpartition('/')[2]} line {code.co_firstlineno})"


def _watched(parts: RolloutParts) -> list[Captured]:
    """Returns what the model, the backup and h read besides their arguments."""
    h = parts.h.function if isinstance(parts.h, FunctionBarrier) else None
    base = parts.model.base if isinstance(parts.model, PhysicsModel) else None
    model: list[Any] = [parts.model] if base is None else [base.rates, base.integrate]
    return [Captured(function) for function in (*model, parts.backup, h) if function is not None]


def _states_of(parts: RolloutParts) -> int:
    """Returns the smallest number of states for which a model as a function returns as many; 0: none."""
    if isinstance(parts.model, PhysicsModel):
        return len(parts.model.system.state_names)
    for states in range(1, _MOST_STATES + 1):
        try:
            backup = None if parts.backup is None else record(parts.backup, [("s", states)])
            actions = parts.actions if backup is None else len(backup.results)
            if len(_recorded_step(parts.model, states, actions, parts.latents).results) == states:
                return states
        except Exception:  # noqa: BLE001 - a user's function raises anything for a state of another size
            continue
    return 0


@lru_cache(maxsize=64)
def _compiled(
    model: Any, backup: Any, h: Any, reads: Hashable, states: int, actions: int, latents: int
) -> tuple[RolloutKernel | None, str]:
    # ``reads`` is part of the key only: the same function that reads other values is another function
    if not states:
        return None, "the number of states is not known before the first one"
    try:
        act = None if backup is None else record(backup, [("s", states)])
        actions = actions if act is None else len(act.results)
        step = _recorded_step(model, states, actions, latents)
        if len(step.results) != states:
            return None, f"the model returns {len(step.results)} entries for {states} states"
        return RolloutKernel.compiled(step, act, _recorded_h(h, states)), ""
    except NoKernelError as error:
        remark(str(error))
        return None, str(error)
    except Exception as error:  # noqa: BLE001 - a user's function raises anything while it is recorded
        return None, why_not_recorded(error)


def _recorded_step(model: Any, states: int, actions: int, latents: int) -> RecordedFunction:
    """Returns x[t+1] recorded from state, action, latent and time."""
    sizes = [("s", states), ("a", actions), ("z", latents), ("t", 1)]
    if isinstance(model, PhysicsModel):
        equations = model.equations(model.period)
        return record(lambda s, a, z, t, operations: equations([*s], [*a], [*z], t[0], operations), sizes)
    names = [name for name in inspect.signature(model).parameters if name != "operations"]
    if _is_step(model):
        takes = 2 + (latents > 0 and len(names) > 2)
        return record(lambda s, a, z, t, operations: model(*(s, a, z)[:takes], operations=operations), sizes)
    takes = 1 + (latents > 0 and len(names) > 1)

    def step(s: Any, a: Any, z: Any, t: Any, operations: Any) -> Any:
        f, g = model(*(s, z)[:takes], operations=operations)
        return np.asarray(f, dtype=object) + np.asarray(g, dtype=object).reshape(states, actions) @ a

    return record(step, sizes)


def _is_step(function: Callable[..., Any]) -> bool:
    """Whether a function of the user's is step(x, a) rather than affine(x), as ``prediction_of`` distinguishes them."""
    parameters = inspect.signature(OverNumpy(function)).parameters.values()
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return len([each for each in parameters if each.kind in kinds and each.default is each.empty]) >= 2


def _recorded_h(key: Callable[..., Any] | Pattern, states: int) -> RecordedItems:
    if callable(key):
        found = record(key, [("s", states)])
        return RecordedItems(found.inputs[0], (), (), found.lines, found.results, squares=False)
    tape = tape_of(key, states)
    return RecordedItems(
        tuple(tape.state), tuple(tape.shared[0]), tuple(tape.each[0]), tuple(tape.lines), tuple(tape.results[0]), True
    )


def _agrees(found: FloatArray, wanted: FloatArray) -> bool:
    """Whether a kernel's numbers are those of the functions, up to rounding."""
    if found.shape != wanted.shape:
        return False
    size = float(np.max(np.abs(wanted), initial=0.0))
    return bool(np.all(np.abs(found - wanted) <= _AGREE * size)) or np.array_equal(found, wanted, equal_nan=True)


@final
class CompiledRollout:
    """The kernel of one barrier, found again when its functions change; ``reason`` says why there is none.

    ``loop`` and ``h`` are the implementation in NumPy, with which the kernel must agree.
    """

    def __init__(self, model: Any, backup: Any, h: AbstractBarrier, loop: BackupRollout, horizon: int) -> None:
        self._loop, self._h, self._horizon = loop, h, horizon
        self._latent = np.empty(0) if loop.latent is None else np.array(loop.latent)
        if loop.latent is None and isinstance(model, PhysicsModel):
            self._latent = model.latent
        self._model = model if isinstance(model, PhysicsModel) else None
        own = backup if callable(backup) else None
        self._parts = RolloutParts(model, own, h, len(loop.held), len(self._latent))
        if self._model is not None:
            with contextlib.suppress(Exception):  # now, rather than while a robot drives; a decision reports what fails
                self._model.record_scalar_step()
        self._disagrees = False
        self._kernel: RolloutKernel | None = None
        self._watched: list[Captured] = []
        self._states: int | None = None
        self.reason = ""
        """Why there is no kernel, in one line; empty if there is one."""
        self._find(None)
        self.prediction = self._prediction(model)
        """The model of a function ``step(x, a, operations)``; None for others."""

    def _prediction(self, model: Any) -> Prediction | None:
        if self._model is not None or not takes_operations(model) or not _is_step(model) or len(self._latent):
            return None
        function = StepFunction(model)
        if self._kernel is not None:
            function.prepare(self._kernel.states, self._kernel.actions)
        return Prediction(function.affine, function.step)

    @property
    def time(self) -> float:
        """Seconds since the start of the run, of which a model's effects may depend."""
        return 0.0 if self._model is None else self._model.clock.seconds

    def kernel(self, states: int) -> RolloutKernel | None:
        """Returns the kernel for a state of so many entries, or None."""
        if self._kernel is None or self._kernel.states != states:
            return None
        return self._kernel

    def refresh(self, state: FloatArray) -> None:
        """Compares what the functions read, one step and h at ``state`` (states,) with the kernel's.

        Where they differ, the functions are recorded again; where they still do, the kernel is given up.
        """
        if self._disagrees:
            return
        kernel = self.kernel(len(state))
        tried = kernel is not None or self._states == len(state)
        # where the parts are no functions over operations, nothing is watched, and nothing is found by another attempt
        if not tried or not all(each.unchanged() for each in self._watched):
            self._find(len(state))
            kernel = self._kernel
        if kernel is None or not np.isfinite(state).all() or self._agrees_at(kernel, state):
            return
        self._disagrees, self._kernel = True, None
        self.reason = "the functions return other values than they did while they were recorded"
        remark(self.reason)

    def _find(self, states: int | None) -> None:
        self._states = states
        found, self.reason, self._watched = find_kernel(self._parts, states)
        self._kernel = None
        if found is not None and found.rows * max(len(self._items()[1]), 1) != len(self._h.names):
            self.reason = f"h has {found.rows} values, wanted {len(self._h.names)}: one for each name"
        elif found is not None:
            self._kernel = found.with_data(self._horizon, self._latent, self._loop.held, *self._items())

    def _items(self) -> tuple[Any, Any]:
        h = self._h
        return (h.shared, h.each) if isinstance(h, AbstractEquationBarrier) else ((), ((),))

    def _agrees_at(self, kernel: RolloutKernel, state: FloatArray) -> bool:
        path = kernel.path(None, state, self.time)
        if path is None:
            return True  # the implementation in NumPy answers, and reports it
        none = np.zeros(kernel.count)
        start = FoundMinimum(none, none.astype(np.int32), none, none)
        h = kernel.h_near(start, None, state, self.time)
        own = fixed(state)
        after = self._after(own, self._loop.action(own))
        return h is not None and _agrees(path[1], after) and _agrees(h, self._h.h(own))

    def _after(self, state: FloatArray, action: FloatArray) -> FloatArray:
        """x[t+1] by the equations themselves, not by a recording of them."""
        model = self._model
        if model is not None:
            entries = (state.tolist(), action.tolist(), self._latent.tolist())
            with contextlib.suppress(ValueError, ArithmeticError):  # values that Python's math functions refuse
                return np.array(model.equations(model.period)(*entries, self.time, FLOATS))
        return self._loop.after(state, action)

    def __getstate__(self) -> dict[str, Any]:
        """A loaded library cannot be pickled; the receiving process compiles it again, or finds it in the cache."""
        return {
            **self.__dict__,
            "_kernel": None,
            "_watched": [],
            "_states": None,
            "reason": "a copy that has not been used yet",
        }
