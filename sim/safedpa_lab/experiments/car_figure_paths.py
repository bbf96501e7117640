"""The paper's figure of predicted trajectories after the first ten steps, one panel a configuration."""

from __future__ import annotations

from math import atan2, cos, pi, sin
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from safedpa.arrays import FloatArray
from safedpa_lab.experiments.car_paths import FIRST_STEPS
from safedpa_lab.experiments.car_report import MODEL_TITLES
from safedpa_lab.experiments.car_scenes import CONFIGURATIONS
from safedpa_lab.experiments.car_style import BLACK, GREY, MODELS, bare, figure, heading

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["paths_figure"]


def paths_figure(result: dict[str, Any], path: Path) -> None:
    """The driven path in black, each model's prediction of it in colour; all turned so that the start heads up."""
    rows = result["paths"]
    with figure(path, 4.5) as drawn:
        panels = drawn.subplots(1, len(rows), sharex=True, sharey=True, squeeze=False)[0]
        for axes, row in zip(panels, rows, strict=True):
            _panel(axes, row)
        panels[0].set_ylabel("m")
        handles, labels = panels[0].get_legend_handles_labels()
        drawn.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=8.5, columnspacing=1.4)
        steps = len(rows[0]["driven"]) - 1 - FIRST_STEPS
        heading(drawn, f"Predicted from the first {FIRST_STEPS} steps: the next {steps} steps ({steps * 0.05:.1f} s)")


def _panel(axes: Axes, row: dict[str, Any]) -> None:
    driven = np.array(row["driven"])
    turned = _turned(driven, driven)
    axes.plot(*turned[: FIRST_STEPS + 1].T, color=GREY, linewidth=5, solid_capstyle="round", label="known")
    axes.plot(*turned[FIRST_STEPS:].T, color=BLACK, linewidth=2.6, label="driven")
    for name, found in row["predicted"].items():
        colour, line, marker = MODELS[name]
        points = _turned(np.array([row["driven"][FIRST_STEPS], *found["path"]]), driven)
        axes.plot(*points.T, color=colour, linestyle=line, linewidth=1.8, label=MODEL_TITLES[name])
        axes.plot(*points[-1], marker=marker, color=colour, markersize=6, markeredgecolor="white")
    bare(axes)
    axes.set_aspect("equal")
    axes.set_title(CONFIGURATIONS[row["load"]], fontsize=10, fontweight="bold")


def _turned(points: FloatArray, driven: FloatArray) -> FloatArray:
    """About the last known place, so that the car's way there leads up."""
    origin = driven[FIRST_STEPS]
    way = origin - driven[0]
    angle = pi / 2 - atan2(way[1], way[0])
    turn = np.array([[cos(angle), -sin(angle)], [sin(angle), cos(angle)]])
    turned: FloatArray = (points - origin) @ turn.T
    return turned
