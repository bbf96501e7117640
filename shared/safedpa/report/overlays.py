"""Figures of predicted and measured trajectories, one per window, from the worst to the best."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from safedpa.arrays import FloatArray, IndexArray
from safedpa.comparison.comparison import Comparison
from safedpa.comparison.rollout import rollout
from safedpa.comparison.rollout_error import measured_rates
from safedpa.comparison.where import POSITION
from safedpa.comparison.windows import Windows
from safedpa.report.comparison_figures import COLOURS, LEGEND
from safedpa.report.panels import Panels, label

EACH = 4
"""Windows of each kind: worst, 95 % quantile, median and best."""

MOST_ROWS = 250
"""Points of one line at most."""

STYLES = {
    "measured": (2.0, "solid"),
    "model": (2.5, "solid"),
    "constant_velocity": (1.5, "dot"),
    "before": (2.0, "dash"),
    "after": (2.5, "solid"),
}
"""Width and dash of each line."""


def overlay_figures(comparison: Comparison, after: Comparison | None = None) -> list[dict[str, Any]]:
    """Returns a figure for each window of ``chosen_windows``, with a ``label`` for the selection list.

    The lines are the model and constant velocity, or with ``after``, of the same windows, both models.
    """
    chosen = chosen_windows(comparison)
    windows = comparison.windows.select(np.array([index for _, index in chosen], dtype=np.int64))
    predicted, rates = rollout(comparison.model, windows), measured_rates(windows)
    improved = rollout(after.model, windows) if after is not None and after is not comparison else None
    figures = []
    for number, (kind, index) in enumerate(chosen):
        part, error = (slice(windows.steps[number] + 1), number), f"{comparison.window_errors[index]:.2f}"
        if after is None:
            rows = np.arange(windows.start[number], windows.end[number] + 1)
            elapsed = (windows.clock[rows] - windows.clock[rows[0]])[:, None]
            lines = {"model": predicted[part], "constant_velocity": windows.states[rows[0]] + rates[number] * elapsed}
        else:
            lines = {"before": predicted[part]}
        if after is not None and improved is not None:
            lines["after"] = improved[part]
            error += f" before, {after.window_errors[index]:.2f} after"
        figure = window_figure(windows, number, lines)
        at, run = windows.time[windows.start[number]], windows.names[windows.run[number]]
        figure["label"] = f"{kind}: error {error}, {run} at {at:.1f} s"
        figures.append(figure)
    return figures


def chosen_windows(comparison: Comparison) -> list[tuple[str, int]]:
    """Returns (kind, window) pairs: the worst, those at the 95 % quantile, the median and the best.

    Windows of one kind do not overlap. Windows in which the states change by less than a tenth of the usual change are
    skipped if there are others: predicting a robot at rest is no test.
    """
    windows, errors = comparison.windows, comparison.window_errors
    scale = np.where(comparison.error.scale > 0, comparison.error.scale, np.inf)
    change = windows.system.difference(windows.states[windows.end], windows.states[windows.start])
    moving = np.flatnonzero(np.isfinite(errors) & (np.sqrt(((change / scale) ** 2).mean(axis=1)) > 0.1))
    if not len(moving):
        moving = np.flatnonzero(np.isfinite(errors))
    if not len(moving):
        moving = np.arange(len(errors))
    order = moving[np.argsort(-errors[moving], kind="stable")]
    chosen: list[tuple[str, int]] = []
    for kind, share in (("worst", 0.0), ("95 % quantile", 0.05), ("median", 0.5), ("best", 1.0)):
        near = np.argsort(np.abs(np.arange(len(order)) - share * (len(order) - 1)), kind="stable")
        chosen += [(kind, index) for index in _not_overlapping(windows, order[near], EACH)]
    return chosen


def _not_overlapping(windows: Windows, order: IndexArray, count: int) -> list[int]:
    retained: list[int] = []
    for index in order.tolist():
        middle = windows.clock[windows.start[index]]
        if all(abs(middle - windows.clock[windows.start[other]]) > windows.horizon for other in retained):
            retained.append(index)
        if len(retained) == count:
            break
    return retained


def window_figure(windows: Windows, number: int, predicted: Mapping[str, FloatArray]) -> dict[str, Any]:
    """Returns path, states and actions of one window, with half a horizon of measurements before it.

    ``predicted`` maps a line style to the states (steps + 1, states) of one predictor over the window.
    """
    start, end = int(windows.start[number]), int(windows.end[number])
    past = int(np.searchsorted(windows.clock, windows.clock[start] - 0.5 * windows.horizon))
    first = max(past, int(windows.begin[number]))
    shown = _thinned(np.arange(first, end + 1))
    ahead = _thinned(np.arange(start, end + 1))
    lines = {"measured": (shown, windows.states[shown])}
    lines |= {name: (ahead, states[ahead - start]) for name, states in predicted.items()}
    time = windows.clock - windows.clock[start]
    system = windows.system
    flat = all(name in system.state_names for name in POSITION)
    states = [(i, v) for i, v in enumerate(system.state) if not (flat and v.name in POSITION)]
    panels, extents = _layout(len(states) + len(system.action), flat)
    if flat:
        x, y = (system.state_names.index(name) for name in POSITION)
        at = panels.add_at("path", "x [m]", "y [m]", (0.0, 0.36), (0.0, 1.0))
        for name, (_, values) in lines.items():
            panels.draw(at, values[:, x], values[:, y], **_style(name), showlegend=True)
        panels.axis(at, "y", scaleanchor="x")
    for (index, variable), (across, up) in zip(states, extents, strict=False):
        at = panels.add_at(variable.name, "time from start [s]", label(variable), across, up)
        for name, (rows, values) in lines.items():
            turns = 2.0 * np.pi * np.round(windows.states[start, index] / (2.0 * np.pi)) if variable.angle else 0.0
            panels.draw(at, time[rows], values[:, index] - turns, **_style(name), showlegend=at == 1)
    usual = 0.2 * np.ptp(np.quantile(windows.actions, [0.01, 0.99], axis=0), axis=0)
    for index, (variable, (across, up)) in enumerate(zip(system.action, extents[len(states) :], strict=True)):
        at = panels.add_at(variable.name, "time from start [s]", label(variable), across, up)
        line = {"color": COLOURS["measured"], "width": 1.5, "shape": "hv"}
        panels.draw(at, time[shown], windows.actions[shown, index], mode="lines", line=line)
        panels.axis(at, "y", range=_axis_range(windows.actions[shown, index], usual[index]))
    return panels.figure("overlay", legend=LEGEND, margin={"l": 62, "r": 14, "t": 70, "b": 52})


def _layout(count: int, flat: bool) -> tuple[Panels, list[tuple[tuple[float, float], tuple[float, float]]]]:
    """Returns the extents of ``count`` panels in two columns, to the right of the path if there is one."""
    left = 0.44 if flat else 0.0
    width = (1.0 - left - 0.08) / 2
    rows = -(-count // 2)
    tall = (1.0 - 0.2 * (rows - 1)) / rows
    extents = []
    for number in range(count):
        row, column = divmod(number, 2)
        across = left + column * (width + 0.08)
        top = 1.0 - row * (tall + 0.2)
        extents.append(((across, across + width), (max(top - tall, 0.0), top)))
    return Panels(rows=rows, columns=1, height=210), extents


def _axis_range(values: FloatArray, least: float) -> list[float]:
    """Returns an axis range of at least width ``least``, so that rounding of a command does not look like a jump."""
    middle, width = 0.5 * (values.min() + values.max()), max(1.1 * float(np.ptp(values)), least)
    half = 0.5 * width or 1.0
    return [float(middle - half), float(middle + half)]


def _style(name: str) -> dict[str, Any]:
    width, dash = STYLES[name]
    line = {"color": COLOURS[name], "width": width, "dash": dash}
    return {"mode": "lines", "name": name.replace("_", " "), "line": line}


def _thinned(rows: IndexArray) -> IndexArray:
    if len(rows) <= MOST_ROWS:
        return rows
    return rows[np.unique(np.linspace(0, len(rows) - 1, MOST_ROWS).astype(np.int64))]
