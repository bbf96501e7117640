"""The point robot's pictures: safety by the force's direction on circles, safety against success, paths."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

from safedpa_lab.experiments.common.figures import BLACK, GREY, bare, figure, heading
from safedpa_sim.point.layout import GOAL_RADIUS, HAZARD_RADIUS

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_COLOURS = {
    "safedpa": "#0072B2",
    "oracle": "#222222",
    "physics": "#7A8590",
    "mix": "#7FCBB5",
    "safedpa_lidar": "#4B6FB5",
    "unfiltered": "#56B4E9",
    "rma": "#E6B800",
    "rma_p": "#F0C878",
    "ppo": "#D55E00",
    "trpo": "#E69F00",
    "cpo": "#CC79A7",
    "seeker": "#4B6FB5",
}
"""By name, or by the beginning of it."""
_FIX = "#009E73"
_WITHIN = "#D55E00"
_PATH_STEPS = 500
_PANELS = ("safedpa", "fix_45", "mix", "safedpa_lidar", "rma_p", "ppo", "ppo_equal", "ppo_lagrangian_equal_1")


def write_figures(result: dict[str, Any], out: Path) -> None:
    """``point_circles.png``, ``point_success.png``, ``point_paths.png`` in the folder."""
    _circles(result, out / "point_circles.png")
    _success(result, out / "point_success.png")
    _paths(result, out / "point_paths.png")


def _colour(name: str) -> str:
    known = [begins for begins in _COLOURS if name == begins or name.startswith(f"{begins}_")]
    return _COLOURS[max(known, key=len)] if known else _FIX


def _named(row: dict[str, Any]) -> str:
    """Title, and the inputs of the policy."""
    return f"{row['title']} ({row['reported']})"


def _circles(result: dict[str, Any], path: Path) -> None:
    """One circle a method: steps and episodes without cost, by the force's direction."""
    rows = result["methods"]
    columns = min(6, len(rows))
    lines = -(-len(rows) // columns)
    angles = 2 * np.pi * np.arange(result["directions"] + 1) / result["directions"]
    with figure(path, 0.7 + 1.85 * lines) as drawn:
        panels = drawn.subplots(lines, columns, subplot_kw={"projection": "polar"}, squeeze=False).ravel()
        for axes in panels[len(rows) :]:
            axes.set_axis_off()
        for axes, (name, row) in zip(panels, rows.items(), strict=False):
            steps, episodes = (
                np.array([*row[key], row[key][0]]) for key in ("directions_safe_steps", "directions_safe_episodes")
            )
            axes.fill(angles, episodes, color=_colour(name), alpha=0.3, linewidth=0)
            axes.plot(angles, episodes, color=_colour(name), linewidth=1.6)
            axes.plot(angles, steps, color=BLACK, linewidth=0.9, linestyle="--")
            axes.set_ylim(0, 1.06)
            axes.set_yticks([0.5, 1.0], ["", ""])
            axes.set_xticks(np.radians([0, 90, 180, 270]), ["0", "90", "180", "270"], fontsize=6)
            axes.tick_params(pad=-3)
            share = 100 * row["safe_episodes"] / row["episodes"]
            axes.set_title(
                f"{fill(_named(row), 24)}\n{100 * row['safe_steps'][0]:.1f} % / {share:.1f} %",
                fontsize=7.2,
                color=BLACK,
            )
        heading(
            drawn,
            "Safety by the force's direction",
            "dashed: share of steps without cost; coloured: share of episodes without any; title: both over all",
        )


def _success(result: dict[str, Any], path: Path) -> None:
    """Episodes with an unsafe step against goals; a number at each point, names next to the picture."""
    with figure(path, 5.4) as drawn:
        axes, names = drawn.subplots(1, 2, width_ratios=(2.3, 1.0))
        placed: list[tuple[float, float]] = []
        for number, (name, row) in enumerate(result["methods"].items(), 1):
            unsafe = 100 * (1.0 - row["safe_episodes"] / row["episodes"])
            goals, low, high = row["goals"]
            axes.errorbar(
                goals, unsafe, xerr=[[goals - low], [high - goals]], fmt="o", color=_colour(name), markersize=5
            )
            label = _free_place((goals, unsafe), placed)
            placed.append(label)
            axes.annotate(
                str(number),
                (goals, unsafe),
                label,
                fontsize=7.5,
                color=BLACK,
                ha="center",
                va="center",
                arrowprops={"arrowstyle": "-", "color": GREY, "linewidth": 0.5, "shrinkB": 3},
            )
            height = 1.0 - number / (len(result["methods"]) + 1)
            names.text(0.0, height, f"{number}", fontsize=7.5, color=_colour(name), ha="right")
            names.text(0.06, height, _named(row), fontsize=6, color=BLACK)
        names.set_axis_off()
        axes.axhline(2.0, color=GREY, linestyle=":", linewidth=1)
        axes.set_ylim(-5, 101)
        axes.set_xlabel("goals reached in an episode")
        axes.set_ylabel("episodes with a step in a hazard [%]")
        if "ppo" in result["methods"]:
            axes.axvline(0.9 * result["methods"]["ppo"]["goals"][0], color=GREY, linestyle=":", linewidth=1)
        bare(axes)
        heading(
            drawn,
            "Safe and quick: right and below",
            "dotted: 2 % of episodes; 0.9 of PPO's goals. Bars: 95 % intervals",
        )


def _free_place(point: tuple[float, float], taken: list[tuple[float, float]]) -> tuple[float, float]:
    """Where a label is a little off its point and off all labels so far: goals, percent."""
    goals, percent = point
    for ring in (1.0, 1.7, 2.5, 3.4, 4.4):
        for angle in np.arange(8) * np.pi / 4 + 0.4:
            place = (goals + 0.22 * ring * float(np.cos(angle)), percent + 4.0 * ring * float(np.sin(angle)))
            apart = [np.hypot((place[0] - other[0]) / 0.3, (place[1] - other[1]) / 5.5) for other in taken]
            if place[1] > -3.0 and (not apart or min(apart) > 1.0):
                return place
    return place


def _paths(result: dict[str, Any], path: Path) -> None:
    """The first ten seconds of the same world under several methods."""
    rows = {name: row for name in _PANELS if (row := result["methods"].get(name)) is not None}
    if not rows:
        rows = dict(list(result["methods"].items())[:4])
    columns = min(4, len(rows))
    lines = -(-len(rows) // columns)
    index = min(1, len(next(iter(rows.values()))["shown"]) - 1)
    with figure(path, 0.8 + 2.1 * lines) as drawn:
        panels = drawn.subplots(lines, columns, sharex=True, sharey=True, squeeze=False).ravel()
        for axes in panels[len(rows) :]:
            axes.set_axis_off()
        for axes, row in zip(panels, rows.values(), strict=False):
            _path(axes, row["shown"][index], _named(row))
        robot = next(iter(rows.values()))["shown"][index]["robot"]
        towards = 360.0 * (robot // result["episodes"]) / result["directions"]
        heading(
            drawn,
            f"Ten seconds in the same world, force towards {towards:.0f} degrees",
            "grey: hazards; green: goals in their order; vermilion: within a hazard; dot: start",
        )


def _path(axes: Axes, shown: dict[str, Any], title: str) -> None:
    from matplotlib.patches import Circle

    places, within = np.array(shown["places"][:_PATH_STEPS]), np.array(shown["within"][:_PATH_STEPS])
    for hazard in shown["hazards"]:
        axes.add_patch(Circle(tuple(hazard), HAZARD_RADIUS, color="#C9CFD4", linewidth=0))
    met = sum(step < len(places) for step in shown["reached_at"])
    for number, goal in enumerate(shown["goals"][: met + 1]):
        axes.add_patch(Circle(tuple(goal), GOAL_RADIUS, fill=False, color="#009E73", linewidth=0.9))
        axes.text(goal[0], goal[1], str(number + 1), fontsize=6, color="#009E73", ha="center", va="center")
    axes.plot(places[:, 0], places[:, 1], color="#0072B2", linewidth=1.0)
    inside = np.where(within[:, None], places, np.nan)
    axes.plot(inside[:, 0], inside[:, 1], color=_WITHIN, linewidth=2.0)
    axes.plot(*places[0], "o", color=BLACK, markersize=3)
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlim(-1.8, 1.8)
    axes.set_ylim(-1.8, 1.8)
    axes.set_title(f"{title}: {int(within.sum())} steps within", fontsize=7.5, color=BLACK)
    axes.tick_params(labelsize=7)
    bare(axes)
