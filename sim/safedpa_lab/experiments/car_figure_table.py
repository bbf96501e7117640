"""The table as a picture: bars with 95 % intervals, the paper's values next to them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from safedpa_lab.experiments.car_methods import METHODS
from safedpa_lab.experiments.car_scenes import CONFIGURATIONS
from safedpa_lab.experiments.car_style import BLACK, METHOD_COLOURS, bare, figure, heading
from safedpa_lab.experiments.car_table import MEASURES

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["table_figure"]

_NAMES = {"success": "reached", "safe": "no contact", "both": "both"}


def table_figure(result: dict[str, Any], path: Path) -> None:
    """A row of panels for each measure, a panel for each configuration, a bar for each method."""
    cells = {(cell["method"], cell["load"]): cell for cell in result["cells"]}
    methods = [name for name in METHODS if any(method == name for method, _ in cells)]
    loads = [load for load in CONFIGURATIONS if any(own == load for _, own in cells)]
    height = len(MEASURES) * (0.42 + 0.235 * len(methods)) + 0.9
    with figure(path, height) as drawn:
        panels = drawn.subplots(len(MEASURES), len(loads), sharex=True, sharey=True, squeeze=False)
        for row, measure in enumerate(MEASURES):
            for column, load in enumerate(loads):
                axes = panels[row][column]
                _panel(axes, [cells.get((name, load)) for name in methods], measure)
                axes.set_yticks(range(len(methods)), [METHODS[name].title for name in methods])
                if row == 0:
                    axes.set_title(CONFIGURATIONS[load], fontsize=10, fontweight="bold")
            panels[row][0].set_ylabel(_NAMES[measure], fontsize=9, fontweight="bold")
        panels[0][0].invert_yaxis()
        episodes = result["cells"][0]["episodes"]
        heading(
            drawn,
            "Success and safety of the car, by method and what it tows",
            f"{episodes} episodes a bar; lines: 95 % Wilson intervals; black diamonds: SafeDPA in the paper",
        )


def _panel(axes: Axes, cells: list[dict[str, Any] | None], measure: str) -> None:
    for place, cell in enumerate(cells):
        if cell is None:
            continue
        share, (low, high) = cell[measure]["share"], cell[measure]["interval_95"]
        axes.barh(place, share, height=0.72, color=METHOD_COLOURS[cell["method"]])
        axes.plot([low, high], [place, place], color=BLACK, linewidth=1.1, solid_capstyle="butt")
        axes.text(1.06, place, f"{100 * share:.0f} %", va="center", fontsize=8, color=BLACK)
        paper = (cell["paper"] or {}).get(measure)
        if paper is not None:
            axes.plot(paper, place, "D", color=BLACK, markersize=4.5, markeredgecolor="white", markeredgewidth=0.8)
    bare(axes)
    axes.set_xlim(0, 1.32)
    axes.set_xticks([0, 0.5, 1], ["0", "50 %", "100 %"], fontsize=8)
    axes.grid(axis="y", visible=False)
