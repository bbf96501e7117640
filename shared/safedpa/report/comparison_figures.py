"""The figures of a comparison page, as dictionaries for plotly.js."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from safedpa.comparison.comparison import Comparison
from safedpa.comparison.where import POSITION, Bin
from safedpa.report.panels import Panels, label, rounded

COLOURS = {
    "measured": "#222222",
    "model": "#0072B2",
    "no_change": "#E69F00",
    "constant_velocity": "#009E73",
    "before": "#D55E00",
    "after": "#0072B2",
    "before_bar": "#F0C4A4",
    "after_bar": "#0072B2",
    "worst": "#0072B2",
    "bar": "#B8C4CE",
    "dot": "#8A96A3",
}
"""The palette of Okabe and Ito, which readers with colour blindness can distinguish; greys for the rest."""

LINES = {
    "model": ("model", "solid", 2.5),
    "no_change": ("no change", "dash", 1.5),
    "constant_velocity": ("constant velocity", "dot", 2),
}
"""Name, dash and width of the line of each predictor."""

LEGEND = {"orientation": "h", "x": 1, "xanchor": "right", "y": 1.1, "yanchor": "bottom"}

MOST_RUNS = 12
"""Runs whose error is drawn over time at most."""

POINTS = 600
"""Points of one scatter plot at most: a page with every window would be slow and no clearer."""


def horizon_figure(comparison: Comparison) -> dict[str, Any]:
    """Returns the trimmed RMS error over the horizon: one panel per state, with the naive predictors."""
    states = comparison.windows.system.state
    panels = Panels(rows=1, columns=len(states), height=300)
    seconds = [item.seconds for item in comparison.horizons]
    for index, state in enumerate(states):
        at = panels.add(state.name, "horizon [s]", f"error [{state.unit}]")
        for name, (title, dash, width) in LINES.items():
            errors = [item.errors[name] for item in comparison.horizons]
            values = [0.0, *(error.per_state[index] * error.scale[index] for error in errors)]
            line = {"color": COLOURS[name], "dash": dash, "width": width}
            panels.draw(at, [0.0, *seconds], values, mode="lines", name=title, line=line, showlegend=index == 0)
        panels.axis(at, "y", rangemode="tozero")
    return panels.figure("horizon", legend=LEGEND, margin={"l": 62, "r": 14, "t": 70, "b": 52})


def where_figure(comparison: Comparison) -> dict[str, Any]:
    """Returns the error in bins of every variable but time, sorted by what they explain; the line is the average."""
    factors = [item for item in comparison.factors if item.kind != "time"]
    panels = Panels(rows=-(-len(factors) // 3), columns=min(3, len(factors)), height=250)
    for factor in factors:
        at = panels.add(f"{factor.variable} (explains {100 * max(factor.explained, 0):.0f} %)", label(factor), "error")
        _bars(panels, at, factor.bins, comparison.error.value)
        panels.axis(at, "y", range=_bar_range(comparison))
    return panels.figure("where", bargap=0)


def time_figure(comparison: Comparison) -> dict[str, Any]:
    """Returns the error over the time of each run, for at most twelve runs with the largest errors."""
    factor = next(item for item in comparison.factors if item.kind == "time")
    worst = sorted((run for run in comparison.runs if run.windows), key=lambda run: -run.error)[:MOST_RUNS]
    runs = [run.name for run in comparison.runs if run in worst]
    panels = Panels(rows=-(-len(runs) // 2), columns=min(2, len(runs)), height=210)
    for name in runs:
        at = panels.add(name, "time [s]", "error")
        _bars(panels, at, [item for item in factor.bins if item.run == name], comparison.error.value)
        panels.axis(at, "y", range=_bar_range(comparison))
    return panels.figure("time", bargap=0)


def position_figure(comparison: Comparison) -> dict[str, Any] | None:
    """Returns the error over the position in the plane; None for a robot without a position."""
    if not comparison.cells:
        return None
    cells = comparison.cells
    width = cells[0].x_high - cells[0].x_low
    left, low = min(cell.x_low for cell in cells), min(cell.y_low for cell in cells)
    top, right = max(cell.y_high for cell in cells), max(cell.x_high for cell in cells)
    shape = round((top - low) / width), round((right - left) / width)
    errors, counts = np.full(shape, np.nan), np.zeros(shape)
    for cell in cells:
        at = round((cell.y_low - low) / width), round((cell.x_low - left) / width)
        errors[at], counts[at] = cell.error, cell.samples
    panels = Panels(rows=1, columns=1, height=520)
    at_panel = panels.add("", "x [m]", "y [m]")
    x, y = (rounded(begin + width * (np.arange(n) + 0.5)) for begin, n in ((left, shape[1]), (low, shape[0])))
    text = [[f"{int(count)} windows" for count in row] for row in counts]
    panels.heat(at_panel, x, y, [rounded(row) for row in errors], text, "error")
    panels.axis(at_panel, "y", scaleanchor="x", constrain="domain")
    panels.axis(at_panel, "x", constrain="domain")
    return panels.figure("place")


def residual_figure(comparison: Comparison) -> dict[str, Any]:
    """Returns residual rates over states and actions, one row per state; the line is the median by tenths of points."""
    system, found = comparison.windows.system, comparison.residuals
    shown = [(index, v) for index, v in enumerate((*system.state, *system.action)) if v.name not in POSITION]
    panels = Panels(rows=len(system.state), columns=len(shown), height=225)
    keep = np.linspace(0, len(found.rates) - 1, min(POINTS, len(found.rates))).astype(np.int64)
    for row, state in enumerate(system.state):
        rates = found.rates[:, row]
        low, high = _span(rates)
        for index, variable in shown:
            values = found.values[:, index]
            if variable.angle:
                values = (values + np.pi) % (2 * np.pi) - np.pi
            unit = f"{state.unit}/s".replace("/s/s", "/s²")
            at = panels.add("", label(variable), f"{state.name} residual [{unit}]")
            inside = keep[(rates[keep] >= low) & (rates[keep] <= high)]
            marker = {"color": COLOURS["dot"], "size": 3, "opacity": 0.5}
            panels.draw(at, values[inside], rates[inside], mode="markers", marker=marker, hoverinfo="skip")
            x, y = _medians(values, rates)
            line = {"color": COLOURS["model"], "width": 2.5}
            panels.draw(at, x, y, mode="lines+markers", line=line, marker={"size": 5})
            panels.axis(at, "y", range=[low, high], zeroline=True, zerolinecolor="#888")
            panels.axis(at, "x", range=_span(values))
    return panels.figure("residuals")


def _bars(panels: Panels, at: int, bins: Sequence[Bin], average: float) -> None:
    worst = max((item.error for item in bins), default=0.0)
    texts = [
        f"{item.low:.3g} to {item.high:.3g}<br>error {item.error:.3f}, {item.ratio:.2f} x average<br>"
        f"{item.share:.1%} of the squared error<br>{item.samples} windows"
        for item in bins
    ]
    bin_bars(panels, at, bins, [COLOURS["worst" if item.error == worst else "bar"] for item in bins], texts)
    panels.level(at, average)


def bin_bars(panels: Panels, at: int, bins: Sequence[Bin], colours: list[str], texts: list[str]) -> None:
    """Draws the error of each bin as a bar over its range."""
    middles, widths = [0.5 * (item.low + item.high) for item in bins], [item.high - item.low for item in bins]
    panels.bars(at, middles, [item.error for item in bins], widths, colours, texts)


def _bar_range(comparison: Comparison) -> list[float | None]:
    """Returns one range for all bars, so that panels can be compared."""
    errors = [item.error for factor in comparison.factors for item in factor.bins]
    return [0.0, *rounded([1.08 * max((error for error in errors if math.isfinite(error)), default=1.0)])]


def _span(values: Any) -> tuple[float, float]:
    finite = values[np.isfinite(values)]
    low, high = np.quantile(finite, [0.01, 0.99]) if len(finite) else (-1.0, 1.0)
    margin = 0.1 * max(high - low, 1e-9)
    return float(low - margin), float(high + margin)


def _medians(values: Any, rates: Any, groups: int = 10) -> tuple[Any, Any]:
    values, rates = values[np.isfinite(rates)], rates[np.isfinite(rates)]
    order = np.argsort(values, kind="stable")
    parts = [part for part in np.array_split(order, groups) if len(part)]
    x, y = (np.array([np.median(column[part]) for part in parts]) for column in (values, rates))
    return x, y
