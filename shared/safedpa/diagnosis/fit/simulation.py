"""Rollouts of many variants of a model over the same windows, from starts that are given."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from safedpa.arrays import FloatArray, IndexArray
from safedpa.comparison.rollout import effective_actions_by_name
from safedpa.comparison.side_by_side import StackedMechanics
from safedpa.comparison.windows import Windows
from safedpa.dynamics import PhysicsModel
from safedpa.effects import CommandEffect

__all__ = ["simulate"]


def simulate(models: Sequence[PhysicsModel], windows: Windows, rows: IndexArray, starts: FloatArray) -> FloatArray:
    """Predicted states (windows, compared, states, models); models of one structure, whose numbers may differ.

    ``starts`` (windows, states) or (models, windows, states). Beyond a window's end nothing is meant. The models come
    last, for what a fit does with them is done to each window's numbers of all models.
    """
    count, size = len(windows), starts.shape[-1]
    mechanics, felt = StackedMechanics(models), _felt(models, windows)
    states = [np.ascontiguousarray(starts[..., index]) for index in range(size)]
    period = windows.common_period
    found = np.empty((count, len(rows), size, len(models)))
    wanted = {int(row): index for index, row in enumerate(rows)}
    last = int(rows[-1])
    with np.errstate(all="ignore"):
        for step in range(last + 1):
            if step in wanted:
                for index, column in enumerate(states):
                    found[:, wanted[step], index] = column.T if column.ndim == 2 else column[:, None]
            if step < last:
                at = np.minimum(windows.start + step, windows.end - 1)
                seconds: Any = windows.period[at] if period is None else period
                states = mechanics.ahead(states, [column[..., at] for column in felt], seconds, windows.time[at])
    return found


def _felt(models: Sequence[PhysicsModel], windows: Windows) -> list[FloatArray]:
    """What each model's mechanics feel of each action: (rows,) where all feel the same, else (models, rows)."""
    if len({_commanded(model) for model in models}) == 1:
        return effective_actions_by_name(models[0], windows)
    columns = [effective_actions_by_name(model, windows) for model in models]
    found = []
    for own in zip(*columns, strict=True):
        same = all(np.array_equal(own[0], other) for other in own[1:])
        found.append(own[0] if same else np.stack(own))
    return found


def _commanded(model: PhysicsModel) -> tuple[float, ...]:
    """The numbers of the effects on its commands."""
    commands = [item for item in model.effects if isinstance(item, CommandEffect)]
    return tuple(model.settings[f"{item.name}.{p.name}"].value for item in commands for p in item.parameters)
