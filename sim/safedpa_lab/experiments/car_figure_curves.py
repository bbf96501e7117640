"""The car made harder: small multiples, a column a sweep, safe above and safe in time below."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from safedpa_lab.experiments.car_advantage import OWN, SIGNIFICANT
from safedpa_lab.experiments.car_methods import METHODS
from safedpa_lab.experiments.car_style import BLACK, GREY, METHOD_COLOURS, bare, figure, heading

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["curves_figure"]

_COLUMNS: Final = 3
"""Sweeps next to each other."""
_ROWS: Final = (("safe", "no contact"), ("both", "at the goal in time,\nwithout contact"))
_APART: Final = 0.075
"""Of one curve and the next, in steps of the values, so that equal ones can be told apart."""
_MARKERS: Final = {"safedpa": "o", "rma": "X", "rma_p": "D", "ppo": "d", "physics": "s"}
_LEAST_ROOM: Final = 11.0
"""% of the height between two names next to the curves."""


def curves_figure(result: Mapping[str, Any], path: Path) -> None:
    """Shares with 95 % Wilson intervals over the values of each sweep; names at the right of each row."""
    sweeps = list(result["sweeps"].values())
    blocks = [sweeps[start : start + _COLUMNS] for start in range(0, len(sweeps), _COLUMNS)]
    columns = max(len(block) for block in blocks)
    with figure(path, 0.8 + 3.1 * len(blocks)) as drawn:
        panels = drawn.subplots(len(_ROWS) * len(blocks), columns, sharey=True, squeeze=False)
        for index, block in enumerate(blocks):
            for row, (measure, phrase) in enumerate(_ROWS):
                line = panels[len(_ROWS) * index + row]
                line[0].set_ylabel(phrase, fontsize=8.5)
                for axes, sweep in zip(line, block, strict=False):
                    _panel(axes, sweep, measure)
                    if row == len(_ROWS) - 1:
                        axes.set_xlabel(sweep["label"], fontsize=8.5)
                    else:
                        axes.tick_params(labelbottom=False)
                _names(line[len(block) - 1], block[-1], measure)
                for axes in line[len(block) :]:
                    axes.set_axis_off()
        episodes = sweeps[0]["points"][0]["episodes"]
        heading(
            drawn,
            f"The car made harder, from left to right ({result['family']['name']} family, towing a {result['load']})",
            f"{episodes} episodes a point, bars 95 %; a ring: differs from SafeDPA, p < {SIGNIFICANT:g} (McNemar, Holm "
            "over the sweep); dotted: the experiment's own value",
        )


def _panel(axes: Axes, sweep: Mapping[str, Any], measure: str) -> None:
    shown: Sequence[str] = sweep["shown"]
    places = np.arange(len(shown), dtype=np.float64)
    methods = _methods(sweep)
    differs = {
        (row["against"], row["place"])
        for row in sweep["advantages"]
        if row["measure"] == measure and row["holm"] < SIGNIFICANT
    }
    if sweep["usual"] is not None:
        axes.axvline(sweep["values"].index(sweep["usual"]), color=GREY, linewidth=0.8, linestyle=":", zorder=0)
    for index, name in enumerate(reversed(methods)):  # SafeDPA on top
        away = places + _APART * (0.5 * (len(methods) - 1) - index)
        low, share, high = _curve(sweep, name, measure)
        colour = METHOD_COLOURS[name]
        axes.errorbar(
            away,
            share,
            np.maximum(0.0, [share - low, high - share]),
            color=colour,
            marker=_MARKERS.get(name, "v"),
            markersize=4.2,
            linewidth=1.9 if name == OWN else 1.2,
            elinewidth=0.8,
        )
        marked = [place for place, value in enumerate(shown) if (name, value) in differs]
        axes.plot(away[marked], share[marked], "o", markersize=9.0, markerfacecolor="none", color=BLACK, linewidth=0.8)
    axes.set_xticks(places, ["\n".join(value.rsplit(" ", 1)) for value in shown])
    axes.set_xlim(-0.45, len(shown) - 0.55)
    axes.set_ylim(-4, 106)
    axes.set_yticks([0, 25, 50, 75, 100], ["0", "25", "50", "75", "100 %"])
    axes.tick_params(labelsize=8)
    axes.grid(axis="x", visible=False)
    bare(axes)


def _methods(sweep: Mapping[str, Any]) -> list[str]:
    return list(dict.fromkeys(point["method"] for point in sweep["points"]))


def _curve(sweep: Mapping[str, Any], name: str, measure: str) -> tuple[Any, Any, Any]:
    """Lower end, share and upper end [%] at each value."""
    cells = [point[measure] for point in sweep["points"] if point["method"] == name]
    ends = 100.0 * np.array([cell["interval_95"] for cell in cells])
    return ends[:, 0], 100.0 * np.array([cell["share"] for cell in cells]), ends[:, 1]


def _names(axes: Axes, sweep: Mapping[str, Any], measure: str) -> None:
    """The methods' names next to the last panel, each as near to its curve's end as the others leave room."""
    ends = {name: float(_curve(sweep, name, measure)[1][-1]) for name in _methods(sweep)}
    heights = _spread([ends[name] for name in ends], _LEAST_ROOM, 101.0)
    for name, height in zip(ends, heights, strict=True):
        axes.annotate(
            METHODS[name].title.replace(" model", ""),
            (1.03, height),
            xycoords=axes.get_yaxis_transform(),
            va="center",
            fontsize=8.5,
            fontweight="bold" if name == OWN else "normal",
            color=_dark(METHOD_COLOURS[name]),
            annotation_clip=False,
        )


def _spread(heights: Sequence[float], room: float, highest: float) -> list[float]:
    """The heights moved down from ``highest`` on, no more than needed, so that ``room`` is between any two."""
    found = list(heights)
    above = highest + room
    for index in sorted(range(len(found)), key=lambda one: -found[one]):
        above = found[index] = min(found[index], above - room)
    return found


def _dark(colour: str) -> tuple[float, float, float]:
    """A shade in which a thin letter can be read on white."""
    from matplotlib.colors import to_rgb

    red, green, blue = to_rgb(colour)
    light = 0.299 * red + 0.587 * green + 0.114 * blue
    factor = min(1.0, 0.55 / light)
    return factor * red, factor * green, factor * blue
