"""Open-loop rollouts of a model over all windows of all runs at once.

Actuators do not depend on the state. So the effective actions (after lags, delays and limits) are computed once along
each stretch, from its first row, and every window reads those of its rows. They depend on the whole past of the stretch
and never on its future.
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
"""The value of each action in every row, by the action's name."""

# Cached chains of command effects: a search over effects evaluates the same chains repeatedly.
_CACHED = 16


def rollout(model: PhysicsModel, windows: Windows) -> FloatArray:
    """Returns predicted states (steps + 1, windows, states): the measured start first, NaN after a window's end."""
    longest = int(windows.steps.max())
    predicted = np.full((longest + 1, len(windows), len(windows.system.state)), np.nan)
    predicted[0] = windows.states[windows.start]
    for step, active, states in rollout_steps(model, windows):
        predicted[step, active] = states
    return predicted


def predict_run(model: PhysicsModel, run: Run, horizon: float, *, stride: int = 10) -> dict[str, FloatArray]:
    """Returns a table of predictions from every ``stride``-th trusted row: start_t and t [s], and the states by name.

    There is one entry per measured row after the start, up to the horizon (plus half a period) or the end of the
    stretch. Entries are sorted by start, then by time. A prediction at t uses only the state at the start and the
    actions before t. Raises InputError and RunError as ``windows_of`` does.
    """
    windows = windows_of([run], horizon, stride=stride, partial=True)
    predicted = rollout(model, windows)[1:]
    step = np.arange(1, len(predicted) + 1)
    inside = step[None, :] <= windows.steps[:, None]
    rows = (windows.start[:, None] + step[None, :])[inside]
    starts = np.repeat(windows.start, windows.steps)
    states = predicted.transpose(1, 0, 2)[inside]
    columns = {"start_t": windows.t[starts], "t": windows.t[rows]}
    return columns | {name: states[:, index] for index, name in enumerate(windows.system.state_names)}


def rollout_at(model: PhysicsModel, windows: Windows, rows: Sequence[IndexArray]) -> FloatArray:
    """Returns predicted states (len(rows), windows, states) at one row per window, for each entry of ``rows``."""
    wanted = [at - windows.start for at in rows]
    predicted = np.full((len(wanted), len(windows), len(windows.system.state)), np.nan)
    for step, active, states in rollout_steps(model, windows):
        for index, at in enumerate(wanted):
            hit = at[active] == step
            if hit.any():
                predicted[index, active[hit]] = states[hit]
    return predicted


def rollout_steps(model: PhysicsModel, windows: Windows) -> Iterator[tuple[int, IndexArray, FloatArray]]:
    """Yields the step from 1, the windows that have not ended (active,), and their predicted states (active, states).

    x[k+1] = model(x[k], effective action of row k, period from row k to row k+1), from the measured state at the start.
    Diverging predictions become infinite or NaN; the caller handles them.

    Raises InputError if model and runs are of different systems.
    """
    check_system(model.system, windows.system, windows.names[0])
    mechanics, effective = StackedMechanics([model]), effective_actions_by_name(model, windows)
    # Longest windows first, so that the active ones are always a leading slice.
    order = np.argsort(-windows.steps, kind="stable")
    start, steps = windows.start[order], windows.steps[order]
    states = list(windows.states[start].T)
    period = windows.common_period
    for step in range(int(steps.max(initial=0))):
        active = int(np.searchsorted(-steps, -step, side="left"))
        rows = start[:active] + step
        seconds: Any = windows.period[rows] if period is None else period
        now = [column[:active] for column in states]
        # Inside the loop: around it, the caller's code between two steps would lose its warnings too.
        with np.errstate(all="ignore"):
            states = mechanics.ahead(now, [column[rows] for column in effective], seconds, windows.time[rows])
        yield step + 1, order[:active], np.stack(states, axis=-1)


def effective_actions(model: PhysicsModel, windows: Windows) -> FloatArray:
    """Returns the effective action of each row over the period after it, (rows, actions).

    Every stretch starts with actuators that have settled at its first action.
    """
    columns = effective_actions_by_name(model, windows)
    # A system may have no actions, such as a falling ball.
    return np.stack(columns, axis=-1) if columns else windows.actions


def effective_actions_by_name(model: PhysicsModel, windows: Windows) -> list[FloatArray]:
    """Returns the effective actions as a list, (rows,) for each action."""
    names = windows.system.action_names
    columns = {name: windows.actions[:, index] for index, name in enumerate(names)}
    key: tuple[Any, ...] = ()
    commands = sorted((e for e in model.effects if isinstance(e, CommandEffect)), key=lambda item: int(item.stage))
    for command in commands:
        parameters = {p.name: model.settings[f"{command.name}.{p.name}"].value for p in command.parameters}
        key = (*key, command, tuple(parameters.items()))
        if key not in windows.memo:
            while len(windows.memo) >= _CACHED:
                windows.memo.pop(next(iter(windows.memo)))
            windows.memo[key] = _apply_effect(command, columns, parameters, windows)
        columns = windows.memo[key]
    return [np.ascontiguousarray(np.broadcast_to(columns[name], windows.actions.shape[:1])) for name in names]


def _apply_effect(command: CommandEffect, columns: Columns, parameters: dict[str, float], windows: Windows) -> Columns:
    """Applies one effect to all rows: vectorised if it has no memory or is a known lag or delay, else row by row."""
    if command.initial_memory(dict.fromkeys(columns, 0.0)) is not None:
        vectorised = effective_action_columns(command, columns, parameters, windows)
        return _row_by_row(command, columns, parameters, windows) if vectorised is None else vectorised
    period: Any = windows.period
    return dict(command.transform(columns, None, parameters, period, NUMPY)[0])


def _row_by_row(command: CommandEffect, columns: Columns, parameters: dict[str, float], windows: Windows) -> Columns:
    """Applies an effect with memory row by row in plain floats: 2 us per row, where one-row arrays would take 20."""
    names = tuple(columns)
    rows = list(zip(*(columns[name].tolist() for name in names), strict=True))
    periods = windows.period.tolist()
    effective = []
    for begin, stop in windows.bounds.tolist():
        memory: Any = None
        for row in range(begin, stop):
            action = dict(zip(names, rows[row], strict=True))
            if row == begin:
                memory = command.initial_memory(action)
            out, memory = command.transform(action, memory, parameters, periods[row], FLOATS)
            effective.append([out[name] for name in names])
    table = np.array(effective, dtype=np.float64).T
    return dict(zip(names, table, strict=True))


def check_system(model_system: System, run_system: System, run: str) -> None:
    """Raises InputError if a run is of another system than the model."""
    if (model_system.name, model_system.state_names, model_system.action_names) != (
        run_system.name,
        run_system.state_names,
        run_system.action_names,
    ):
        raise InputError(
            f"{run}: a run of robot '{run_system.name}' with actions {', '.join(run_system.action_names)}; the "
            f"model is of robot '{model_system.name}' with actions {', '.join(model_system.action_names)}; choose a "
            "model of that robot"
        )
