"""The second column: the error map over two variables, and the error along time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from nicegui import events, ui

from safedpa.arrays import FloatArray
from safedpa.comparison.comparison import Comparison
from safedpa_services.workbench.panels.elements import button, escaped, panel, set_accessible_name, text
from safedpa_services.workbench.panels.theme import (
    MAP_COLOURS,
    ColourTheme,
    axis,
    curve,
    figure,
    json_numbers,
    markers,
    vertical_line,
)
from safedpa_services.workbench.session.selection import (
    ERROR,
    TIME,
    Selection,
    variable_units,
    window_times,
    window_values,
)
from safedpa_services.workbench.session.session import Session

_EMIT_BOX = """(e) => { if (e && e.range) setTimeout(() => {
  document.querySelectorAll(".js-plotly-plot").forEach((plot) => {
    const kept = plot._fullLayout?._preGUI ?? {};
    Object.keys(kept).filter((key) => key.startsWith("selections")).forEach((key) => delete kept[key]);
  });
  emit(e.range);
}) }"""
"""Sends the selected box, and deletes Plotly's own copy of it: the page draws the box itself."""

_EMIT_POINT = "(e) => { if (e && e.points && e.points.length) emit({x: e.points[0].x, y: e.points[0].y}) }"


class ErrorMapPanel:
    """Shows the error map and the error along time; a box drawn in either selects windows in both."""

    def __init__(
        self,
        on_axes: Callable[[str, str], None],
        on_select: Callable[[Selection | None], None],
        on_time: Callable[[float], None],
        on_cell: Callable[[float, float], None],
    ) -> None:
        self._on_axes, self._on_select = on_axes, on_select
        self._session: Session | None = None
        with panel(2, "Where the model fails"):
            with ui.element("div").classes("row tight"):
                self._x = self._axis_select("across", "→")
                self._y = self._axis_select("up", "↑")
                button("Worst", self.worst, "m", hint="select the cell of the map with the largest error")
                button("Clear", lambda: on_select(None), "c", hint="clear the selection")
            self._map = ui.plotly({"data": []}).classes("grow")
            self._map.props('role=img aria-label="Error map over two variables; drag a box to select"')
            self._map.on("plotly_selected", self._on_map_box, js_handler=_EMIT_BOX)
            self._map.on(
                "plotly_click", lambda e: on_cell(float(e.args["x"]), float(e.args["y"])), js_handler=_EMIT_POINT
            )
            self._message = text("", "quiet").props("aria-live=polite")
            self._time = ui.plotly({"data": []}).classes("still").style("height: 178px")
            self._time.props('role=img aria-label="Error along time; drag a box to select"')
            self._time.on("plotly_selected", self._on_time_box, js_handler=_EMIT_BOX)
            self._time.on("plotly_click", lambda e: on_time(float(e.args["x"])), js_handler=_EMIT_POINT)

    def _axis_select(self, title: str, sign: str) -> ui.select:
        text(sign, "quiet").props("aria-hidden=true")
        box = ui.select([], on_change=self._on_axis_chosen).props("dense outlined options-dense")
        return set_accessible_name(box.classes("axis-choice flat"), f"variable {title}")

    def _on_axis_chosen(self) -> None:
        if self._session is not None and self._x.value and self._y.value:
            self._on_axes(self._x.value, self._y.value)

    def worst(self) -> None:
        """Selects the cell with the largest error."""
        if self._session is not None:
            self._on_select(self._session.map().worst)

    def _on_map_box(self, event: events.GenericEventArguments) -> None:
        if self._session is not None:
            self._select(selection_from_map_box(self._session, _ranges(event.args)))

    def _on_time_box(self, event: events.GenericEventArguments) -> None:
        self._select(selection_from_time_box(_ranges(event.args)))

    def _select(self, selection: Selection | None) -> None:
        if selection is not None:
            self._on_select(selection)

    def show(self, session: Session, theme: ColourTheme) -> None:
        """Redraws the panel."""
        self._session = None  # set_options below fires on_change, which must be ignored
        options = {name: name.replace("_", " ") for name in variable_units(session.comparison.windows)}
        self._x.set_options(options, value=session.axes[0])
        self._y.set_options(options, value=session.axes[1])
        self._session = session
        self._map.update_figure(map_figure(session, theme))
        summary = session.selection_summary
        hint = "Drag a box in either figure to select windows. Click a cell to select it, or the line to start there."
        self._message.set_content(escaped(hint if summary is None else summary.sentence))
        self.show_time(session, theme)

    def show_time(self, session: Session, theme: ColourTheme) -> None:
        """Redraws the error along time, with a mark at the chosen start."""
        self._time.update_figure(time_figure(session, theme))


