"""Colours and the common layout of all figures, for light and dark pages; safe for colour-blind users."""

from __future__ import annotations

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


def figure_layout(theme: ColourTheme, **layout: Any) -> dict[str, Any]:
    """Returns the Plotly layout that all figures share, with the given entries added or replaced."""
    return {
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"family": "system-ui, DejaVu Sans, sans-serif", "size": 12, "color": theme.text},
        "margin": {"l": 46, "r": 8, "t": 8, "b": 36},
        "showlegend": False,
        "hovermode": "closest",
        "hoverlabel": {"font": {"size": 12}},
        **layout,
    }


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


CONFIG = {"displayModeBar": False, "responsive": True, "doubleClick": False, "scrollZoom": False}
"""Configuration of plotly.js: without its tool bar, which the keyboard cannot reach; the page has its own controls."""
