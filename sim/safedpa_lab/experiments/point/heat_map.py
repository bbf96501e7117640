"""The heat map as Markdown, JSON and one picture."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, Final

import numpy as np

from safedpa_lab.experiments.common.figures import BLACK, figure, heading
from safedpa_lab.experiments.record import Options, ReportProgress, Result, named_folder
from safedpa_lab.experiments.report import markdown_table
from safedpa_lab.point.heat_map import HeatMap, heat_map

__all__ = ["TITLES", "heat_map_markdown", "run", "write_figure"]

TITLES: Final = {
    "reference": "simulator",
    "safedpa": "SafeDPA",
    "fix_135": "Fix-135",
    "mix": "Mix",
    "fix_225": "Fix-225",
    "fix_45": "Fix-45",
    "fix_315": "Fix-315",
}
"""In the order of the columns."""


def heat_map_markdown(result: dict[str, Any]) -> str:
    """One row a model."""
    points = len(result["axis"])
    rows = []
    for name, title in TITLES.items():
        if name != "reference":
            row = result["agreement"][name]
            rows.append(
                f"{title} | {row['rank_correlation']:.3f} | {row['correlation']:.3f} | {row['map_correlation']:.3f} "
                f"| {100 * row['sign']:.1f} % | {1000 * row['error']:.2f} mm"
            )
    return (
        markdown_table(
            "model | rank correlation | correlation | of a map, median | same sign | error, median",
            rows,
            above=f"{result['moments']} moments near hazards x {points} x {points} actions, force {result['force']:g} "
            f"N towards {result['direction']:g} degrees, seed {result['seed']}, {result['date']}.",
        )
        + "\n"
    )


def write_figure(result: dict[str, Any], out: Path) -> None:
    """``point_heat_map.png`` in the folder ``out``: a row per moment, a column per model, one scale."""
    shown = {name: 1000.0 * np.array(result["shown"][name]) for name in TITLES}
    rows = len(shown["reference"])
    with figure(out / "point_heat_map.png", 0.9 + 1.25 * rows) as drawn:
        panels = drawn.subplots(rows, len(TITLES), sharex=True, sharey=True, squeeze=False)
        for row, axes_of_row in enumerate(panels):
            largest = np.abs(shown["reference"][row]).max()
            for axes, (name, maps) in zip(axes_of_row, shown.items(), strict=True):
                _map(axes, maps[row], largest)
                if row == 0:
                    axes.set_title(_title(name, result), fontsize=7.5, color=BLACK)
            axes_of_row[0].set_ylabel(f"thrust\nup to {largest:.0f} mm", fontsize=7.5)
        for axes in panels[-1]:
            axes.set_xlabel("turn", fontsize=7.5)
        heading(
            drawn,
            f"What each action does to h, wind towards {result['direction']:g} degrees",
            "blue: h grows, room is gained; vermilion: it falls; black line: no change. Numbers: rank correlation with "
            f"the simulator over {result['moments']} moments",
        )


def _title(name: str, result: dict[str, Any]) -> str:
    if name == "reference":
        return "simulator\n"
    return f"{TITLES[name]}\n{result['agreement'][name]['rank_correlation']:.3f}"


def _map(axes: Any, changes: np.ndarray[Any, Any], largest: float) -> None:
    from matplotlib.colors import LinearSegmentedColormap

    colours = LinearSegmentedColormap.from_list("room", ["#D55E00", "#F4F4F4", "#0072B2"])
    axes.imshow(
        changes, origin="lower", extent=(-1, 1, -1, 1), cmap=colours, vmin=-largest, vmax=largest, aspect="auto"
    )
    if changes.min() < 0.0 < changes.max():
        axis = np.linspace(-1.0, 1.0, changes.shape[0])
        axes.contour(axis, axis, changes, levels=[0.0], colors=BLACK, linewidths=0.9)
    axes.grid(visible=False)
    axes.set_xticks([-1, 0, 1], ["-1", "0", "1"], fontsize=6)
    axes.set_yticks([-1, 0, 1], ["-1", "0", "1"], fontsize=6)


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment point-heat-map``."""
    del report_progress
    named_folder("--models", options["folder"])
    asked = {name: value for name, value in options.items() if name != "out"}
    return {"date": time.strftime("%Y-%m-%d"), **heat_map(HeatMap(**asked, shown=min(3, options["moments"])))}