def _ranges(entry: Any) -> dict[str, Any]:
    return entry if isinstance(entry, dict) else {}


_MAX_DOTS = 900
"""Windows that are drawn as dots in the map."""


def map_figure(session: Session, theme: ColourTheme) -> dict[str, Any]:
    """Figure of the error map with a dot for each window; selected windows are highlighted."""
    error_map, windows = session.map(), session.comparison.windows
    units = variable_units(windows)
    heat = {
        "type": "heatmap",
        "x": json_numbers(error_map.x_edges),
        "y": json_numbers(error_map.y_edges),
        "z": [json_numbers(row) for row in error_map.errors],
        "zmin": 0.0,
        "zmax": _colour_axis_top(session),
        "colorscale": MAP_COLOURS,
        "customdata": error_map.windows.tolist(),
        "hovertemplate": "error %{z:.2f}<br>%{customdata} windows<extra></extra>",
        "xgap": 1,
        "ygap": 1,
        "colorbar": {"thickness": 10, "len": 1.0, "outlinewidth": 0, "title": {"text": "error", "side": "right"}},
    }
    plain = {"showgrid": False, "zeroline": False}
    return figure(
        theme,
        [heat, _dots(session, error_map.x, error_map.y, theme)],
        dragmode="select",
        selections=[],
        xaxis=axis(theme, _axis_title(error_map.x, units), **plain, range=_axis_range(error_map.x_edges)),
        yaxis=axis(theme, _axis_title(error_map.y, units), **plain, range=_axis_range(error_map.y_edges)),
        shapes=_box(session.selection, error_map.x, error_map.y, theme),
        margin={"l": 50, "r": 4, "t": 6, "b": 38},
    )


def _dots(session: Session, x: str, y: str, theme: ColourTheme) -> dict[str, Any]:
    windows, mask = session.comparison.windows, session.mask
    shown = np.arange(len(windows)) if mask is None else np.flatnonzero(mask)
    shown = shown[np.linspace(0, len(shown) - 1, min(_MAX_DOTS, len(shown))).astype(np.int64)] if len(shown) else shown
    selected = mask is not None
    marker: dict[str, Any] = {"size": 3, "color": "#ffffff", "opacity": 0.35}
    if selected:
        marker = {"size": 5, "color": theme.selected, "line": {"width": 1, "color": "#ffffff"}, "opacity": 0.9}
    x_values, y_values = (json_numbers(window_values(windows, name)[shown]) for name in (x, y))
    same = {"marker": {"opacity": marker["opacity"]}}
    return markers(x_values, y_values, marker, hoverinfo="skip", selected=same, unselected=same)


def time_figure(session: Session, theme: ColourTheme) -> dict[str, Any]:
    """Figure of the error of every window along the concatenated runs; the given model is drawn behind."""
    comparison, given = session.comparison, session.versions[0].comparison
    t, errors = window_times(comparison.windows), comparison.window_errors
    highest = _time_axis_top(session)
    data = []
    if comparison is not given:
        data.append(_line(given, t, highest, theme.given, 1.0, "given model"))
    data.append(_line(comparison, t, highest, theme.present, 1.4, session.shown_version.label))
    mask = session.mask
    if mask is not None and mask.any():
        x, y = json_numbers(t[mask]), json_numbers(np.minimum(errors[mask], highest))
        data.append(markers(x, y, {"size": 4, "color": theme.selected}, hoverinfo="skip"))
    return figure(
        theme,
        data,
        dragmode="select",
        selections=[],
        selectdirection="h",
        xaxis=axis(theme, "time, runs one after another [s]", showgrid=False, range=[float(t[0]), float(t[-1])]),
        yaxis=axis(theme, "error", range=[0.0, highest], nticks=4),
        shapes=[*_run_borders(comparison, t, theme), vertical_line(float(t[session.start]), theme.text)],
        margin={"l": 50, "r": 8, "t": 6, "b": 38},
    )


