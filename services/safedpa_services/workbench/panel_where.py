"""The second column: where the model fails."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from nicegui import events, ui

from safedpa.arrays import FloatArray
from safedpa.comparison.comparison import Comparison
from safedpa_services.workbench.brush import ERROR, TIME, Brush, time_of, values_of, variables_of
from safedpa_services.workbench.elements import action, escaped, named, panel, text
from safedpa_services.workbench.look import CONFIG, MAP_COLOURS, ColourTheme, axis, frame
from safedpa_services.workbench.session import Session

__all__ = ["WherePanel", "brush_of_map", "brush_of_time", "map_figure", "time_figure", "window_near"]

_RANGE = """(e) => { if (e && e.range) setTimeout(() => {
  document.querySelectorAll(".js-plotly-plot").forEach((plot) => {
    const kept = plot._fullLayout?._preGUI ?? {};
    Object.keys(kept).filter((key) => key.startsWith("selections")).forEach((key) => delete kept[key]);
  });
  emit(e.range);
}) }"""
"""Sends the box, and lets the figure forget it: the page draws its own."""

_POINT = "(e) => { if (e && e.points && e.points.length) emit({x: e.points[0].x, y: e.points[0].y}) }"


class WherePanel:
    """Error map and error along time; a box in either selects in both."""

    def __init__(
        self,
        on_axes: Callable[[str, str], None],
        on_brush: Callable[[Brush | None], None],
        on_moment: Callable[[float], None],
        on_cell: Callable[[float, float], None],
    ) -> None:
        self._on_axes, self._on_brush = on_axes, on_brush
        self._session: Session | None = None
        with panel(2, "Where it fails"):
            with ui.element("div").classes("row tight"):
                self._x = self._choice("across", "→")
                self._y = self._choice("up", "↑")
                action("Worst", self.worst, "m", hint="select the cell of the map with the largest error")
                action("Clear", lambda: on_brush(None), "c", hint="clear the selection")
            self._map = ui.plotly({"data": []}).classes("grow")
            self._map.props('role=img aria-label="Error map over two variables; drag a box to select"')
            self._map.on("plotly_selected", self._boxed_map, js_handler=_RANGE)
            self._map.on("plotly_click", lambda e: on_cell(float(e.args["x"]), float(e.args["y"])), js_handler=_POINT)
            self._message = text("", "quiet").props("aria-live=polite")
            self._time = ui.plotly({"data": []}).classes("still").style("height: 178px")
            self._time.props('role=img aria-label="Error along time; drag a box to select"')
            self._time.on("plotly_selected", self._boxed_time, js_handler=_RANGE)
            self._time.on("plotly_click", lambda e: on_moment(float(e.args["x"])), js_handler=_POINT)

    def _choice(self, title: str, sign: str) -> ui.select:
        text(sign, "quiet").props("aria-hidden=true")
        box = ui.select([], on_change=self._chosen).props("dense outlined options-dense")
        return named(box.classes("axis-choice flat"), f"variable {title}")

    def _chosen(self) -> None:
        if self._session is not None and self._x.value and self._y.value:
            self._on_axes(self._x.value, self._y.value)

    def worst(self) -> None:
        """Selects the worst cell."""
        if self._session is not None:
            self._on_brush(self._session.map().worst)

    def _boxed_map(self, event: events.GenericEventArguments) -> None:
        if self._session is not None:
            self._taken(brush_of_map(self._session, _ranges(event.args)))

    def _boxed_time(self, event: events.GenericEventArguments) -> None:
        self._taken(brush_of_time(_ranges(event.args)))

    def _taken(self, brush: Brush | None) -> None:
        if brush is not None:
            self._on_brush(brush)

    def show(self, session: Session, look: ColourTheme) -> None:
        """Draws everything again."""
        self._session = None  # while the boxes are set, no one chose
        options = {name: name.replace("_", " ") for name in variables_of(session.comparison.windows)}
        self._x.set_options(options, value=session.axes[0])
        self._y.set_options(options, value=session.axes[1])
        self._session = session
        self._map.update_figure(map_figure(session, look))
        inside = session.inside
        hint = "Drag a box in either figure to select; a click on a cell selects it, a click on the line starts there."
        self._message.set_content(escaped(hint if inside is None else inside.sentence))
        self.show_time(session, look)

    def show_time(self, session: Session, look: ColourTheme) -> None:
        """Draws the error along time again, where the chosen start is marked."""
        self._time.update_figure(time_figure(session, look))


def _ranges(entry: Any) -> dict[str, Any]:
    return entry if isinstance(entry, dict) else {}


_DOTS = 900
"""Windows drawn as dots in the map."""


def map_figure(session: Session, look: ColourTheme) -> dict[str, Any]:
    """The error map, with a dot for windows: those that are selected stand out."""
    found, windows = session.map(), session.comparison.windows
    units = variables_of(windows)
    heat = {
        "type": "heatmap",
        "x": _numbers(found.x_edges),
        "y": _numbers(found.y_edges),
        "z": [_numbers(row) for row in found.errors],
        "zmin": 0.0,
        "zmax": _top(session),
        "colorscale": MAP_COLOURS,
        "customdata": found.windows.tolist(),
        "hovertemplate": "error %{z:.2f}<br>%{customdata} windows<extra></extra>",
        "xgap": 1,
        "ygap": 1,
        "colorbar": {"thickness": 10, "len": 1.0, "outlinewidth": 0, "title": {"text": "error", "side": "right"}},
    }
    layout = frame(
        look,
        dragmode="select",
        selections=[],
        xaxis=axis(look, _titled(found.x, units), showgrid=False, zeroline=False, range=_ends(found.x_edges)),
        yaxis=axis(look, _titled(found.y, units), showgrid=False, zeroline=False, range=_ends(found.y_edges)),
        shapes=_box(session.brush, found.x, found.y, look),
        margin={"l": 50, "r": 4, "t": 6, "b": 38},
    )
    return {"data": [heat, _dots(session, found.x, found.y, look)], "layout": layout, "config": CONFIG}


def _dots(session: Session, x: str, y: str, look: ColourTheme) -> dict[str, Any]:
    windows, mask = session.comparison.windows, session.mask
    shown = np.arange(len(windows)) if mask is None else np.flatnonzero(mask)
    shown = shown[np.linspace(0, len(shown) - 1, min(_DOTS, len(shown))).astype(np.int64)] if len(shown) else shown
    selected = mask is not None
    marker: dict[str, Any] = {"size": 3, "color": "#ffffff", "opacity": 0.35}
    if selected:
        marker = {"size": 5, "color": look.selected, "line": {"width": 1, "color": "#ffffff"}, "opacity": 0.9}
    return {
        "type": "scatter",
        "mode": "markers",
        "x": _numbers(values_of(windows, x)[shown]),
        "y": _numbers(values_of(windows, y)[shown]),
        "marker": marker,
        "hoverinfo": "skip",
        "selected": {"marker": {"opacity": marker["opacity"]}},
        "unselected": {"marker": {"opacity": marker["opacity"]}},
    }


def time_figure(session: Session, look: ColourTheme) -> dict[str, Any]:
    """The error of every window along time, runs one after another, the given model's behind the present one's."""
    comparison, given = session.comparison, session.versions[0].comparison
    t, errors = time_of(comparison.windows), comparison.window_errors
    highest = _height(session)
    data = []
    if comparison is not given:
        data.append(_line(given, t, highest, look.given, 1.0, "given model"))
    data.append(_line(comparison, t, highest, look.present, 1.4, session.looked_at.label))
    mask = session.mask
    if mask is not None and mask.any():
        marker = {"size": 4, "color": look.selected}
        data.append(
            {
                "type": "scatter",
                "mode": "markers",
                "x": _numbers(t[mask]),
                "y": _numbers(np.minimum(errors[mask], highest)),
                "marker": marker,
                "hoverinfo": "skip",
            }
        )
    layout = frame(
        look,
        dragmode="select",
        selections=[],
        selectdirection="h",
        xaxis=axis(look, "time, runs one after another [s]", showgrid=False, range=[float(t[0]), float(t[-1])]),
        yaxis=axis(look, "error", range=[0.0, highest], nticks=4),
        shapes=[*_borders(comparison, t, look), _mark(float(t[session.start]), look)],
        margin={"l": 50, "r": 8, "t": 6, "b": 38},
    )
    return {"data": data, "layout": layout, "config": CONFIG}


def _line(
    comparison: Comparison, t: FloatArray, highest: float, colour: str, width: float, name: str
) -> dict[str, Any]:
    """One line, broken between stretches."""
    windows, errors = comparison.windows, np.minimum(comparison.window_errors, highest)
    breaks = np.flatnonzero((np.diff(windows.begin) != 0) | (np.diff(windows.run) != 0)) + 1
    x, y = np.insert(t, breaks, np.nan), np.insert(errors, breaks, np.nan)
    names = np.insert(np.array([windows.names[run] for run in windows.run], dtype=object), breaks, "")
    return {
        "type": "scatter",
        "mode": "lines",
        "x": _numbers(x),
        "y": _numbers(y),
        "line": {"color": colour, "width": width},
        "opacity": 1.0 if width > 1.0 else 0.55,
        "customdata": names.tolist(),
        "hovertemplate": f"{name}<br>%{{customdata}}<br>error %{{y:.2f}}<extra></extra>",
    }


def brush_of_map(session: Session, ranges: dict[str, Any]) -> Brush | None:
    """The brush of a box in the map: the event's ranges of x and y; None for something else."""
    x, y = _pair(ranges.get("x")), _pair(ranges.get("y"))
    if x is None or y is None:
        return None
    across, up = session.axes
    return Brush({across: x} if across == up else {across: x, up: y})


