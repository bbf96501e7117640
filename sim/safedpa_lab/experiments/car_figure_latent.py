"""Latents by what the car tows, and how soon they follow when a load is hitched or let go."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from safedpa_lab.experiments.car_latent import WITHIN
from safedpa_lab.experiments.car_report import MODEL_TITLES
from safedpa_lab.experiments.car_scenes import CONFIGURATIONS
from safedpa_lab.experiments.car_style import BLACK, GREY, LOADS, MODELS, bare, figure, heading

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["latent_figure"]

_SHOWN = 2
"""Models whose latents are drawn, the first ones."""
_LONGEST = 100
"""Ticks shown after a change."""


def latent_figure(result: dict[str, Any], path: Path) -> None:
    """A cloud for each of the first models, and the share of changes noticed so many ticks after them."""
    latent = dict(list(result["latent"].items())[:_SHOWN])
    with figure(path, 3.6) as drawn:
        panels = drawn.subplots(1, len(latent) + 1, squeeze=False)[0]
        for axes, (name, rows) in zip(panels, latent.items(), strict=False):
            _cloud(axes, rows)
            right = 100 * rows["accuracy"]["share"]
            axes.set_title(f"{MODEL_TITLES[name]}: {right:.0f} % told right", fontsize=10, fontweight="bold")
        _noticed(panels[-1], latent)
        handles, labels = panels[0].get_legend_handles_labels()
        drawn.legend(handles, labels, loc="outside lower left", ncols=len(labels), fontsize=8.5, markerscale=1.8)
        heading(drawn, "The latent by what the car tows, and how soon it follows a change")


def _cloud(axes: Axes, rows: dict[str, Any]) -> None:
    points = rows["points"]
    for load in (name for name in CONFIGURATIONS if name in points["by_load"]):
        colour, marker = LOADS[load]
        at = np.array(points["by_load"][load])
        axes.plot(at[:, 0], at[:, 1], marker, color=colour, markersize=2.6, alpha=0.55, markeredgewidth=0,
                  label=CONFIGURATIONS[load])  # fmt: skip
    first, second = (100 * share for share in points["shares"])
    axes.set_xlabel(f"first principal direction ({first:.0f} %)", fontsize=8)
    axes.set_ylabel(f"second ({second:.0f} %)", fontsize=8)
    axes.tick_params(labelsize=7)
    bare(axes)


def _noticed(axes: Axes, latent: dict[str, Any]) -> None:
    ticks = np.arange(_LONGEST + 1)
    for name, rows in latent.items():
        found = [change["latent_ticks"] for change in rows["changes"]]
        counted = np.array([np.inf if value is None else value for value in found])
        share = [(counted <= tick).mean() for tick in ticks]
        colour, line, _ = MODELS[name]
        axes.step(ticks, share, where="post", color=colour, linestyle=line, linewidth=2, label=MODEL_TITLES[name])
    axes.axvline(WITHIN, color=GREY, linewidth=1, linestyle=":")
    axes.text(WITHIN + 1.5, 0.03, f"k = {WITHIN}", color=GREY, fontsize=8)
    axes.set_ylim(0, 1.03)
    axes.set_xlabel("ticks after a load is hitched or let go", fontsize=8)
    axes.set_title("share noticed by the latent", fontsize=10, fontweight="bold", color=BLACK)
    axes.legend(fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 0.12))
    axes.tick_params(labelsize=7)
    bare(axes)
