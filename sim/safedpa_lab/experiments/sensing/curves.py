"""Drives with a laser among people, made harder one thing at a time.

Their speed, what is reckoned with of whom no one sees, the scans' noise, age and width.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import degrees, pi
from pathlib import Path
from typing import Any, Final

import numpy as np

from safedpa_lab.experiments.common.figures import BLUE, GREY, RED, bare, figure, heading
from safedpa_lab.experiments.common.seeds import seeds_of
from safedpa_lab.experiments.common.workers import driven
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent, with_options
from safedpa_lab.experiments.report import markdown_table, page
from safedpa_lab.experiments.sensing.experiment import COUNTED, Drive, counted_cells, row_of, run_drive

CURVES: Final[Mapping[str, tuple[float, ...]]] = {
    "walking": (0.0, 0.5, 1.0, 1.5, 2.0, 3.0),
    "coming": (0.0, 0.25, 0.5, 1.0, 1.5),
    "noise": (0.0, 0.02, 0.05, 0.1, 0.2),
    "latency": (0.0, 0.05, 0.1, 0.2, 0.4),
    "field_of_view": (pi / 2, pi, 1.5 * pi, 2.0 * pi),
}
"""By what is changed, its values, in SI units. What is not changed is as in ``safedpa experiment sensing``; the filter
assumes people of 1.5 m/s and scans of known age. Below 1.5 m/s ``coming`` assumes too little."""
_TITLES: Final = {
    "walking": ("people's speed [m/s]", 1.0),
    "coming": ("reckoned with, unseen [m/s]", 1.0),
    "noise": ("noise of a range [m]", 1.0),
    "latency": ("age of a scan [s]", 1.0),
    "field_of_view": ("field of view [degrees]", degrees(1.0)),
}


def curves_experiment(
    seeds: Sequence[int],
    seconds: float,
    processes: int = 2,
    on_drive: ReportProgress = silent,
    record: Path | None = None,
    scene: str = "people",
    curves: Mapping[str, Sequence[float]] = CURVES,
) -> dict[str, Any]:
    """Every value of every curve with the same seeds; a row for each, in the order of the values.

    Next to each stand the goals of the same drives with perfect knowledge, of people of the same speed.
    """
    plain = Drive(scene, 0, seconds, 1.5, policy="way_seeker")
    points = [(name, float(value)) for name, values in curves.items() for value in values]
    changed: list[dict[str, Any]] = [{name: value} for name, value in points]
    wanted = [replace(plain, seed=seed, **change) for change in changed for seed in seeds]
    known = [replace(plain, seed=one.seed, walking=one.walking, guard="reported") for one in wanted]
    found = driven(run_drive, [*wanted, *known], processes, on_drive, record)
    rows = []
    for index, (name, value) in enumerate(points):
        first, past = index * len(seeds), (index + 1) * len(seeds)
        drives, reported = found[first:past], found[len(wanted) + first : len(wanted) + past]
        row = {"curve": name, "value": value, **row_of((scene, plain.guard), drives, reported, seconds)}
        goals = sum(one["goals"] for one in reported)
        rows.append({**row, "goals_a_minute_told_everything": 60.0 * goals / (seconds * len(seeds))})
    return {"scene": scene, "seconds": seconds, "seeds": list(seeds), "rows": rows}


def curves_page(result: Mapping[str, Any]) -> str:
    """Markdown with a table for each curve, and the command that made it."""
    seeds, tables = result["seeds"], []
    for name, (title, unit) in _TITLES.items():
        rows = [
            f"{unit * row['value']:g} | {row['drives']} | {counted_cells(row, 0.0)}"
            for row in result["rows"]
            if row["curve"] == name
        ]
        tables.append(markdown_table(f"{title} | drives | {COUNTED}", rows) if rows else "")
    return page(
        "A laser among people, made harder",
        f"Scene {result['scene']}, seeds {seeds[0]} to {seeds[-1]}, {result['seconds']:g} s each, no load. One thing "
        "at a time differs from people of 1.5 m/s, as much for whom no one sees, 0.02 m, 0.05 s and 360 degrees. A "
        "collision is the car's where it was at 0.1 m/s or more. The share is of the goals of the same drives with "
        "perfect knowledge, with its 95 %.",
        result,
        *tables,
    )


def draw_curves(result: Mapping[str, Any], path: Path) -> None:
    """Share of drives in which the car moved into something, with 95 % intervals, above goals a minute."""
    names = [name for name in _TITLES if any(row["curve"] == name for row in result["rows"])]
    most = max(max(row["goals_a_minute"], row["goals_a_minute_told_everything"]) for row in result["rows"])
    with figure(path, 4.4) as drawn:
        panels = drawn.subplots(2, len(names), sharey="row", squeeze=False)
        for column, name in enumerate(names):
            title, unit = _TITLES[name]
            rows = [row for row in result["rows"] if row["curve"] == name]
            values = [unit * row["value"] for row in rows]
            share = np.array(
                [100.0 * row["drives_in_which_the_car_moved_into_something"] / row["drives"] for row in rows]
            )
            low, high = 100.0 * np.array([row["share_95"] for row in rows]).T
            above, below = panels[0][column], panels[1][column]
            ends, dots = [share - low, high - share], {"markersize": 3.6}
            above.errorbar(values, share, ends, color=RED, marker="o", elinewidth=0.8, **dots)
            below.plot(values, [row["goals_a_minute"] for row in rows], color=BLUE, marker="o", **dots)
            known = [row["goals_a_minute_told_everything"] for row in rows]
            below.plot(values, known, color=GREY, marker=".", linewidth=0.8, **dots)
            below.set_xlabel(title, fontsize=8)
            for axes, top in ((above, 105.0), (below, 1.1 * max(most, 1.0))):
                axes.set_ylim(-0.04 * top, top)
                usual = unit * getattr(Drive("people", 0, 1.0, 1.5), name)
                axes.axvline(usual, color=GREY, linewidth=0.8, linestyle=":")
                axes.tick_params(labelsize=7.5)
                bare(axes)
        panels[0][0].set_ylabel("drives in which the car\nmoved into something [%]", fontsize=8)
        panels[1][0].set_ylabel("goals a minute", fontsize=8)
        heading(drawn, "A laser among people, made harder; dotted: as elsewhere; bars: 95 %; grey: perfect knowledge")


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment sensing-curves``."""
    found = with_options(curves_experiment, options, seeds=seeds_of(options), on_drive=report_progress)
    return {"experiment": "sensing-curves", **found}
