"""The margin of every filter, conformal next to the theory's bound, and what they cover on fresh drives."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from safedpa_lab.experiments.car_report import MODEL_TITLES
from safedpa_lab.experiments.car_style import BLACK, GREY, MODELS, bare, figure, heading

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["margin_figure"]

_KINDS = {"obstacle": "obstacle [m]", "field": "field [m]", "speed": "speed [m/s]"}


def margin_figure(result: dict[str, Any], path: Path) -> None:
    """Left the margins by kind of barrier, right the share of fresh steps that they cover."""
    models = result["margin"]["models"]
    with figure(path, 3.7) as drawn:
        left, right = drawn.subplots(1, 2)
        width = 0.84 / len(models)
        tallest = max(row["theorem"]["epsilon"] for rows in models.values() for row in rows.values())
        for place, (name, rows) in enumerate(models.items()):
            offset = (place - (len(models) - 1) / 2) * width
            _bars(left, name, rows, (offset, width), 0.2 * tallest)
            _coverage(right, name, rows, offset)
        for axes in (left, right):
            axes.set_xticks(range(len(_KINDS)), list(_KINDS.values()))
            axes.grid(axis="x", visible=False)
            bare(axes)
        left.set_ylim(0, 1.3 * left.get_ylim()[1])  # room for the numbers above the bars
        left.set_title("epsilon: conformal (full), theorem (frame)", fontsize=10, fontweight="bold")
        right.set_title("fresh steps covered by the conformal one", fontsize=10, fontweight="bold")
        right.axhline(100 * result["margin"]["coverage_wanted"], color=GREY, linestyle=":", linewidth=1.2)
        right.set_ylabel("%")
        handles, labels = left.get_legend_handles_labels()
        drawn.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=8.5)
        heading(drawn, "The margin of every filter, and its coverage")


def _bars(axes: Axes, name: str, rows: dict[str, Any], where: tuple[float, float], room: float) -> None:
    """Bars at an offset, so wide; a number takes ``room`` within a frame, else it is left to the table."""
    offset, width = where
    colour = MODELS[name][0]
    at = [index + offset for index, kind in enumerate(_KINDS) if kind in rows]
    found = [rows[kind] for kind in _KINDS if kind in rows]
    bounds, values = ([row[margin]["epsilon"] for row in found] for margin in ("theorem", "conformal"))
    axes.bar(at, bounds, width=0.86 * width, color="white", edgecolor=colour, linewidth=1.2)
    axes.bar(at, values, width=0.86 * width, color=colour, label=MODEL_TITLES[name])
    for place, bound, value in zip(at, bounds, values, strict=True):
        _number(axes, place, max(bound, value))
        if bound - value > room:
            _number(axes, place, value)


def _number(axes: Axes, place: float, number: float) -> None:
    axes.text(place, number, f" {number:.3f}", ha="center", va="bottom", fontsize=7, color=BLACK, rotation=90)


def _coverage(axes: Axes, name: str, rows: dict[str, Any], offset: float) -> None:
    colour, _, marker = MODELS[name]
    for index, kind in enumerate(_KINDS):
        if kind not in rows:
            continue
        row, place = rows[kind]["conformal"], index + offset
        axes.plot([place, place], [100 * end for end in row["interval_95"]], color=colour, linewidth=2)
        axes.plot(place, 100 * row["share"], marker, color=colour, markersize=6, markeredgecolor="white")
