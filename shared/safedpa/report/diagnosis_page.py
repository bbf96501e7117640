"""Writes a diagnosis as one offline HTML page: the missing effects, the reasons, and the error before and after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.comparison.comparison import EVERY, Comparison, compare_model
from safedpa.comparison.excerpt import subsample_runs
from safedpa.comparison.where import POSITION, window_squares
from safedpa.dynamics import PhysicsModel
from safedpa.records.run import Run
from safedpa.records.writers.tables import atomic_path
from safedpa.report.comparison_figures import COLOURS, LEGEND, bin_bars, residual_figure
from safedpa.report.comparison_page import embedded, rendered
from safedpa.report.diagnosis_story import closest_rows, detectable_rows, number, report_text, step_text
from safedpa.report.overlays import overlay_figures
from safedpa.report.panels import Panels, label, rounded


def unexplained_figure(unexplained: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Draws the map and the profile of ``unexplained`` of report.json; None if it has neither."""
    if not unexplained or not (unexplained.get("map") or unexplained.get("profile")):
        return None
    both = bool(unexplained.get("map")) and bool(unexplained.get("profile"))
    panels = Panels(rows=1, columns=2 if both else 1, height=400)
    if unexplained.get("map"):
        _map(panels, unexplained["map"])
    if unexplained.get("profile"):
        _profile(panels, unexplained["profile"])
    return panels.figure("unexplained", legend=LEGEND, margin={"l": 62, "r": 24, "t": 76, "b": 52})


def _map(panels: Panels, table: Mapping[str, Any]) -> None:
    """Draws the map of a missing rate: blue below zero, orange above, white at zero, because the sign matters most."""
    middles = [_middles(table[f"{side}_edges"]) for side in ("across", "up")]
    means = np.array([[np.nan if value is None else value for value in row] for row in table["means"]], dtype=float)
    most = float(np.nanmax(np.abs(means), initial=0.0)) or 1.0
    title = f"d({table['state']})/dt over {table['across']} and {table['up']}"
    x_title, y_title = (f"{table[side]} [{table[f'{side}_unit']}]" for side in ("across", "up"))
    at = panels.add_at(title, x_title, y_title, (0.0, 0.40 if panels.columns == 2 else 0.85), (0.0, 1.0))
    text = [[f"{count} windows" for count in row] for row in table["windows"]]
    z = [rounded(row) for row in means]
    panels.heat(at, rounded(middles[0]), rounded(middles[1]), z, text, table["rate_unit"])
    hover = f"{table['across']} %{{x:.3g}}, {table['up']} %{{y:.3g}}<br>%{{z:.3g}} {table['rate_unit']}<br>%{{text}}"
    scale = [[0.0, "#0072B2"], [0.5, "#F7F7F7"], [1.0, "#D55E00"]]
    bar = {"title": {"text": table["rate_unit"], "side": "top"}, "thickness": 14, "outlinewidth": 0}
    bar |= {"x": 0.41, "len": 0.9} if panels.columns == 2 else {}
    hover += "<extra></extra>"
    panels.data[-1].update(zmin=-most, zmax=most, colorscale=scale, colorbar=bar, hovertemplate=hover)
    if (table["across"], table["up"]) == POSITION:
        panels.axis(at, "y", scaleanchor="x", constrain="domain")
        panels.axis(at, "x", constrain="domain")


def _profile(panels: Panels, table: Mapping[str, Any]) -> None:
    x_title, y_title = f"{table['variable']} [{table['unit']}]", f"d({table['state']})/dt [{table['rate_unit']}]"
    left = 0.58 if panels.columns == 2 else 0.0
    at = panels.add_at(f"to first order, over {table['variable']}", x_title, y_title, (left, 1.0), (0.0, 1.0))
    x = [float(value) for value in table["knots"]]
    bars = {"type": "data", "array": rounded(table["errors"]), "color": COLOURS["measured"], "thickness": 1.2}
    panels.draw(
        at, x, table["values"], mode="lines+markers", name="fitted function with one standard deviation",
        error_y=bars, showlegend=True, marker={"size": 7}, line={"color": COLOURS["measured"], "width": 1},
    )  # fmt: skip
    if table.get("formula"):
        line = {"color": COLOURS["after"], "width": 3}
        panels.draw(at, x, table["formula"], mode="lines", name="the formula", showlegend=True, line=line)


