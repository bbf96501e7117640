"""A model under its backup action: where a state would go from now on."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, TypeAlias, final

import numpy as np
from numpy.typing import ArrayLike

from safedpa.arrays import FloatArray
from safedpa.dynamics import AbstractDynamics
from safedpa.errors import InputError
from safedpa.native.tracing import with_numpy
from safedpa.safety.prediction.predictor import Prediction
from safedpa.safety.validation import checked_output

__all__ = ["BackupRollout", "Model", "fixed", "prediction_of"]

Model: TypeAlias = AbstractDynamics | Prediction | Callable[..., Any]
"""A model of this project, a ``Prediction``, ``affine(x) -> f, g``, or ``step(x, a) -> next state``."""


def prediction_of(model: Model) -> Prediction:
    """Returns the prediction of a model; of a function ``step(x, a)`` only the next state is known.

    Raises InputError for an object that is no model, and for a model with actuator memory, which x does not contain.
    """
    if isinstance(model, Prediction):
        return model
    if isinstance(model, AbstractDynamics):
        middle = 0.5 * (model.system.action_low + model.system.action_high)
        memory = model.initial_memory(middle)
        if any(part is not None and np.size(part) for part in memory or ()):
            raise InputError(
                f"model: got one of '{model.system.name}' with actuator memory, wanted one whose next state follows "
                "from state and action alone; put a delay into the state (PendingActions), not into the model"
            )
        return Prediction.of_model(model)
    if not callable(model):
        raise InputError(f"model: got {model!r}, wanted a model, a Prediction, affine(x) or step(x, a)")
    model = with_numpy(model)
    return Prediction(_no_tangent, model) if _arguments(model) >= 2 else Prediction(model)


def _no_tangent(state: FloatArray) -> Any:
    raise InputError("model: got step(x, a) alone, wanted affine(x) for derivatives; give Prediction(affine, step)")


def _arguments(function: Callable[..., Any]) -> int:
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    # Arguments with a default do not count: step(x, a, dt=0.05) is a step, affine(x, dt=0.05) is not.
    needed = [p for p in inspect.signature(function).parameters.values() if p.kind in kinds and p.default is p.empty]
    return len(needed)


@final
class BackupRollout:
    """x[t+1] = step(x[t], backup(x[t])); ``backup`` is a function of the state (states,), or one action (actions,)."""

    def __init__(
        self, model: Model, backup: Callable[..., ArrayLike] | ArrayLike, latent: ArrayLike | None = None
    ) -> None:
        self.prediction = prediction_of(model)
        self._free = None if latent is None else _flat("latent", latent)
        self.latent = None if self._free is None else tuple(self._free.tolist())
        self._ours = self.prediction.is_project_model
        self._backup = with_numpy(backup) if callable(backup) else None
        self._held = np.empty(0) if callable(backup) else _flat("backup", backup)

    def action(self, state: FloatArray) -> FloatArray:
        """The backup's action (actions,). Raises InputError if it is no vector."""
        if self._backup is None:
            return self._held
        array = checked_output("backup", self._backup(state))
        if array.ndim != 1:
            raise InputError(f"backup: got shape {array.shape}, wanted (actions,)")
        return array

    def after(self, state: FloatArray, action: FloatArray) -> FloatArray:
        """x[t+1] (states,), read-only. Raises InputError if it has another shape."""
        if self._ours:  # recorded equations in Python floats, without the overhead of small arrays
            start = tuple(state.tolist())
            found = np.array(self.prediction.next_state_floats(start, action.tolist(), self.latent, None))
        else:
            found = np.array(self.prediction.next_state(state, action, self._free, None))
            if found.shape != state.shape:
                raise InputError(f"predicted state: got shape {found.shape}, wanted {state.shape}")
        found.flags.writeable = False
        return found

    def path(self, state: FloatArray, ticks: int) -> list[FloatArray]:
        """States (1 + ticks at most) from ``state`` on under the backup; ends early when nothing moves any more.

        Raises InputError if a state is not finite.
        """
        path = [fixed(state)]
        for _ in range(ticks):
            path.append(self.after(path[-1], self.action(path[-1])))
            # Bit for bit at rest: all further states would be the same, so the horizon takes no time there.
            if path[-1].tobytes() == path[-2].tobytes():
                break
        # Checked once for the whole path: NaN persists, so the last states show it.
        if not np.isfinite(np.array(path)).all():
            raise InputError(f"model or backup: got NaN or infinity on the way from {path[0].tolist()}")
        return path

    def sensitivities(self, path: list[FloatArray]) -> list[FloatArray] | None:
        """d(path[k])/d(path[0]) (states, states) for every k, exact, by the recorded equations of the model.

        None if the model has none, and for a backup that is a function, whose derivative is not known.
        """
        if not self.constant:
            return None
        count, found = len(path[0]), [np.eye(len(path[0]))]
        try:
            for state in path[:-1]:
                derivatives = self.prediction.sensitivity_floats(state.tolist(), self._held.tolist(), self.latent)
                if derivatives is None:
                    return None
                found.append(np.array(derivatives)[:, :count] @ found[-1])  # the chain rule along the path
        except (ValueError, ArithmeticError):  # values that Python's math functions refuse
            return None
        return found

    @property
    def held(self) -> FloatArray:
        """The constant backup (actions,); empty for a function."""
        return self._held

    @property
    def constant(self) -> bool:
        """Whether the backup is one action for every state."""
        return self._backup is None


def fixed(state: FloatArray) -> FloatArray:
    """A read-only copy."""
    copied = np.array(state, dtype=np.float64)
    copied.flags.writeable = False
    return copied


def _flat(what: str, value: ArrayLike) -> FloatArray:
    array = checked_output(what, value)
    if array.ndim != 1 or not np.isfinite(array).all():
        raise InputError(f"{what}: got {value!r}, wanted (actions,) finite numbers")
    array.flags.writeable = False
    return array
