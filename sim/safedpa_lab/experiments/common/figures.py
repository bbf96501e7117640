"""How the car experiment's figures look: the palette of Okabe and Ito, a light grid, text that fits a README column."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


WIDTH = 8.6
"""Inches; at 150 dots per inch a README's column on a fine screen."""

BLUE, SKY, ORANGE, GREEN, RED, PURPLE = "#0072B2", "#56B4E9", "#E69F00", "#009E73", "#D55E00", "#CC79A7"
BLACK, GREY, LIGHT = "#222222", "#7A8590", "#DCE1E6"

METHOD_COLOURS = {
    "safedpa": BLUE,
    "safedpa_untuned": SKY,
    "rma": ORANGE,
    "rma_p": "#F0C878",
    "ppo": "#9E2A2B",
    "fix": GREEN,
    "mix": "#7FCBB5",
    "policy": RED,
    "physics": GREY,
    "goal_seeker": "#BCC4CB",
    "planner": PURPLE,
    "physics_planner": "#A79BB5",
}
"""By method: blue SafeDPA, green filters that know no latent, orange and red without filter, grey without learning."""

MODELS = {
    "car_learned": (BLUE, "-", "o"),
    "car_simulated": (SKY, (0, (5, 1.5)), "s"),
    "car_fix": (GREEN, (0, (1, 1)), "^"),
    "car_mix": (PURPLE, (0, (4, 1, 1, 1)), "v"),
    "car": (ORANGE, (0, (8, 2)), "D"),
}
"""Colour, line and marker of each model's predictions: distinguishable without colour as well."""

LOADS = {"none": (BLACK, "o"), "box": (SKY, "s"), "chair": (ORANGE, "^"), "large_chair": (GREEN, "D")}
"""Colour and marker of each configuration."""

_SETTINGS: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.edgecolor": GREY,
    "axes.labelcolor": BLACK,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": LIGHT,
    "grid.linewidth": 0.7,
    "xtick.color": BLACK,
    "ytick.color": BLACK,
    "xtick.major.size": 0,
    "ytick.major.size": 0,
    "legend.frameon": False,
}


@contextmanager
def figure(path: Path, height: float) -> Iterator[Figure]:
    """A figure of the common width and look, without any window; written as PNG at the end."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context(_SETTINGS):  # type: ignore[arg-type]
        drawn = Figure(figsize=(WIDTH, height), dpi=150, facecolor="white", layout="constrained")
        FigureCanvasAgg(drawn)
        yield drawn
        path.parent.mkdir(parents=True, exist_ok=True)
        drawn.savefig(path, metadata={"Software": None})


def bare(axes: Axes) -> None:
    """No frame but the left and lower edge."""
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def heading(drawn: Figure, title: str, under: str = "") -> None:
    """A title at the left in bold, and a line under it in grey."""
    drawn.suptitle(title, x=0.01, ha="left", fontsize=11.5, fontweight="bold", color=BLACK)
    if under:
        drawn.get_layout_engine().set(rect=(0, 0, 1, 0.985))  # type: ignore[union-attr, call-arg]
        drawn.supxlabel(under, x=0.01, ha="left", fontsize=8, color=GREY)


def legend(drawn: Figure, axes: Axes, side: str = "center", **more: Any) -> None:
    """What the lines and marks of one panel mean, in one row below all panels."""
    handles, labels = axes.get_legend_handles_labels()
    below: Any = f"outside lower {side}"
    drawn.legend(handles, labels, loc=below, ncols=len(labels), fontsize=8.5, **more)
