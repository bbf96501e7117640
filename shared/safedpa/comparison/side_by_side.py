"""Models of one structure whose numbers may differ, all of them one step ahead at once.

A search asks a few dozen structures for thousands of rollouts. Each structure's equations are recorded once, as a
straight line over arrays (``safedpa.dynamics.straight``) with its numbers as arguments. States and actions are columns,
one array an entry, and what is the same in all models has no axis for them: a steering angle's tangent is taken once,
whatever the number of models.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import PhysicsModel
from safedpa.dynamics.base import AbstractBase
from safedpa.dynamics.settings import Setting
from safedpa.dynamics.straight import StraightStep
from safedpa.effects import AbstractEffect, CommandEffect

__all__ = ["StackedMechanics"]

_CACHED = 128
"""Structures whose straight line is kept."""


@final
class StackedMechanics:
    """The mechanics of models that share base and effects: what each makes of felt actions."""

    def __init__(self, models: Sequence[PhysicsModel]) -> None:
        first = models[0]
        others = tuple(item for item in first.effects if not isinstance(item, CommandEffect))
        owners = {"base", *(item.name for item in others)}
        values = {
            path: [model.settings[path].value for model in models]
            for path in first.settings
            if path.split(".")[0] in owners
        }
        varied = {path for path, own in values.items() if len(set(own)) > 1}
        free = {path for path in values if path in varied or first.settings[path].free or path[:5] != "base."}
        fixed = tuple((path, own[0]) for path, own in values.items() if path not in free)
        self._step, names = _recorded(first.base, others, frozenset(free), fixed)
        self._models = len(models)
        self._reference = None
        if self._step is None:
            settings = {path: Setting(own[0], path in varied) for path, own in values.items()}
            self._reference = PhysicsModel(first.base, others, settings, first.period, holds=True)
            names = self._reference.latent_names
        self._numbers: list[Any] = [
            np.array(values[path])[:, None] if path in varied else np.float64(values[path][0]) for path in names
        ]

    def ahead(
        self, states: Sequence[FloatArray], felt: Sequence[FloatArray], period: Any, time: Any
    ) -> list[FloatArray]:
        """Columns of the states one ``period`` [s] later, (models, n) or (n,) where all models have the same.

        So are the columns of ``states`` and felt actions; period and ``time`` [s] are numbers or (n,). Numbers may
        grow without bound: who asks for thousands of steps silences numpy's warnings once, around all of them.
        """
        if self._step is not None:
            return self._step(states, felt, [*self._numbers, period], time)
        return self._by_reference(states, felt, period, time)

    def _by_reference(
        self, states: Sequence[FloatArray], felt: Sequence[FloatArray], period: Any, time: Any
    ) -> list[FloatArray]:
        """The same where the equations cannot be recorded: everything flat, (models * n,)."""
        assert self._reference is not None
        shape = np.broadcast_shapes(*(column.shape for column in (*states, *felt)))
        shape = shape if self._models == 1 else (self._models, shape[-1])
        now, action = (_flat(columns, shape) for columns in (states, felt))
        latent = _flat(self._numbers, shape) if self._numbers else None
        period, time = (np.broadcast_to(each, shape).reshape(-1) if np.ndim(each) else each for each in (period, time))
        after, _ = self._reference.advance(now, action, (), latent, period=period, time=time)
        return [column.reshape(shape) for column in after.T]


def _flat(columns: Sequence[FloatArray], shape: tuple[int, ...]) -> FloatArray:
    """A table (everything, columns)."""
    if not columns:  # nothing acts on a ball that falls
        return np.zeros((int(np.prod(shape)), 0))
    return np.stack([np.broadcast_to(column, shape).reshape(-1) for column in columns], axis=-1)


@lru_cache(maxsize=_CACHED)
def _recorded(
    base: AbstractBase,
    effects: tuple[AbstractEffect, ...],
    free: frozenset[str],
    fixed: tuple[tuple[str, float], ...],
) -> tuple[StraightStep | None, tuple[str, ...]]:
    """The straight line of a structure and the order of its free numbers, after which it takes the period."""
    named = {f"base.{item.name}": item for item in base.parameters}
    named |= {f"{owner.name}.{item.name}": item for owner in effects for item in owner.parameters}
    settings = {path: Setting(named[path].start, free=True) for path in free}
    settings |= {path: Setting(value) for path, value in fixed}
    model = PhysicsModel(base, effects, settings, holds=True)
    return model.straight_arrays(None), model.latent_names