def brush_of_time(ranges: dict[str, Any]) -> Brush | None:
    """The brush of a box along time; None for something else."""
    x, y = _pair(ranges.get("x")), _pair(ranges.get("y"))
    if x is None:
        return None
    return Brush({TIME: x} if y is None else {TIME: x, ERROR: (y[0], float("inf"))})


def window_near(session: Session, t: float) -> int:
    """The window that begins nearest to a moment on the axis of time."""
    return int(np.argmin(np.abs(time_of(session.comparison.windows) - t)))


def _pair(entry: Any) -> tuple[float, float] | None:
    if not isinstance(entry, list | tuple) or len(entry) != 2:
        return None
    if not all(isinstance(number, int | float) and np.isfinite(number) for number in entry):
        return None
    return (float(min(entry)), float(max(entry)))


def _top(session: Session) -> float:
    """The end of the colour scale: that of the first versions' map, so that colours mean the same after an addition."""
    finite = session.first_map().errors
    finite = finite[np.isfinite(finite)]
    return float(np.quantile(finite, 0.98)) if len(finite) else 1.0


def _height(session: Session) -> float:
    errors = session.versions[0].comparison.window_errors
    finite = errors[np.isfinite(errors)]
    return max(1e-6, 1.15 * float(np.quantile(finite, 0.99))) if len(finite) else 1.0