def _middles(edges: Any) -> list[float]:
    return [0.5 * (low + high) for low, high in pairwise(edges)]


# Figures of longer recordings show an excerpt; the tables of stages and candidates use all rows.
_MAX_ROWS = 200_000
# More windows would make the page slower and no clearer.
_MAX_WINDOWS = 6000
# Candidates of a stage that are shown before the others are unfolded.
_SHOWN = 6


def write_report(
    document: Mapping[str, Any], runs: Sequence[Run], models: Sequence[PhysicsModel], folder: Path, title: str
) -> Path:
    """Writes ``report.html`` into an existing folder and returns its path.

    ``document`` is the content of report.json; ``models`` are those of its stages, the given one first. The file is
    written completely or not at all. Raises RecordingError if it cannot be written.
    """
    path = folder / "report.html"
    with atomic_path(path) as temporary:
        temporary.write_text(report_page(document, runs, models, title), encoding="utf-8")
    return path


def report_page(
    document: Mapping[str, Any], runs: Sequence[Run], models: Sequence[PhysicsModel], title: str, horizon: float = 1.0
) -> str:
    """Returns the page: figures, tables and plotly.js in one file that loads nothing from other hosts."""
    horizon = float(document.get("horizon", horizon))
    seconds = sum(run.duration for run in runs)
    shown = subsample_runs(runs, _MAX_ROWS, horizon)
    every = max(EVERY, sum(run.duration for run in shown) / _MAX_WINDOWS)
    before = compare_model(models[0], shown, horizon, every=every)
    after = before if len(models) == 1 else compare_model(models[-1], shown, horizon, every=every)
    figures = [falling_figure(document), before_after_figure(before, after), residual_figure(after)]
    maps = map_figure(before, after)
    figures += [] if maps is None else [maps]
    unexplained_panels = unexplained_figure(document["unexplained"])
    figures += [] if unexplained_panels is None else [unexplained_panels]
    overlays = overlay_figures(before, after)
    return rendered(
        "diagnosis_page.html",
        title=title,
        document=document,
        story=report_text(document),
        before=before,
        after=after,
        closest=closest_rows(document),
        detectable=detectable_rows(document),
        worse=document.get("worse", ()),
        tiles=_tiles(document, before, seconds, len(runs)),
        has_maps=maps is not None,
        has_rest=unexplained_panels is not None,
        share=sum(run.duration for run in shown) / seconds,
        shown=_SHOWN,
        overlay_labels=[figure["label"] for figure in overlays],
        data=embedded({"figures": figures, "overlays": overlays}),
    )


def _tiles(document: Mapping[str, Any], before: Comparison, seconds: float, runs: int) -> list[tuple[str, str]]:
    stages = document["stages"]
    first, last = number(stages[0]["heldout_error"]), number(stages[-1]["heldout_error"])
    tiles = [(f"{first:.3g}", "held-out error of the given model")]
    if len(stages) > 1:
        tiles.append((f"{last:.3g}", "held-out error with the effects found"))
        tiles.append((f"{100 * (last / first - 1):+.0f} %".replace("-", "−"), "change of the error"))
        tiles.append((str(stages[-1]["runs_improved"]), "runs improved"))
    tiles.append((f"{before.horizon:g} s", "horizon of the predictions"))
    tiles.append((f"{seconds:.0f} s", f"measured in {runs} run{'s' if runs > 1 else ''}"))
    return tiles


# Cells along each side of a map of the error.
_CELLS = 14
# Windows in a cell that is shown: fewer are mostly noise.
_MIN_WINDOWS = 3
# Maps in a row: more would be too small to read.
_MAPS = 3
# Share of the variation that a heading has to explain for a map over it.
_MIN_EXPLAINED = 0.05
# Correlation above which two variables span a line instead of a plane.
_CORRELATED = 0.8


