"""The figures and the recording of the car experiments: each is drawn only if its part was run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import atan2, cos, floor, log10, pi, sin
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa_lab.experiments.car.conditions import CONFIGURATIONS
from safedpa_lab.experiments.car.latent import WITHIN
from safedpa_lab.experiments.car.methods import METHODS
from safedpa_lab.experiments.car.predictor import FIRST_STEPS
from safedpa_lab.experiments.car.report import MEASURES, MODEL_TITLES, OWN, SIGNIFICANT
from safedpa_lab.experiments.common.figures import (
    BLACK,
    GREY,
    LOADS,
    METHOD_COLOURS,
    MODELS,
    bare,
    figure,
    heading,
    legend,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def write_figures(result: dict[str, Any], out: Path) -> list[Path]:
    """Five PNGs in the folder, ``car_table.png`` and others, and the recording ``car.rrd``.

    Returns the paths of those written.
    """
    drawings = (
        ("cells", "car_table.png", table_figure),
        ("paths", "car_predictions.png", paths_figure),
        ("errors", "car_errors.png", errors_figure),
        ("latent", "car_latent.png", latent_figure),
        ("margin", "car_margin.png", margin_figure),
    )
    written = []
    for part, name, draw in drawings:
        if result.get(part) and (part != "margin" or result[part]["models"]):  # methods without a filter have none
            draw(result, out / name)
            written.append(out / name)
    write_recording(result, out / "car.rrd")
    return written


TITLE: Final[dict[str, Any]] = {"fontsize": 10, "fontweight": "bold"}
"""Of a panel."""
_TABLE_NAMES = {"success": "reached", "safe": "no contact", "both": "both"}


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
                _table_panel(axes, [cells.get((name, load)) for name in methods], measure)
                axes.set_yticks(range(len(methods)), [METHODS[name].title for name in methods])
                if row == 0:
                    axes.set_title(CONFIGURATIONS[load], **TITLE)
            panels[row][0].set_ylabel(_TABLE_NAMES[measure], fontsize=9, fontweight="bold")
        panels[0][0].invert_yaxis()
        episodes = result["cells"][0]["episodes"]
        heading(
            drawn,
            "Success and safety of the car, by method and what it tows",
            f"{episodes} episodes a bar; lines: 95 % Wilson intervals; black diamonds: SafeDPA in the paper",
        )


def _table_panel(axes: Axes, cells: list[dict[str, Any] | None], measure: str) -> None:
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


def paths_figure(result: dict[str, Any], path: Path) -> None:
    """The driven path in black, each model's prediction of it in colour; all turned so that the start heads up."""
    rows = result["paths"]
    with figure(path, 4.5) as drawn:
        panels = drawn.subplots(1, len(rows), sharex=True, sharey=True, squeeze=False)[0]
        for axes, row in zip(panels, rows, strict=True):
            _paths_panel(axes, row)
        panels[0].set_ylabel("m")
        legend(drawn, panels[0], columnspacing=1.4)
        steps = len(rows[0]["driven"]) - 1 - FIRST_STEPS
        heading(drawn, f"Predicted from the first {FIRST_STEPS} steps: the next {steps} steps ({steps * 0.05:.1f} s)")


def _paths_panel(axes: Axes, row: dict[str, Any]) -> None:
    driven = np.array(row["driven"])
    turned = _paths_turned(driven, driven)
    axes.plot(*turned[: FIRST_STEPS + 1].T, color=GREY, linewidth=5, solid_capstyle="round", label="known")
    axes.plot(*turned[FIRST_STEPS:].T, color=BLACK, linewidth=2.6, label="driven")
    for name, found in row["predicted"].items():
        colour, line, marker = MODELS[name]
        points = _paths_turned(np.array([row["driven"][FIRST_STEPS], *found["path"]]), driven)
        axes.plot(*points.T, color=colour, linestyle=line, linewidth=1.8, label=MODEL_TITLES[name])
        axes.plot(*points[-1], marker=marker, color=colour, markersize=6, markeredgecolor="white")
    bare(axes)
    axes.set_aspect("equal")
    axes.set_title(CONFIGURATIONS[row["load"]], **TITLE)


def _paths_turned(points: FloatArray, driven: FloatArray) -> FloatArray:
    """About the last known place, so that the car's way there leads up."""
    origin = driven[FIRST_STEPS]
    way = origin - driven[0]
    angle = pi / 2 - atan2(way[1], way[0])
    turn = np.array([[cos(angle), -sin(angle)], [sin(angle), cos(angle)]])
    turned: FloatArray = (points - origin) @ turn.T
    return turned


