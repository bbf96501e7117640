"""Simulates many variants of a model over the same windows, from given starts."""

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


def simulate(models: Sequence[PhysicsModel], windows: Windows, rows: IndexArray, starts: FloatArray) -> FloatArray:
    """Returns predicted states (windows, compared, states, models) of models that differ only in parameter values.

    ``starts`` is (windows, states) or (models, windows, states). Entries beyond the end of a window are meaningless.
    The models are the last axis because a fit works on one window's values of all models at a time.
    """
    count, size = len(windows), starts.shape[-1]
    # All models advance together: one vectorised step instead of one Python call per model.
    mechanics, effective = StackedMechanics(models), _effective_actions(models, windows)
    states = [np.ascontiguousarray(starts[..., index]) for index in range(size)]
    period = windows.common_period
    found = np.empty((count, len(rows), size, len(models)))
    column_of_row = {int(row): index for index, row in enumerate(rows)}
    last = int(rows[-1])
    with np.errstate(all="ignore"):
        for step in range(last + 1):
            if step in column_of_row:
                for index, column in enumerate(states):
                    found[:, column_of_row[step], index] = column.T if column.ndim == 2 else column[:, None]
            if step < last:
                # Shorter windows repeat their last step; callers ignore those rows.
                at = np.minimum(windows.start + step, windows.end - 1)
                seconds: Any = windows.period[at] if period is None else period
                states = mechanics.ahead(states, [column[..., at] for column in effective], seconds, windows.time[at])
    return found


def _effective_actions(models: Sequence[PhysicsModel], windows: Windows) -> list[FloatArray]:
    """Returns the actions after lags, delays and limits: (rows,) if all models agree, else (models, rows)."""
    # Difference quotients change one parameter at a time, so most variants share their commands: compute those once.
    if len({_command_parameters(model) for model in models}) == 1:
        return effective_actions_by_name(models[0], windows)
    columns = [effective_actions_by_name(model, windows) for model in models]
    found = []
    for variants in zip(*columns, strict=True):
        same = all(np.array_equal(variants[0], other) for other in variants[1:])
        found.append(variants[0] if same else np.stack(variants))
    return found


def _command_parameters(model: PhysicsModel) -> tuple[float, ...]:
    """Returns the parameter values of the effects that act on commands."""
    commands = [item for item in model.effects if isinstance(item, CommandEffect)]
    return tuple(model.settings[f"{item.name}.{p.name}"].value for item in commands for p in item.parameters)