def falling_figure(document: Mapping[str, Any]) -> dict[str, Any]:
    """Returns bars of the held-out error, one per stage: first the mean, then each state."""
    stages = document["stages"]
    states = list(stages[0]["per_state"])
    panels = Panels(rows=1, columns=1, height=330)
    width = 0.55 / max(len(states), 1)
    at = panels.add_at("mean over the states", "", "held-out error", (0.0, 0.36), (0.0, 1.0))
    _stage_bars(panels, at, [number(stage["heldout_error"]) for stage in stages], stages)
    for index, state in enumerate(states):
        left = 0.43 + index * (width + 0.025)
        at = panels.add_at(state, "", "", (left, min(left + width - 0.02, 1.0)), (0.0, 1.0))
        _stage_bars(panels, at, [number(stage["per_state"][state]) for stage in stages], stages, short=True)
    return panels.figure("falling", bargap=0, margin={"l": 62, "r": 14, "t": 40, "b": 52 if len(stages) < 4 else 90})


def _stage_bars(panels: Panels, at: int, errors: list[float], stages: Any, *, short: bool = False) -> None:
    positions = [float(index) for index in range(len(errors))]
    colours = [COLOURS["before"], *[COLOURS["after"]] * (len(errors) - 1)]
    names = [step_text(before, stage) for before, stage in zip([None, *stages], stages, strict=False)]
    texts = [f"{name}<br>error {error:.3g}" for name, error in zip(names, errors, strict=True)]
    panels.bars(at, positions, errors, [0.72] * len(errors), colours, texts)
    short_names = [str(i) for i in range(len(positions))]
    panels.axis(at, "x", tickvals=positions, ticktext=short_names if short else names)
    angle = 0 if short or len(positions) < 4 else -25
    panels.axis(at, "x", tickangle=angle, range=[-0.6, max(len(errors) - 0.4, 1.6)])
    panels.axis(at, "y", range=[0.0, 1.18 * max([1e-12, *(error for error in errors if np.isfinite(error))])])
    if short:
        positions, errors = [positions[0], *positions[1:][-1:]], [errors[0], *errors[1:][-1:]]
        panels.axis(at, "x", title={"text": "additions", "font": {"size": 12}})
    for position, error in zip(positions, errors, strict=True):
        fall = f"<br>{_change(error, errors[0])}" if position and not short else ""
        panels.draw(
            at, [position], [error], mode="text", text=[f"<b>{error:.3g}</b>{fall}"], textposition="top center",
            hoverinfo="skip", textfont={"size": 11 if short else 13}, cliponaxis=False,
        )  # fmt: skip


def _change(error: float, first: float) -> str:
    return f"{100.0 * (error / first - 1.0):+.0f} %".replace("-", "−") if first > 0 else ""