_ERRORS_HORIZONS = {"one_step": "one step (0.05 s)", "one_second": "one second, open loop"}


def errors_figure(result: dict[str, Any], path: Path) -> None:
    """A panel for each horizon; bars by configuration and model on a logarithmic axis, untuned over tuned above."""
    errors = result["errors"]
    with figure(path, 3.9) as drawn:
        panels = drawn.subplots(1, 2)
        for axes, (horizon, phrase) in zip(panels, _ERRORS_HORIZONS.items(), strict=True):
            _errors_panel(axes, errors, horizon, result.get("ratios"))
            axes.set_title(phrase, **TITLE)
        panels[0].set_ylabel("error over the scale of one step's change")
        legend(drawn, panels[0])
        above = "; above the bars: untuned over tuned" if result.get("ratios") else ""
        heading(drawn, f"Prediction errors on fresh drives{above}")


def _errors_panel(axes: Axes, errors: dict[str, Any], horizon: str, ratios: dict[str, Any] | None) -> None:
    loads = list(next(iter(errors.values())))
    width = 0.8 / len(errors)
    for place, (name, rows) in enumerate(errors.items()):
        numbers = [rows[load][horizon]["number"] for load in loads]
        at = [index + (place - (len(errors) - 1) / 2) * width for index in range(len(loads))]
        axes.bar(at, numbers, width=0.92 * width, color=MODELS[name][0], label=MODEL_TITLES[name])
    _errors_decades(axes, [rows[load][horizon]["number"] for rows in errors.values() for load in loads])
    axes.set_xticks(range(len(loads)), [CONFIGURATIONS.get(load, load).replace(" ", "\n") for load in loads])
    axes.grid(axis="x", visible=False)
    bare(axes)
    for index, load in enumerate(loads):
        if ratios:
            top = max(rows[load][horizon]["number"] for rows in errors.values())
            text = f"{ratios[load][horizon]:.1f}x"
            axes.text(index, 1.12 * top, text, ha="center", fontsize=9, fontweight="bold", color=BLACK)


def _errors_decades(axes: Axes, numbers: list[float]) -> None:
    """A logarithmic axis from a whole decade on, labelled in plain numbers, with room for the ratios above."""
    from matplotlib.ticker import NullFormatter, StrMethodFormatter

    axes.set_yscale("log")
    axes.set_ylim(10.0 ** floor(log10(min(numbers)) - 0.15), 2.0 * max(numbers))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


_LATENT_SHOWN = 2
"""Models whose latents are drawn, the first ones."""
_LATENT_LONGEST = 100
"""Ticks shown after a change."""


def latent_figure(result: dict[str, Any], path: Path) -> None:
    """A cloud for each of the first models, and the share of changes noticed so many ticks after them."""
    latent = dict(list(result["latent"].items())[:_LATENT_SHOWN])
    with figure(path, 3.6) as drawn:
        panels = drawn.subplots(1, len(latent) + 1, squeeze=False)[0]
        for axes, (name, rows) in zip(panels, latent.items(), strict=False):
            _latent_cloud(axes, rows)
            right = 100 * rows["accuracy"]["share"]
            axes.set_title(f"{MODEL_TITLES[name]}: {right:.0f} % classified correctly", **TITLE)
        _latent_noticed(panels[-1], latent)
        legend(drawn, panels[0], "left", markerscale=1.8)
        heading(drawn, "The latent by what the car tows, and how soon it follows a change")


def _latent_cloud(axes: Axes, rows: dict[str, Any]) -> None:
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


def _latent_noticed(axes: Axes, latent: dict[str, Any]) -> None:
    ticks = np.arange(_LATENT_LONGEST + 1)
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
    axes.set_title("share noticed by the latent", **TITLE, color=BLACK)
    axes.legend(fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 0.12))
    axes.tick_params(labelsize=7)
    bare(axes)


_MARGIN_KINDS = {"obstacle": "obstacle [m]", "field": "field [m]", "speed": "speed [m/s]"}


