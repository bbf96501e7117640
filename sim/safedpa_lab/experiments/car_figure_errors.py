"""The paper's figure of empirical errors: predictions over one step and one second, with tuning and without."""

from __future__ import annotations

from math import floor, log10
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safedpa_lab.experiments.car_report import MODEL_TITLES
from safedpa_lab.experiments.car_scenes import CONFIGURATIONS
from safedpa_lab.experiments.car_style import BLACK, MODELS, bare, figure, heading

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["errors_figure"]

_HORIZONS = {"one_step": "one step (0.05 s)", "one_second": "one second, open loop"}


def errors_figure(result: dict[str, Any], path: Path) -> None:
    """A panel for each horizon; bars by configuration and model on a logarithmic axis, untuned over tuned above."""
    errors = result["errors"]
    with figure(path, 3.9) as drawn:
        panels = drawn.subplots(1, 2)
        for axes, (horizon, phrase) in zip(panels, _HORIZONS.items(), strict=True):
            _panel(axes, errors, horizon, result.get("ratios"))
            axes.set_title(phrase, fontsize=10, fontweight="bold")
        panels[0].set_ylabel("error over the scale of one step's change")
        handles, labels = panels[0].get_legend_handles_labels()
        drawn.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=8.5)
        above = "; above the bars: untuned over tuned" if result.get("ratios") else ""
        heading(drawn, f"Prediction errors on fresh drives{above}")


def _panel(axes: Axes, errors: dict[str, Any], horizon: str, ratios: dict[str, Any] | None) -> None:
    loads = list(next(iter(errors.values())))
    width = 0.8 / len(errors)
    for place, (name, rows) in enumerate(errors.items()):
        numbers = [rows[load][horizon]["number"] for load in loads]
        at = [index + (place - (len(errors) - 1) / 2) * width for index in range(len(loads))]
        axes.bar(at, numbers, width=0.92 * width, color=MODELS[name][0], label=MODEL_TITLES[name])
    _decades(axes, [rows[load][horizon]["number"] for rows in errors.values() for load in loads])
    axes.set_xticks(range(len(loads)), [CONFIGURATIONS.get(load, load).replace(" ", "\n") for load in loads])
    axes.grid(axis="x", visible=False)
    bare(axes)
    for index, load in enumerate(loads):
        if ratios:
            top = max(rows[load][horizon]["number"] for rows in errors.values())
            text = f"{ratios[load][horizon]:.1f}x"
            axes.text(index, 1.12 * top, text, ha="center", fontsize=9, fontweight="bold", color=BLACK)


def _decades(axes: Axes, numbers: list[float]) -> None:
    """A logarithmic axis from a whole decade on, labelled in plain numbers, with room for the ratios above."""
    from matplotlib.ticker import NullFormatter, StrMethodFormatter

    axes.set_yscale("log")
    axes.set_ylim(10.0 ** floor(log10(min(numbers)) - 0.15), 2.0 * max(numbers))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
