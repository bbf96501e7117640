"""Small multiples for plotly.js: a grid of panels, built as plain dictionaries."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

_GRID = "#E6E9EC"
_TEXT = "#333333"
_AXIS = {"gridcolor": _GRID, "zeroline": False, "linecolor": "#9AA3AB", "ticks": "outside", "ticklen": 4}
_NOTE = {
    "xref": "paper", "yref": "paper", "xanchor": "left", "yanchor": "bottom", "showarrow": False,
    "font": {"size": 13, "color": _TEXT},
}  # fmt: skip


class Panels:
    """A figure of ``rows`` times ``columns`` panels, filled row by row; ``height`` is that of one panel in pixels."""

    def __init__(self, rows: int, columns: int, height: int) -> None:
        self.rows, self.columns, self.height = rows, columns, height
        self.data: list[dict[str, Any]] = []
        self.axes: dict[str, dict[str, Any]] = {}
        self.notes: list[dict[str, Any]] = []
        self.shapes: list[dict[str, Any]] = []
        self.count = 0

    def add(self, title: str, x_title: str, y_title: str) -> int:
        """Adds the next panel of the grid and returns its number."""
        row, column = divmod(self.count, self.columns)
        self.count += 1
        gap_x = 0.22 / self.columns if self.columns > 1 else 0.0
        total = self.rows * self.height
        gap_y = 74 / total
        width = (1.0 - gap_x * (self.columns - 1)) / self.columns
        tall = (1.0 - gap_y * (self.rows - 1)) / self.rows
        left, top = column * (width + gap_x), 1.0 - row * (tall + gap_y)
        self.open(title, x_title, y_title, (left, left + width), (max(top - tall, 0.0), top))
        return self.count

    def add_at(self, title: str, x_title: str, y_title: str, x: tuple[float, float], y: tuple[float, float]) -> int:
        """Adds a panel with the given extent, as shares of the figure, and returns its number."""
        self.count += 1
        self.open(title, x_title, y_title, x, y)
        return self.count

    def open(self, title: str, x_title: str, y_title: str, x: tuple[float, float], y: tuple[float, float]) -> None:
        """Creates the axes and the title of panel number ``count``."""
        suffix, font = _suffix(self.count), {"size": 12, "color": _TEXT}
        for this, other, text, extent in (("x", "y", x_title, x), ("y", "x", y_title, y)):
            placed = {"domain": rounded(extent), "anchor": f"{other}{suffix}"}
            self.axes[f"{this}axis{suffix}"] = {
                **_AXIS, **placed, "title": {"text": text, "font": font, "standoff": 6}
            }  # fmt: skip
        if title:
            self.notes.append({"text": f"<b>{title}</b>", "x": rounded(x)[0], "y": rounded(y)[1], **_NOTE})

    def axis(self, at: int, which: str, **settings: Any) -> None:
        """Changes settings of the ``x`` or ``y`` axis of a panel."""
        if "scaleanchor" in settings:
            settings["scaleanchor"] += _suffix(at)
        self.axes[f"{which}axis{_suffix(at)}"].update(settings)

    def draw(self, at: int, x: Iterable[float], y: Iterable[float], **settings: Any) -> None:
        """Draws a line or points in a panel."""
        settings.setdefault("showlegend", False)
        self._trace(at, {"type": "scatter", "x": rounded(x), "y": rounded(y), **settings})

    def bars(
        self, at: int, x: list[float], heights: list[float], widths: list[float], colours: list[str], texts: list[str]
    ) -> None:
        """Draws bars with individual widths in a panel."""
        marker = {"color": colours, "line": {"color": "#FFFFFF", "width": 1}}
        shape = {"type": "bar", "x": rounded(x), "y": rounded(heights), "width": rounded(widths), "marker": marker}
        hover = {"text": texts, "hoverinfo": "text", "textposition": "none"}
        self._trace(at, {**shape, **hover, "showlegend": False})

    def heat(self, at: int, x: list[Any], y: list[Any], z: list[list[Any]], text: list[list[str]], title: str) -> None:
        """Draws a heat map in a panel, with a colour scale that readers with colour blindness can order."""
        bar = {"title": {"text": title, "side": "right"}, "thickness": 14, "outlinewidth": 0}
        hover = "x %{x:.2f} m, y %{y:.2f} m<br>error %{z:.3f}<br>%{text}<extra></extra>"
        colour = {"colorscale": "Cividis", "colorbar": bar}
        self._trace(at, {"type": "heatmap", "x": x, "y": y, "z": z, "text": text, "hovertemplate": hover, **colour})

    def level(self, at: int, value: float) -> None:
        """Draws a thin horizontal line across a panel."""
        suffix = _suffix(at)
        if math.isfinite(value):
            (height,), line = rounded([value]), {"color": "#222222", "width": 1.2, "dash": "dash"}
            axes = {"type": "line", "xref": f"x{suffix} domain", "yref": f"y{suffix}"}
            self.shapes.append({**axes, "x0": 0, "x1": 1, "y0": height, "y1": height, "line": line})

    def figure(self, name: str, **layout: Any) -> dict[str, Any]:
        """Returns the figure, which the page draws into the element ``name``."""
        return {
            "id": name,
            "data": self.data,
            "layout": {
                **self.axes,
                "annotations": self.notes,
                "shapes": self.shapes,
                "height": self.rows * self.height + 60,
                "margin": {"l": 62, "r": 14, "t": 40, "b": 52},
                "paper_bgcolor": "#FFFFFF",
                "plot_bgcolor": "#FFFFFF",
                "font": {"family": "system-ui, 'Segoe UI', 'Helvetica Neue', Arial, sans-serif", "size": 12},
                "hovermode": "closest",
                **layout,
            },
        }

    def _trace(self, at: int, trace: dict[str, Any]) -> None:
        suffix = _suffix(at)
        self.data.append({**trace, "xaxis": f"x{suffix}", "yaxis": f"y{suffix}"})


def label(variable: Any) -> str:
    """speed [m/s]: name and unit of a variable or factor."""
    name = getattr(variable, "name", None) or variable.variable
    return f"{name} [{variable.unit}]"


def rounded(values: Iterable[float]) -> list[float | None]:
    """Five significant digits, which is more than a screen shows; null for what is not finite."""
    return [float(f"{value:.5g}") if math.isfinite(value) else None for value in np.asarray(values, dtype=np.float64)]


def _suffix(at: int) -> str:
    return "" if at == 1 else str(at)
