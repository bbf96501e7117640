"""The second column: where the model fails."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nicegui import events, ui

from safedpa_services.workbench.brush import Brush, variables_of
from safedpa_services.workbench.elements import action, escaped, named, panel, text
from safedpa_services.workbench.figures_where import brush_of_map, brush_of_time, map_figure, time_figure
from safedpa_services.workbench.look import Look
from safedpa_services.workbench.session import Session

__all__ = ["WherePanel"]

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
            self._said = text("", "quiet").props("aria-live=polite")
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

    def show(self, session: Session, look: Look) -> None:
        """Draws everything anew."""
        self._session = None  # while the boxes are set, nobody chose
        options = {name: name.replace("_", " ") for name in variables_of(session.comparison.windows)}
        self._x.set_options(options, value=session.axes[0])
        self._y.set_options(options, value=session.axes[1])
        self._session = session
        self._map.update_figure(map_figure(session, look))
        inside = session.inside
        hint = "Drag a box in either figure to select; a click on a cell selects it, a click on the line starts there."
        self._said.set_content(escaped(hint if inside is None else inside.sentence))
        self.show_time(session, look)

    def show_time(self, session: Session, look: Look) -> None:
        """Draws the error along time anew, where the chosen start is marked."""
        self._time.update_figure(time_figure(session, look))


def _ranges(entry: Any) -> dict[str, Any]:
    return entry if isinstance(entry, dict) else {}
