"""Colours and the frame of every figure, for a light and a dark page, safe for colour-blind people."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

__all__ = ["CONFIG", "DARK", "LIGHT", "MAP_COLOURS", "ColourTheme", "axis", "frame"]


@dataclass(frozen=True)
class ColourTheme:
    """Colours of Okabe and Ito, the lighter ones of them on a dark page; greys for the rest."""

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


def frame(look: ColourTheme, **layout: Any) -> dict[str, Any]:
    """The layout that all figures share, with what is special to one of them."""
    return {
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"family": "system-ui, DejaVu Sans, sans-serif", "size": 12, "color": look.text},
        "margin": {"l": 46, "r": 8, "t": 8, "b": 36},
        "showlegend": False,
        "hovermode": "closest",
        "hoverlabel": {"font": {"size": 12}},
        **layout,
    }


def axis(look: ColourTheme, title: str, **more: Any) -> dict[str, Any]:
    """One axis: its title and quiet lines."""
    return {
        "title": {"text": title, "standoff": 6},
        "gridcolor": look.grid,
        "zerolinecolor": look.grid,
        "linecolor": look.grid,
        "ticks": "outside",
        "tickcolor": look.grid,
        "ticklen": 3,
        **more,
    }


CONFIG = {"displayModeBar": False, "responsive": True, "doubleClick": False, "scrollZoom": False}
"""Of plotly.js: no tool bar, whose buttons no keyboard reaches; the page has its own."""