def _box(brush: Brush | None, x: str, y: str, look: ColourTheme) -> list[dict[str, Any]]:
    if brush is None or not {x, y} <= set(brush.ranges):
        return []
    (x0, x1), (y0, y1) = brush.ranges[x], brush.ranges[y]
    line = {"color": look.selected, "width": 2}
    return [{"type": "rect", "x0": x0, "x1": x1, "y0": y0, "y1": y1, "line": line}]


def _borders(comparison: Comparison, t: FloatArray, look: ColourTheme) -> list[dict[str, Any]]:
    edges = np.flatnonzero(np.diff(comparison.windows.run)) + 1
    line = {"color": look.dim, "width": 1, "dash": "dot"}
    return [{"type": "line", "x0": float(t[e]), "x1": float(t[e]), "yref": "paper", "y0": 0, "y1": 1, "line": line}
            for e in edges]  # fmt: skip


def _mark(t: float, look: ColourTheme) -> dict[str, Any]:
    return {
        "type": "line",
        "x0": t,
        "x1": t,
        "yref": "paper",
        "y0": 0,
        "y1": 1,
        "line": {"color": look.text, "width": 1},
    }


def _ends(edges: FloatArray) -> list[float]:
    return [float(edges[0]), float(edges[-1])]


def _titled(name: str, units: dict[str, str]) -> str:
    return name.replace("_", " ") + ("" if units[name] == "1" else f" [{units[name]}]")


def _numbers(values: FloatArray) -> list[float | None]:
    """Four significant digits; None for what is not finite."""
    return [float(f"{value:.5g}") if np.isfinite(value) else None for value in values.tolist()]
