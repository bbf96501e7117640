"""Rollouts of many variants of a model over the same windows, from starts that are given."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from safedpa.diagnosis.rollout import common_period, felt_columns
from safedpa.diagnosis.side_by_side import SideBySide
from safedpa.diagnosis.windows import Floats, Rows, Windows
from safedpa.dynamics import PhysicsModel
from safedpa.effects import CommandEffect

__all__ = ["simulate"]


def simulate(models: Sequence[PhysicsModel], windows: Windows, rows: Rows, starts: Floats) -> Floats:
    """Predicted states (models, windows, compared, states); models of one structure, whose numbers may differ.

    ``starts`` (windows, states) or (models, windows, states). Beyond a window's end its last state stays: logs of
    different rates have windows of as many seconds and far fewer rows, which are not followed further.
    """
    size, last = starts.shape[-1], int(rows[-1])
    mechanics, felt = SideBySide(models), _felt(models, windows)
    period = common_period(windows)
    found = np.empty((len(models), len(windows), len(rows), size))
    order = np.argsort(-windows.steps, kind="stable")
    start, left = windows.start[order], -windows.steps[order]
    states = [np.ascontiguousarray(starts[..., order, index]) for index in range(size)]
    active = len(windows)
    for compared, (row, following) in enumerate(pairwise([*rows.tolist(), last])):
        for index, column in enumerate(states):
            found[..., index][:, order[:active], compared] = column
        for step in range(row, following):
            running = int(np.searchsorted(left, -step, side="left"))
            if running < active:
                for index, column in enumerate(states):
                    found[..., index][:, order[running:active], compared + 1 :] = column[..., running:, None]
                states, active = [column[..., :running] for column in states], running
            at = start[:active] + step
            seconds: Any = windows.period[at] if period is None else period
            states = mechanics.ahead(states, [column[..., at] for column in felt], seconds, windows.time[at])
    return found


def _felt(models: Sequence[PhysicsModel], windows: Windows) -> list[Floats]:
    """What each model's mechanics feel of each action: (rows,) where all feel the same, else (models, rows)."""
    if len({_commanded(model) for model in models}) == 1:
        return felt_columns(models[0], windows)
    columns = [felt_columns(model, windows) for model in models]
    found = []
    for own in zip(*columns, strict=True):
        same = all(np.array_equal(own[0], other) for other in own[1:])
        found.append(own[0] if same else np.stack(own))
    return found


def _commanded(model: PhysicsModel) -> tuple[float, ...]:
    """The numbers of the effects on its commands."""
    commands = [item for item in model.effects if isinstance(item, CommandEffect)]
    return tuple(model.settings[f"{item.name}.{p.name}"].value for item in commands for p in item.parameters)
