"""Colours and building blocks of all Plotly figures, for light and dark pages; safe for colour-blind users."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class ColourTheme:
    """Colours of the figures: the palette of Okabe and Ito, lightened on a dark page, and greys."""

    text: str
    grid: str
    measured: str
    given: str
    between: str
    present: str
    dim: str
    selected: str


LIGHT = ColourTheme("#1b1f24", "#d5dae0", "#1b1f24", "#D55E00", "#8a94a0", "#0072B2", "#aeb7c1", "#D55E00")
DARK = ColourTheme("#e8ebee", "#3a424c", "#e8ebee", "#E8803C", "#8f9aa6", "#56B4E9", "#5c6672", "#F0A35E")

MAP_COLOURS = "Cividis"
_CONFIG = {"displayModeBar": False, "responsive": True, "doubleClick": False, "scrollZoom": False}
"""Configuration of plotly.js: without its tool bar, which the keyboard cannot reach; the page has its own controls."""


def figure(theme: ColourTheme, data: list[dict[str, Any]], **layout: Any) -> dict[str, Any]:
    """Returns a figure with the layout that all figures share, with the given entries added or replaced."""
    shared = {
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"family": "system-ui, DejaVu Sans, sans-serif", "size": 12, "color": theme.text},
        "margin": {"l": 46, "r": 8, "t": 8, "b": 36},
        "showlegend": False,
        "hovermode": "closest",
        "hoverlabel": {"font": {"size": 12}},
    }
    return {"data": data, "layout": {**shared, **layout}, "config": _CONFIG}


def axis(theme: ColourTheme, title: str, **more: Any) -> dict[str, Any]:
    """Returns a Plotly axis with a title and grid lines in the theme's colour."""
    return {
        "title": {"text": title, "standoff": 6},
        "gridcolor": theme.grid,
        "zerolinecolor": theme.grid,
        "linecolor": theme.grid,
        "ticks": "outside",
        "tickcolor": theme.grid,
        "ticklen": 3,
        **more,
    }


def curve(
    x: Sequence[Any], y: Sequence[Any], colour: str, width: float, hover: str, *, dash: str = "solid", **more: Any
) -> dict[str, Any]:
    """Returns a line through points; ``hover`` describes a point under the mouse, as a template of Plotly."""
    line = {"color": colour, "width": width, "dash": dash}
    trace = {"type": "scatter", "mode": "lines", "x": x, "y": y, "line": line}
    return {**trace, "hovertemplate": f"{hover}<extra></extra>", **more}


def markers(x: Sequence[Any], y: Sequence[Any], marker: dict[str, Any], **more: Any) -> dict[str, Any]:
    """Returns points with the look ``marker``."""
    return {"type": "scatter", "mode": "markers", "x": x, "y": y, "marker": marker, **more}


def vertical_line(t: float, colour: str, width: float = 1.0, dash: str = "solid") -> dict[str, Any]:
    """Returns a line over the whole height of a figure."""
    line = {"color": colour, "width": width, "dash": dash}
    return {"type": "line", "x0": t, "x1": t, "yref": "paper", "y0": 0, "y1": 1, "line": line}


def json_numbers(values: Iterable[float]) -> list[float | None]:
    """Returns values with five significant digits, to shorten the message to the browser; None if not finite."""
    return [float(f"{value:.5g}") if math.isfinite(value) else None for value in values]
