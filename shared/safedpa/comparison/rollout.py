"""Open-loop rollouts of a model, all windows of all runs side by side.

What the actuators feel does not depend on the state. So commands are followed once along each stretch, from its first
row, and every window reads the felt actions of its rows: their memory (lag, delay) is that of the whole past of the
stretch, and never of the future.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from safedpa.arrays import FloatArray, IndexArray
from safedpa.comparison.actuators import effective_action_columns
from safedpa.comparison.side_by_side import StackedMechanics
from safedpa.comparison.windows import Windows, windows_of
from safedpa.dynamics import PhysicsModel
from safedpa.effects import CommandEffect
from safedpa.errors import InputError
from safedpa.operations import FLOATS, NUMPY
from safedpa.records.run import Run
from safedpa.systems import System

__all__ = [
    "check_system", "effective_actions", "effective_actions_by_name", "predict_run", "rollout", "rollout_at",
    "rollout_steps",
]  # fmt: skip

Columns = dict[str, FloatArray]
"""One action's value in every row, by the action's name."""

_CACHED = 16
"""How many chains of commands are kept: a search over effects asks for the same ones again and again."""


def rollout(model: PhysicsModel, windows: Windows) -> FloatArray:
    """Predicted states (steps + 1, windows, states), the measured start first, NaN after the end of a window."""
    longest = int(windows.steps.max())
    predicted = np.full((longest + 1, len(windows), len(windows.system.state)), np.nan)
    predicted[0] = windows.states[windows.start]
    for step, active, states in rollout_steps(model, windows):
        predicted[step, active] = states
    return predicted


def predict_run(model: PhysicsModel, run: Run, horizon: float, *, stride: int = 10) -> dict[str, FloatArray]:
    """A table of predictions from every ``stride``-th trusted row: columns start_t, t [s] and the states by name.

    One entry per measured row after the start, up to and including the horizon (to half a period) or the end of the
    stretch, whichever comes first; starts in order, and within a start by time. Only the state at the start and the
    run's actions before t enter a prediction at t. Raises InputError and RunError as ``windows_of`` does.
    """
    windows = windows_of([run], horizon, stride=stride, partial=True)
    predicted = rollout(model, windows)[1:]
    step = np.arange(1, len(predicted) + 1)
    there = step[None, :] <= windows.steps[:, None]
    rows = (windows.start[:, None] + step[None, :])[there]
    starts = np.repeat(windows.start, windows.steps)
    states = predicted.transpose(1, 0, 2)[there]
    columns = {"start_t": windows.t[starts], "t": windows.t[rows]}
    return columns | {name: states[:, index] for index, name in enumerate(windows.system.state_names)}


def rollout_at(model: PhysicsModel, windows: Windows, rows: Sequence[IndexArray]) -> FloatArray:
    """Predicted states (len(rows), windows, states) at one row a window, for each entry (windows,) of ``rows``."""
    wanted = [at - windows.start for at in rows]
    predicted = np.full((len(wanted), len(windows), len(windows.system.state)), np.nan)
    for step, active, states in rollout_steps(model, windows):
        for index, at in enumerate(wanted):
            hit = at[active] == step
            if hit.any():
                predicted[index, active[hit]] = states[hit]
    return predicted


def rollout_steps(model: PhysicsModel, windows: Windows) -> Iterator[tuple[int, IndexArray, FloatArray]]:
    """Yields step number from 1, the windows that still run (active,), and their predicted states (active, states).

    x[k+1] = model(x[k], felt action of row k, period from row k to row k+1), from the measured state at the start.
    Numbers that grow without bound become infinite or NaN; the caller judges them.

    Raises InputError when model and runs are of different systems.
    """
    check_system(model.system, windows.system, windows.names[0])
    mechanics, felt = StackedMechanics([model]), effective_actions_by_name(model, windows)
    order = np.argsort(-windows.steps, kind="stable")
    start, steps = windows.start[order], windows.steps[order]
    states = list(windows.states[start].T)
    period = windows.common_period
    for step in range(int(steps.max(initial=0))):
        active = int(np.searchsorted(-steps, -step, side="left"))
        rows = start[:active] + step
        seconds: Any = windows.period[rows] if period is None else period
        now = [column[:active] for column in states]
        with np.errstate(all="ignore"):  # not around the loop: anyone who takes the steps would be silenced as well
            states = mechanics.ahead(now, [column[rows] for column in felt], seconds, windows.time[rows])
        yield step + 1, order[:active], np.stack(states, axis=-1)


def effective_actions(model: PhysicsModel, windows: Windows) -> FloatArray:
    """What the mechanics feel of each row's action over the period after it, shape (rows, actions).

    Every stretch starts with actuators that have settled at its first action.
    """
    columns = effective_actions_by_name(model, windows)
    return np.stack(columns, axis=-1) if columns else windows.actions  # nothing acts on a ball that falls


def effective_actions_by_name(model: PhysicsModel, windows: Windows) -> list[FloatArray]:
    """The same action by action, (rows,) each."""
    names = windows.system.action_names
    columns = {name: windows.actions[:, index] for index, name in enumerate(names)}
    key: tuple[Any, ...] = ()
    commands = sorted((e for e in model.effects if isinstance(e, CommandEffect)), key=lambda item: int(item.stage))
    for command in commands:
        own = {p.name: model.settings[f"{command.name}.{p.name}"].value for p in command.parameters}
        key = (*key, command, tuple(own.items()))
        if key not in windows.memo:
            while len(windows.memo) >= _CACHED:
                windows.memo.pop(next(iter(windows.memo)))
            windows.memo[key] = _transformed(command, columns, own, windows)
        columns = windows.memo[key]
    return [np.ascontiguousarray(np.broadcast_to(columns[name], windows.actions.shape[:1])) for name in names]


def _transformed(command: CommandEffect, columns: Columns, own: dict[str, float], windows: Windows) -> Columns:
    """One effect on all rows: at once when it remembers nothing, else row after row."""
    if command.initial_memory(dict.fromkeys(columns, 0.0)) is not None:
        at_once = effective_action_columns(command, columns, own, windows)
        return _followed(command, columns, own, windows) if at_once is None else at_once
    period: Any = windows.period
    return dict(command.transform(columns, None, own, period, NUMPY)[0])


def _followed(command: CommandEffect, columns: Columns, own: dict[str, float], windows: Windows) -> Columns:
    """One pass along every stretch in plain floats: 2 us a row, where one-row arrays would take 20."""
    names = tuple(columns)
    rows = list(zip(*(columns[name].tolist() for name in names), strict=True))
    periods = windows.period.tolist()
    felt = []
    for begin, stop in windows.bounds.tolist():
        memory: Any = None
        for row in range(begin, stop):
            action = dict(zip(names, rows[row], strict=True))
            if row == begin:
                memory = command.initial_memory(action)
            out, memory = command.transform(action, memory, own, periods[row], FLOATS)
            felt.append([out[name] for name in names])
    table = np.array(felt, dtype=np.float64).T
    return dict(zip(names, table, strict=True))


def check_system(mine: System, theirs: System, run: str) -> None:
    """Raises InputError when the model's system is another one than that of a run."""
    if (mine.name, mine.state_names, mine.action_names) != (theirs.name, theirs.state_names, theirs.action_names):
        raise InputError(
            f"{run}: a run of robot '{theirs.name}' with actions {', '.join(theirs.action_names)}; the "
            f"model is of robot '{mine.name}' with actions {', '.join(mine.action_names)}; choose a model of that robot"
        )
