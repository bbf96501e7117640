"""The heat map as Markdown, JSON and one picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from safedpa_lab.experiments.car_style import BLACK, figure, heading
from safedpa_lab.provenance.record import write_result

__all__ = ["TITLES", "heat_map_markdown", "write_heat_map"]

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


def write_heat_map(result: dict[str, Any], out: Path) -> None:
    """``point-heat-map.json``, ``point-heat-map.md`` and ``point_heat_map.png`` in the folder."""
    out.mkdir(parents=True, exist_ok=True)
    write_result(out / "point-heat-map.json", result)
    (out / "point-heat-map.md").write_text(heat_map_markdown(result), encoding="utf-8")
    _picture(result, out / "point_heat_map.png")


def heat_map_markdown(result: dict[str, Any]) -> str:
    """One row a model."""
    points = len(result["axis"])
    lines = [
        f"{result['moments']} moments near hazards x {points} x {points} actions, force {result['force']:g} N towards "
        f"{result['direction']:g} degrees, seed {result['seed']}, {result['date']}.\n",
        "| model | rank correlation | correlation | of a map, median | same sign | error, median |",
        "|---|---|---|---|---|---|",
    ]
    for name, title in TITLES.items():
        if name != "reference":
            row = result["agreement"][name]
            lines.append(
                f"| {title} | {row['rank_correlation']:.3f} | {row['correlation']:.3f} | {row['map_correlation']:.3f} "
                f"| {100 * row['sign']:.1f} % | {1000 * row['error']:.2f} mm |"
            )
    return "\n".join(lines) + "\n"


def _picture(result: dict[str, Any], path: Path) -> None:
    """A row for each moment that is shown, a column for each model, one scale for all."""
    shown = {name: 1000.0 * np.array(result["shown"][name]) for name in TITLES}
    rows = len(shown["reference"])
    with figure(path, 0.9 + 1.25 * rows) as drawn:
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
