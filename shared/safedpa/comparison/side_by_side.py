"""Advances many models of one structure, with different parameter values, by one step at once.

A search needs thousands of rollouts of a few dozen structures. The equations of each structure are recorded once as
straight-line code over arrays (``safedpa.dynamics.recorded_step``), with the parameters as arguments. States and
actions are columns, one array per entry. What is equal in all models has no axis for them, so the tangent of a steering
angle is computed once for any number of models.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import PhysicsModel
from safedpa.dynamics.base import AbstractBase
from safedpa.dynamics.recorded_step import ScalarStep
from safedpa.dynamics.settings import Setting
from safedpa.effects import AbstractEffect, CommandEffect

# Structures whose straight-line code is cached: more than one search uses.
_CACHED = 128


@final
class StackedMechanics:
    """The mechanics of models that share base and effects, without the effects on commands."""

    def __init__(self, models: Sequence[PhysicsModel]) -> None:
        first = models[0]
        others = tuple(item for item in first.effects if not isinstance(item, CommandEffect))
        owners = {"base", *(item.name for item in others)}
        values = {
            path: [model.settings[path].value for model in models]
            for path in first.settings
            if path.split(".")[0] in owners
        }
        varied = {path for path, variants in values.items() if len(set(variants)) > 1}
        # Parameters of effects and varied ones become arguments of the recorded code; the base's fixed ones are
        # constants in it.
        free = {path for path in values if path in varied or first.settings[path].free or path[:5] != "base."}
        fixed = tuple((path, variants[0]) for path, variants in values.items() if path not in free)
        self._step, names = _recorded(first.base, others, frozenset(free), fixed)
        self._models = len(models)
        self._reference = None
        if self._step is None:
            settings = {path: Setting(variants[0], path in varied) for path, variants in values.items()}
            self._reference = PhysicsModel(first.base, others, settings, first.period, holds=True)
            names = self._reference.latent_names
        self._parameters: list[Any] = [
            np.array(values[path])[:, None] if path in varied else np.float64(values[path][0]) for path in names
        ]

    def ahead(
        self, states: Sequence[FloatArray], effective: Sequence[FloatArray], period: Any, time: Any
    ) -> list[FloatArray]:
        """Returns the columns of the states one ``period`` [s] later, (models, n), or (n,) if all models agree.

        The columns of ``states`` and effective actions have the same shapes; ``period`` and ``time`` [s] are numbers or
        (n,). States may diverge. The caller suppresses NumPy's warnings, once around all steps.
        """
        if self._step is not None:
            return self._step(states, effective, [*self._parameters, period], time)
        return self._by_reference(states, effective, period, time)

    def _by_reference(
        self, states: Sequence[FloatArray], effective: Sequence[FloatArray], period: Any, time: Any
    ) -> list[FloatArray]:
        """Advances models whose equations cannot be recorded, with all arrays flattened to (models * n,)."""
        assert self._reference is not None
        shape = np.broadcast_shapes(*(column.shape for column in (*states, *effective)))
        shape = shape if self._models == 1 else (self._models, shape[-1])
        now, action = (_flat(columns, shape) for columns in (states, effective))
        latent = _flat(self._parameters, shape) if self._parameters else None
        period, time = (np.broadcast_to(each, shape).reshape(-1) if np.ndim(each) else each for each in (period, time))
        after, _ = self._reference.advance(now, action, (), latent, period=period, time=time)
        return [column.reshape(shape) for column in after.T]


def _flat(columns: Sequence[FloatArray], shape: tuple[int, ...]) -> FloatArray:
    """Broadcasts columns to ``shape`` and stacks them as a table (n, columns)."""
    if not columns:  # a system without actions, such as a falling ball
        return np.zeros((int(np.prod(shape)), 0))
    return np.stack([np.broadcast_to(column, shape).reshape(-1) for column in columns], axis=-1)


@lru_cache(maxsize=_CACHED)
def _recorded(
    base: AbstractBase,
    effects: tuple[AbstractEffect, ...],
    free: frozenset[str],
    fixed: tuple[tuple[str, float], ...],
) -> tuple[ScalarStep | None, tuple[str, ...]]:
    """Returns the recorded step of a structure and the order of its free parameters; the period comes last."""
    named = {f"base.{item.name}": item for item in base.parameters}
    named |= {f"{owner.name}.{item.name}": item for owner in effects for item in owner.parameters}
    settings = {path: Setting(named[path].start, free=True) for path in free}
    settings |= {path: Setting(value) for path, value in fixed}
    model = PhysicsModel(base, effects, settings, holds=True)
    return model.batch_step(None), model.latent_names