def _line(
    comparison: Comparison, t: FloatArray, highest: float, colour: str, width: float, name: str
) -> dict[str, Any]:
    """A line with gaps between stretches."""
    windows, errors = comparison.windows, np.minimum(comparison.window_errors, highest)
    breaks = np.flatnonzero((np.diff(windows.begin) != 0) | (np.diff(windows.run) != 0)) + 1
    x, y = (json_numbers(np.insert(values, breaks, np.nan)) for values in (t, errors))
    names = np.insert(np.array([windows.names[run] for run in windows.run], dtype=object), breaks, "")
    opacity, hover = 1.0 if width > 1.0 else 0.55, f"{name}<br>%{{customdata}}<br>error %{{y:.2f}}"
    return curve(x, y, colour, width, hover, opacity=opacity, customdata=names.tolist())


def selection_from_map_box(session: Session, ranges: dict[str, Any]) -> Selection | None:
    """Selection of a box in the map, from the x and y ranges of its event; None for an invalid event."""
    x, y = _pair(ranges.get("x")), _pair(ranges.get("y"))
    if x is None or y is None:
        return None
    across, up = session.axes
    return Selection({across: x} if across == up else {across: x, up: y})


def selection_from_time_box(ranges: dict[str, Any]) -> Selection | None:
    """Selection of a box along time; None for an invalid event."""
    x, y = _pair(ranges.get("x")), _pair(ranges.get("y"))
    if x is None:
        return None
    return Selection({TIME: x} if y is None else {TIME: x, ERROR: (y[0], float("inf"))})


def window_near(session: Session, t: float) -> int:
    """Index of the window whose start is nearest to ``t`` on the concatenated time axis."""
    return int(np.argmin(np.abs(window_times(session.comparison.windows) - t)))


def _pair(entry: Any) -> tuple[float, float] | None:
    if not isinstance(entry, list | tuple) or len(entry) != 2:
        return None
    if not all(isinstance(number, int | float) and np.isfinite(number) for number in entry):
        return None
    return (float(min(entry)), float(max(entry)))


def _colour_axis_top(session: Session) -> float:
    """End of the colour scale: that of the first fitted version, so that colours stay comparable after an addition."""
    finite = session.first_map().errors
    finite = finite[np.isfinite(finite)]
    return float(np.quantile(finite, 0.98)) if len(finite) else 1.0


def _time_axis_top(session: Session) -> float:
    errors = session.versions[0].comparison.window_errors
    finite = errors[np.isfinite(errors)]
    return max(1e-6, 1.15 * float(np.quantile(finite, 0.99))) if len(finite) else 1.0


def _box(selection: Selection | None, x: str, y: str, theme: ColourTheme) -> list[dict[str, Any]]:
    if selection is None or not {x, y} <= set(selection.ranges):
        return []
    (x0, x1), (y0, y1) = selection.ranges[x], selection.ranges[y]
    line = {"color": theme.selected, "width": 2}
    return [{"type": "rect", "x0": x0, "x1": x1, "y0": y0, "y1": y1, "line": line}]


def _run_borders(comparison: Comparison, t: FloatArray, theme: ColourTheme) -> list[dict[str, Any]]:
    edges = np.flatnonzero(np.diff(comparison.windows.run)) + 1
    return [vertical_line(float(t[edge]), theme.dim, dash="dot") for edge in edges]


def _axis_range(edges: FloatArray) -> list[float]:
    return [float(edges[0]), float(edges[-1])]


def _axis_title(name: str, units: dict[str, str]) -> str:
    return name.replace("_", " ") + ("" if units[name] == "1" else f" [{units[name]}]")