def before_after_figure(before: Comparison, after: Comparison) -> dict[str, Any]:
    """Returns the error in bins of every variable, the given model's behind and the final model's in front."""
    order = [item.variable for item in before.factors if item.kind != "time"]
    later = {item.variable: item for item in after.factors}
    panels = Panels(rows=-(-len(order) // 3), columns=min(3, len(order)), height=250)
    highest = max(item.error for factor in before.factors if factor.kind != "time" for item in factor.bins)
    highest = max([highest, *(item.error for name in order for item in later[name].bins)])
    for factor in before.factors:
        if factor.kind == "time":
            continue
        at = panels.add(f"{factor.variable} (explains {100 * max(factor.explained, 0):.0f} %)", label(factor), "error")
        for name, bins in (("before", factor.bins), ("after", later[factor.variable].bins)):
            texts = [
                f"{name}: {item.low:.3g} to {item.high:.3g}<br>error {item.error:.3f}<br>{item.samples} windows"
                for item in bins
            ]
            bin_bars(panels, at, bins, [COLOURS[f"{name}_bar"]] * len(bins), texts)
        panels.axis(at, "y", range=[0.0, 1.08 * highest] if np.isfinite(highest) else None)
    return panels.figure("where", bargap=0, barmode="overlay", legend=LEGEND)


def map_figure(before: Comparison, after: Comparison) -> dict[str, Any] | None:
    """Returns maps of the error over pairs of variables and over the plane: the given model above, the final one below.

    The pairs are of the variables on which the given model's error depends most. None if there are no two variables.
    """
    pairs = _pairs(before)
    if not pairs:
        return None
    panels = Panels(rows=2, columns=len(pairs), height=330)
    drawn = []
    for comparison in (before, after):
        for across, up in pairs:
            drawn.append((comparison, across, up, _cell_errors(comparison, across, up)))
    highest = max((float(np.nanmax(item[3][2], initial=0.0)) for item in drawn), default=1.0)
    for index, (comparison, across, up, (x, y, z, counts)) in enumerate(drawn):
        units = _units(comparison)
        when = "before" if index < len(pairs) else "after"
        at = panels.add(when, f"{across} [{units[across]}]", f"{up} [{units[up]}]" if across != "x" else "y [m]")
        text = [[f"{int(count)} windows" for count in row] for row in counts]
        panels.heat(at, rounded(x), rounded(y), [rounded(row) for row in z], text, "error")
        hover = f"{across} %{{x:.3g}}, {up} %{{y:.3g}}<br>error %{{z:.3f}}<br>%{{text}}<extra></extra>"
        panels.data[-1].update(zmin=0.0, zmax=highest, showscale=index == 0, hovertemplate=hover)
        if across == "x":
            panels.axis(at, "y", scaleanchor="x", constrain="domain")
            panels.axis(at, "x", constrain="domain")
    return panels.figure("maps")


def _pairs(comparison: Comparison) -> list[tuple[str, str]]:
    system = comparison.windows.system
    angles = {item.name for item in system.state if item.angle}
    names = [
        item.variable
        for item in comparison.factors
        if item.kind in ("state", "action") and (item.variable not in angles or item.explained > _MIN_EXPLAINED)
    ]
    names = [name for name in names if np.ptp(_values(comparison, name)) > 1e-9]
    pairs = []
    for i, later in enumerate(names):
        for earlier in names[:i]:
            if abs(np.corrcoef(_values(comparison, later), _values(comparison, earlier))[0, 1]) < _CORRELATED:
                swap = earlier in system.action_names and later in system.state_names
                pairs.append((later, earlier) if swap else (earlier, later))
    if set(POSITION) <= set(_units(comparison)):
        return [*pairs[: _MAPS - 1], ("x", "y")]
    return pairs[:_MAPS]


def _units(comparison: Comparison) -> dict[str, str]:
    system = comparison.windows.system
    return {item.name: item.unit for item in (*system.state, *system.action)}


def _values(comparison: Comparison, name: str) -> FloatArray:
    """Returns a state or action at the middle of each window, (windows,)."""
    windows = comparison.windows
    middle, system = windows.start + windows.steps // 2, windows.system
    if name in system.action_names:
        return np.asarray(windows.actions[middle, system.action_names.index(name)])
    index = system.state_names.index(name)
    values = windows.states[middle, index]
    return np.asarray((values + np.pi) % (2 * np.pi) - np.pi if system.state[index].angle else values)


def _cell_errors(comparison: Comparison, across: str, up: str) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Returns cell centres across and up (cells,), then errors and window counts (cells up, cells across)."""
    squares = window_squares(comparison.errors, comparison.error.scale)
    edges, at = [], []
    for name in (across, up):
        values = _values(comparison, name)
        low, high = np.quantile(values, [0.01, 0.99])
        edges.append(np.linspace(low, max(high, low + 1e-9), _CELLS + 1))
        at.append(np.searchsorted(edges[-1], values, side="right") - 1)
    inside = (at[0] >= 0) & (at[0] < _CELLS) & (at[1] >= 0) & (at[1] < _CELLS)
    cell = at[1][inside] * _CELLS + at[0][inside]
    counts = np.bincount(cell, minlength=_CELLS**2).astype(np.float64)
    total = np.bincount(cell, squares[inside], minlength=_CELLS**2)
    errors = np.where(counts >= _MIN_WINDOWS, np.sqrt(total / np.maximum(counts, 1.0)), np.nan)
    middles = [0.5 * (edge[:-1] + edge[1:]) for edge in edges]
    shape = (_CELLS, _CELLS)
    return middles[0], middles[1], errors.reshape(shape), counts.reshape(shape)
