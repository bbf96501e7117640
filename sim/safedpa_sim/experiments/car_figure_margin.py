"""The margin of every filter, and what it covers on fresh drives."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from safedpa_sim.experiments.car_report import MODEL_TITLES
from safedpa_sim.experiments.car_style import BLACK, GREY, MODELS, bare, figure, heading

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["margin_figure"]

_KINDS = {"obstacle": "obstacle [m]", "field": "field [m]", "speed": "speed [m/s]"}


def margin_figure(result: dict[str, Any], path: Path) -> None:
    """Left the margins by kind of barrier, right the share of fresh steps that they cover."""
    models = result["margin"]["models"]
    with figure(path, 3.6) as drawn:
        left, right = drawn.subplots(1, 2)
        width = 0.8 / len(models)
        for place, (name, rows) in enumerate(models.items()):
            offset = (place - (len(models) - 1) / 2) * width
            _bars(left, name, rows, offset, width)
            _coverage(right, name, rows, offset)
        for axes in (left, right):
            axes.set_xticks(range(len(_KINDS)), list(_KINDS.values()))
            axes.grid(axis="x", visible=False)
            bare(axes)
        left.set_title(f"epsilon ({result['margin']['rule']})", fontsize=10, fontweight="bold")
        right.set_title("steps covered on fresh drives", fontsize=10, fontweight="bold")
        right.axhline(100 * result["margin"]["coverage_wanted"], color=GREY, linestyle=":", linewidth=1.2)
        handles, labels = left.get_legend_handles_labels()
        drawn.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=8.5)
        heading(drawn, "The margin of every filter, and its coverage")


def _bars(axes: Axes, name: str, rows: dict[str, Any], offset: float, width: float) -> None:
    at = [index + offset for index, kind in enumerate(_KINDS) if kind in rows]
    values = [rows[kind]["epsilon"] for kind in _KINDS if kind in rows]
    axes.bar(at, values, width=0.92 * width, color=MODELS[name][0], label=MODEL_TITLES[name])
    for place, value in zip(at, values, strict=True):
        axes.text(place, value, f"{value:.3f}", ha="center", va="bottom", fontsize=7, color=BLACK)


def _coverage(axes: Axes, name: str, rows: dict[str, Any], offset: float) -> None:
    colour, _, marker = MODELS[name]
    for index, kind in enumerate(_KINDS):
        if kind not in rows:
            continue
        low, high = rows[kind]["interval_95"]
        place = index + offset
        axes.plot([place, place], [100 * low, 100 * high], color=colour, linewidth=2)
        axes.plot(place, 100 * rows[kind]["share"], marker, color=colour, markersize=6, markeredgecolor="white")
    axes.set_ylabel("%")