def margin_figure(result: dict[str, Any], path: Path) -> None:
    """Left the margins by kind of barrier, right the share of fresh steps that they cover."""
    models = result["margin"]["models"]
    with figure(path, 3.7) as drawn:
        left, right = drawn.subplots(1, 2)
        width = 0.84 / len(models)
        tallest = max(row["theorem"]["epsilon"] for rows in models.values() for row in rows.values())
        for place, (name, rows) in enumerate(models.items()):
            offset = (place - (len(models) - 1) / 2) * width
            _margin_bars(left, name, rows, (offset, width), 0.2 * tallest)
            _margin_coverage(right, name, rows, offset)
        for axes in (left, right):
            axes.set_xticks(range(len(_MARGIN_KINDS)), list(_MARGIN_KINDS.values()))
            axes.grid(axis="x", visible=False)
            bare(axes)
        left.set_ylim(0, 1.3 * left.get_ylim()[1])  # room for the numbers above the bars
        left.set_title("epsilon: conformal (full), theorem (frame)", **TITLE)
        right.set_title("fresh steps covered by the conformal one", **TITLE)
        right.axhline(100 * result["margin"]["coverage_wanted"], color=GREY, linestyle=":", linewidth=1.2)
        right.set_ylabel("%")
        legend(drawn, left)
        heading(drawn, "The margin of every filter, and its coverage")


def _margin_bars(axes: Axes, name: str, rows: dict[str, Any], where: tuple[float, float], room: float) -> None:
    """Bars at an offset, so wide; a number takes ``room`` within a frame, else it is left to the table."""
    (offset, width), colour = where, MODELS[name][0]
    at = [index + offset for index, kind in enumerate(_MARGIN_KINDS) if kind in rows]
    found = [rows[kind] for kind in _MARGIN_KINDS if kind in rows]
    bounds, values = ([row[margin]["epsilon"] for row in found] for margin in ("theorem", "conformal"))
    axes.bar(at, bounds, width=0.86 * width, color="white", edgecolor=colour, linewidth=1.2)
    axes.bar(at, values, width=0.86 * width, color=colour, label=MODEL_TITLES[name])
    for place, bound, value in zip(at, bounds, values, strict=True):
        for number in (max(bound, value), *([value] if bound - value > room else [])):
            axes.text(place, number, f" {number:.3f}", ha="center", va="bottom", fontsize=7, color=BLACK, rotation=90)


def _margin_coverage(axes: Axes, name: str, rows: dict[str, Any], offset: float) -> None:
    colour, _, marker = MODELS[name]
    for index, kind in enumerate(_MARGIN_KINDS):
        if kind in rows:
            row, place = rows[kind]["conformal"], index + offset
            axes.plot([place, place], [100 * end for end in row["interval_95"]], color=colour, linewidth=2)
            axes.plot(place, 100 * row["share"], marker, color=colour, markersize=6, markeredgecolor="white")


_COLUMNS: Final = 3
"""Sweeps next to each other."""
_ROWS: Final = (("safe", "no contact"), ("both", "at the goal in time,\nwithout contact"))
_APART: Final = 0.075
"""Of one curve and the next, in steps of the values, so that equal curves can be distinguished."""
_MARKERS: Final = {"safedpa": "o", "rma": "X", "rma_p": "D", "ppo": "d", "physics": "s"}
_LEAST_ROOM: Final = 11.0
"""% of the height between two names next to the curves."""


def write_figure(result: Mapping[str, Any], out: Path) -> None:
    """``car-curves.png`` in the folder ``out``."""
    curves_figure(result, out / "car-curves.png")


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


def write_recording(result: dict[str, Any], path: Path) -> None:
    """Driven and predicted paths by configuration, latents by load; nothing is written when neither was run."""
    import rerun as rr

    if "paths" not in result and "latent" not in result:
        return
    with rr.RecordingStream("safedpa_car_experiment", recording_id="safedpa_car_experiment") as stream:
        stream.save(path)
        for row in result.get("paths", []):
            folder, start = f"predictions/{row['load']}", row["driven"][FIRST_STEPS]
            driven = rr.LineStrips2D([row["driven"]], colors=_colour(BLACK), radii=0.015)
            stream.log(f"{folder}/driven", driven, static=True)
            for name, found in row["predicted"].items():
                line = rr.LineStrips2D([[start, *found["path"]]], colors=_colour(MODELS[name][0]), radii=0.01)
                stream.log(f"{folder}/{name}", line, static=True)
        for name, rows in result.get("latent", {}).items():
            for load, points in rows["points"]["by_load"].items():
                entity = f"latent/{name}/{load}"
                stream.log(entity, rr.Points2D(points, colors=_colour(LOADS[load][0]), radii=0.01), static=True)


def _colour(text: str) -> list[int]:
    return [int(text[index : index + 2], 16) for index in (1, 3, 5)]
