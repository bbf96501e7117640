"""The first column: measured and predicted path and states, from a chosen start."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from nicegui import ui

from safedpa.arrays import FloatArray
from safedpa.comparison.rollout import rollout
from safedpa.comparison.summary import shortened
from safedpa.comparison.where import POSITION
from safedpa_services.workbench.panels.elements import button, escaped, panel, set_accessible_name, text
from safedpa_services.workbench.panels.theme import ColourTheme, axis, curve, figure, json_numbers, markers
from safedpa_services.workbench.session.session import Session


class PredictionPanel:
    """Shows path and states from a chosen start, measured and predicted."""

    def __init__(self, on_start: Callable[[int], None], on_worst: Callable[[], None]) -> None:
        self._on_start = on_start
        with panel(1, "The robot and its prediction"):
            self._caption = text("", "quiet one-line")
            self._legend = ui.html(sanitize=False).classes("legend")
            self._path = ui.plotly({"data": []}).classes("grow")
            self._path.props('role=img aria-label="Path, measured and predicted"')
            self._curves = ui.plotly({"data": []}).classes("grow").props('role=img aria-label="States along time"')
            with ui.element("div").classes("row tight"):
                button("◀", lambda: self._move(-1), "←", hint="previous start")
                slider = ui.slider(min=0, max=1, value=0).props("dense")
                self._slider = set_accessible_name(slider, "start of the prediction")
                slider.on("update:model-value", lambda event: on_start(int(event.args)), throttle=0.12)
                button("▶", lambda: self._move(1), "→", hint="next start")
                button("Worst", on_worst, "w", hint="start with the largest error in the selection")

    def _move(self, by: int) -> None:
        self._on_start(int(self._slider.value) + by)

    def show(self, session: Session, theme: ColourTheme) -> None:
        """Redraws the panel."""
        excerpt = excerpt_at_start(session)
        notice = f"{session.horizon:g} s ahead from {excerpt.start_time:.2f} s of {shortened(excerpt.run, 22)}"
        self._caption.set_content(escaped(notice))
        self._caption.props(f'title="{escaped(excerpt.run)}"')
        self._legend.set_content(_legend(session, theme))
        self._slider.props(f"max={len(session.comparison.windows) - 1}")
        self._slider.value = session.start
        path = path_figure(session, excerpt, theme)
        self._path.set_visibility(path is not None)
        if path is not None:
            self._path.update_figure(path)
        self._curves.update_figure(curves_figure(session, excerpt, theme))


def _legend(session: Session, theme: ColourTheme) -> str:
    lines = [("measured", theme.measured, "solid"), ("model", theme.present, "solid")]
    if session.number:
        lines.append(("given model", theme.given, "dashed"))
    if session.number > 1:
        lines.append(("between", theme.between, "dotted"))
    return "".join(
        f'<span><i style="border-color:{colour};border-top-style:{style}"></i>{name}</span>'
        for name, colour, style in lines
    )


_BEFORE = 0.5
"""Horizons that are drawn before the start,"""
_AFTER = 0.5
"""and after the end of the prediction."""
_MIN_HALF_WIDTH = 0.6
"""m; smallest half width of the shown part of the plane."""


@dataclass(frozen=True)
class Excerpt:
    """Measurements around the chosen start, and the prediction of each version from it."""

    run: str
    start_time: float
    """Start of the prediction, s since the start of the run."""
    t: FloatArray
    """s since ``start_time``, shape (rows,)."""
    measured: FloatArray
    """Measured states, shape (rows, states)."""
    full_path: FloatArray
    """Path of the whole run [m], shape (rows, 2); no rows for a robot without a position in the plane."""
    predicted: list[tuple[str, FloatArray, FloatArray]]
    """For each version: label, s since ``start_time`` (steps + 1,), states (steps + 1, states)."""


def excerpt_at_start(session: Session) -> Excerpt:
    """Returns the excerpt at the start that the session shows."""
    windows = session.comparison.windows
    one = windows.select(np.array([session.start]))
    start, steps, run = int(one.start[0]), int(one.steps[0]), int(one.run[0])
    begin = int(one.begin[0])
    stop = int(windows.bounds[np.searchsorted(windows.bounds[:, 1], start, side="right"), 1])
    seconds = windows.time - windows.time[start]
    horizon = windows.horizon
    rows = np.arange(begin, stop)
    rows = rows[(seconds[rows] >= -_BEFORE * horizon) & (seconds[rows] <= (1.0 + _AFTER) * horizon)]
    ahead = np.arange(start, start + steps + 1)
    predicted = []
    for version in session.versions:
        states = rollout(version.model, version.comparison.windows.select(np.array([session.start])))[:, 0]
        predicted.append((version.label, seconds[ahead], states))
    return Excerpt(
        windows.names[run], float(windows.time[start]), seconds[rows], windows.states[rows], _full_path(session, run),
        predicted,
    )  # fmt: skip


def _full_path(session: Session, run: int) -> FloatArray:
    windows = session.comparison.windows
    names = windows.system.state_names
    if not set(POSITION) <= set(names):
        return np.zeros((0, 2))
    starts = windows.start[windows.run == run]
    place = [names.index(name) for name in POSITION]
    return windows.states[np.ix_(starts, place)]


def path_figure(session: Session, excerpt: Excerpt, theme: ColourTheme) -> dict[str, Any] | None:
    """Figure of the plane: measured and predicted path; None for a robot without a position in the plane."""
    if not len(excerpt.full_path):
        return None
    names = session.comparison.windows.system.state_names
    x, y = (names.index(name) for name in POSITION)
    thin = excerpt.full_path[:: max(1, len(excerpt.full_path) // 800)]
    unnamed: dict[str, Any] = {"hoverinfo": "skip", "hovertemplate": None}
    data = [_trace(thin[:, 0], thin[:, 1], theme.dim, 1.0, "whole run", **unnamed)]
    data.append(_trace(excerpt.measured[:, x], excerpt.measured[:, y], theme.measured, 3.5, "measured"))
    for number, (label, _, states) in enumerate(excerpt.predicted):
        colour, width, dash = _line_style(session, number, theme)
        data.append(_trace(states[:, x], states[:, y], colour, width, label, dash))
    now = excerpt.predicted[0][2][0]
    dot = {"size": 9, "color": theme.measured, "line": {"width": 2, "color": theme.grid}}
    start = "start<extra></extra>"
    data.append(markers([float(now[x])], [float(now[y])], dot, hovertemplate=start))
    near = np.concatenate(
        [excerpt.measured[:, [x, y]], *(states[:, [x, y]] for _, _, states in excerpt.predicted[-1:])]
    )
    near = near[np.isfinite(near).all(axis=1)]
    middle = 0.5 * (near.max(axis=0) + near.min(axis=0))
    half = max(_MIN_HALF_WIDTH, 0.62 * float(np.ptp(near, axis=0).max()))
    near_x, near_y = ([float(centre - half), float(centre + half)] for centre in middle)
    across = axis(theme, "x [m]", range=near_x, constrain="domain")
    up = axis(theme, "y [m]", range=near_y, scaleanchor="x", constrain="domain")
    room = {"l": 66, "r": 8, "t": 6, "b": 38}  # fixed for wide tick labels: automargin oscillates with scaleanchor
    return figure(theme, data, dragmode=False, xaxis=across, yaxis=up, margin=room)


def curves_figure(session: Session, excerpt: Excerpt, theme: ColourTheme) -> dict[str, Any]:
    """Figure with one subplot for each state except the position, along time."""
    states = session.comparison.windows.system.state
    shown = [index for index, state in enumerate(states) if not (len(excerpt.full_path) and state.name in POSITION)]
    data = []
    layout: dict[str, Any] = {"margin": {"l": 56, "r": 8, "t": 6, "b": 36}}
    layout["grid"] = {"rows": len(shown), "columns": 1, "pattern": "independent", "ygap": 0.2}
    for row, index in enumerate(shown):
        suffix = "" if row == 0 else str(row + 1)
        axes = {"xaxis": f"x{suffix}", "yaxis": f"y{suffix}"}
        data.append(_trace(excerpt.t, excerpt.measured[:, index], theme.measured, 3.0, "measured") | axes)
        for number, (label, t, predicted) in enumerate(excerpt.predicted):
            colour, width, dash = _line_style(session, number, theme)
            data.append(_trace(t, predicted[:, index], colour, width, label, dash) | axes)
        last = row == len(shown) - 1
        layout[f"xaxis{suffix}"] = axis(theme, "time from the start [s]" if last else "", showticklabels=last,
                                        range=[float(excerpt.t[0]), float(excerpt.t[-1])])  # fmt: skip
        layout[f"yaxis{suffix}"] = axis(theme, f"{states[index].name} [{states[index].unit}]", nticks=4,
                                        range=_range(excerpt, index))  # fmt: skip
    return figure(theme, data, dragmode=False, **layout)


def _range(excerpt: Excerpt, index: int) -> list[float]:
    """Axis range that covers the measured and all predicted values of a state, with a margin of 6 %."""
    parts = [excerpt.measured[:, index], *(states[:, index] for _, _, states in excerpt.predicted)]
    values = np.concatenate(parts)
    values = values[np.isfinite(values)]
    room = 0.06 * float(np.ptp(values)) + 1e-3
    return [float(values.min() - room), float(values.max() + room)]


def _line_style(session: Session, number: int, theme: ColourTheme) -> tuple[str, float, str]:
    """Colour, width and dash of a version: shown, given or intermediate."""
    shown_version = session.number if session.shown is None else session.shown
    if number == shown_version:
        return theme.present, 2.5, "solid"
    return (theme.given, 2.0, "dash") if number == 0 else (theme.between, 1.2, "dot")


def _trace(
    x: FloatArray, y: FloatArray, colour: str, width: float, name: str, dash: str = "solid", **more: Any
) -> dict[str, Any]:
    hover = f"{name}<br>%{{x:.2f}}, %{{y:.2f}}"
    return curve(json_numbers(x), json_numbers(y), colour, width, hover, dash=dash, name=name, **more)
