"""The pendulum experiment's pictures: safety by wind direction, phase portraits, the reserve of torque, the latent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from safedpa_lab.experiments.common.figures import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    bare,
    figure,
    heading,
)
from safedpa_lab.experiments.common.statistics import wilson_interval
from safedpa_lab.experiments.pendulum.report import calibration_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_SAFE, _UNSAFE, _STUCK = "#0072B2", "#D55E00", "#7A8590"
_COLOURS = {"safedpa": "#0072B2", "mix": "#CC79A7", "oracle": "#222222"}
_FIX = "#009E73"


def write_figures(result: dict[str, Any], out: Path) -> None:
    """Five PNGs in the folder ``out``, four without sweeps; and the learned model's ``margin.toml``."""
    calibration_of(result).save(out / "margin.toml")
    _directions(result, out / "pendulum_balancing.png")
    _portraits(result, out / "pendulum_hazard.png")
    _reserve(result, out / "pendulum_invariance.png")
    _latent(result, out / "pendulum_latent.png")
    if result["sweeps"]:
        draw_sweeps(result, out / "pendulum_sweeps.png")


def _directions(result: dict[str, Any], path: Path) -> None:
    """A row a question, one small circle a filter: the share of good episodes by the direction of the wind."""
    own, count = result["tables"]["own"], result["directions"]
    angles = 2 * np.pi * np.arange(count + 1) / count
    names = [name for name in result["margins"] if name in own["hazard"]]
    with figure(path, 3.9) as drawn:
        panels = drawn.subplots(2, len(names), subplot_kw={"projection": "polar"}, squeeze=False)
        for line, question in zip(panels, ("balancing", "hazard"), strict=True):
            for axes, name in zip(line, names, strict=True):
                rate = _good(own[question][name], count)
                colour = _COLOURS.get(name, _FIX)
                axes.fill(angles, np.append(rate, rate[0]), color=colour, alpha=0.25)
                axes.plot(angles, np.append(rate, rate[0]), color=colour, linewidth=1.8)
                axes.set_ylim(0, 1.05)
                axes.set_yticks([0.5, 1.0], ["", ""])
                axes.set_xticks(np.radians([0, 90, 180, 270]), ["0", "90", "180", "270"], fontsize=6)
                axes.tick_params(pad=-3)
                title = f"{own[question][name]['title']}\n{100 * rate.mean():.1f} %"
                axes.set_title(title, fontsize=8.5, fontweight="bold", color=BLACK)
        heading(
            drawn,
            "Each filter with its own margin: good episodes by wind direction",
            "above: random torques, within 45 degrees; below: upright past the hazard and never in it. "
            "Angle: where the wind blows to, 0 sideways, 90 up",
        )


def _good(row: dict[str, Any], directions: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """(directions,) share of safe episodes, and of safe and upright ones in the second task."""
    flags = np.array([one == "1" for one in row["safe_each"]])
    if "success_each" in row:
        flags &= np.array([one == "1" for one in row["success_each"]])
    return np.asarray(flags.reshape(directions, -1).mean(1), dtype=np.float64)


def _portraits(result: dict[str, Any], path: Path) -> None:
    """One phase plane a method; a swing is blue when it ended upright and safe."""
    rows = result["tables"]["own"]["hazard"]
    columns = 5
    with figure(path, 6.4) as drawn:
        panels = drawn.subplots(-(-len(rows) // columns), columns, sharex=True, sharey=True, squeeze=False)
        for axes in panels.flat[len(rows) :]:
            axes.set_axis_off()
        for axes, row in zip(panels.flat, rows.values(), strict=False):
            _portrait(axes, row, result["assumed"]["hazard"])
        for axes in panels[-1]:
            axes.set_xlabel("angle [deg]", fontsize=8)
        for axes in panels[:, 0]:
            axes.set_ylabel("rate [rad/s]", fontsize=8)
        heading(
            drawn,
            "Upright the long way round, past the hazard",
            "blue: upright, never in the hazard; vermilion: entered the hazard (grey band); grey: safe, not upright",
        )


def _portrait(axes: Axes, row: dict[str, Any], hazard: list[float]) -> None:
    low, high = (np.degrees(edge) for edge in hazard)
    for turn in (0.0, 360.0):
        axes.axvspan(low + turn, high + turn, color="#D9DDE1", linewidth=0)
    for states in row["shown"]:
        angle, rate = np.degrees(np.array(states)[:, 0]), np.array(states)[:, 1]
        entered = ((np.mod(angle, 360.0) > low) & (np.mod(angle, 360.0) < high)).any()
        upright = abs((angle[-1] + 180.0) % 360.0 - 180.0) < 5.0
        colour = _UNSAFE if entered else _SAFE if upright else _STUCK
        axes.plot(angle, rate, color=colour, linewidth=1.0, alpha=0.85)
    for upright in (0.0, 360.0):
        axes.axvline(upright, color=GREY, linewidth=0.8, linestyle=":")
    axes.set_xlim(-25, 425)
    axes.set_ylim(-6, 12)
    axes.set_xticks([0, 180, 360])
    count = row["episodes"]
    share = f"upright {100 * row['success'] / count:.0f} %, safe {100 * row['safe'] / count:.0f} %"
    axes.set_title(f"{row['title']}\n{share}", fontsize=6.8)
    axes.tick_params(labelsize=7)
    bare(axes)


def _reserve(result: dict[str, Any], path: Path) -> None:
    """The torque that is left at the worst state of the whole set, over the wind."""
    found = result["invariance"]
    looks = {"balancing": (_SAFE, "-", "within 45 degrees"), "hazard": (_UNSAFE, "--", "the long way round")}
    with figure(path, 3.0) as drawn:
        axes = drawn.subplots()
        axes.axhline(0.0, color=BLACK, linewidth=0.8)
        for name, (colour, line, title) in looks.items():
            axes.plot(found["winds"], found["reserve"][name], line, color=colour, linewidth=2)
            largest = found["largest_wind"][name]
            axes.plot(largest, 0.0, "o", color=colour, markeredgecolor="white", label=f"{title}: to {largest:.2f} m/s")
        axes.axvline(result["assumed"]["wind"], color=GREY, linestyle=":")
        axes.text(
            result["assumed"]["wind"], axes.get_ylim()[1], " the experiments' wind", color=GREY, fontsize=8, va="top"
        )
        axes.set_xlabel("wind [m/s], worst direction")
        axes.set_ylabel("least torque left [N m]")
        axes.legend(fontsize=8.5, loc="lower left")
        bare(axes)
        heading(drawn, "The corridor can be kept from every state of it, up to this wind")


def _latent(result: dict[str, Any], path: Path) -> None:
    """The latents at the ends of episodes, coloured by the wind's direction: swings all around, and balancing."""
    looks = (
        ("around", "latents", "", "swings all around: phi alone"),
        ("around", "refined", "refined_", "the same, refined by f and g"),
        ("balancing", "latents", "", "within 45 degrees: phi alone"),
    )
    with figure(path, 3.9) as drawn:
        panels = drawn.subplots(1, 3, sharex=True, sharey=True)
        for axes, (name, points, prefix, title) in zip(panels, looks, strict=True):
            latent = result["latent"][name]
            ends, directions = np.array(latent[points]), np.array(latent["directions"])
            dots = axes.scatter(ends[:, 0], ends[:, 1], c=directions, cmap="twilight", vmin=0, vmax=360, s=8)
            axes.set_aspect("equal", adjustable="box")
            axes.set_xlim(-2.4, 2.4)
            axes.set_ylim(-2.4, 2.4)
            axes.set_xlabel("first entry of the latent", fontsize=8)
            median, most = latent[f"{prefix}median_degrees"], latent[f"{prefix}90_degrees"]
            axes.set_title(f"{title}\noff by {median:.0f} degrees, {most:.0f} in 90 %", fontsize=8.5, color=BLACK)
            bare(axes)
        panels[0].set_ylabel("second", fontsize=8)
        bar = drawn.colorbar(dots, ax=panels, ticks=[0, 90, 180, 270, 360], fraction=0.02)
        bar.set_label("true wind direction [deg]", fontsize=8)
        heading(drawn, "A wind of 4 m/s as its latent: mu(e) draws a circle")


_LOOKS: Final = {
    "oracle": ("knows the wind", BLACK, "s"),
    "safedpa": ("SafeDPA", BLUE, "o"),
    "goal_seeker": ("goal seeker, SafeDPA's filter", SKY, "P"),
    "mix": ("Mix", PURPLE, "v"),
    "fix": ("Fix (all four)", GREEN, "^"),
    "rma_p": ("RMA-P, best beta", ORANGE, "D"),
    "rma": ("RMA", RED, "X"),
    "ppo": ("PPO", GREY, "d"),
}
"""Title, colour and marker; from above to below where curves would coincide."""
_ROWS: Final = (
    ("balancing", "safe", "within the edges:\nsafe"),
    ("hazard", "safe", "past the hazard:\nsafe"),
    ("hazard", "both", "past the hazard:\nupright and safe"),
)
_COLUMNS: Final = (("wind", "wind"), ("torque", "torque"), ("corridor", "hazard"), ("noise", "noise"))
"""The axis of the first question and that of the second."""
_APART: Final = (0.09, 1.7)
"""Of one curve and the next: steps to the right, per cent downwards."""


def draw_sweeps(result: Mapping[str, Any], path: Path) -> None:
    """Shares with 95 % intervals over episodes."""
    sweeps = result["sweeps"]
    with figure(path, 6.6) as drawn:
        panels = drawn.subplots(len(_ROWS), len(_COLUMNS), sharey=True, squeeze=False)
        handles: dict[str, Any] = {}
        for line, (question, outcome, title) in zip(panels, _ROWS, strict=True):
            line[0].set_ylabel(title, fontsize=8.5)
            for axes, names in zip(line, _COLUMNS, strict=True):
                axis = sweeps.get(names[0 if question == "balancing" else 1])
                if axis is None:
                    axes.set_axis_off()
                else:
                    handles |= _panel(axes, axis, _pooled(axis[question]), outcome)
        ordered = [name for name in _LOOKS if name in handles]
        titles = [_LOOKS[name][0] for name in ordered]
        shapes = [handles[name] for name in ordered]
        drawn.legend(
            shapes,
            titles,
            loc="outside lower center",
            ncols=4,
            fontsize=8.5,
            title="bars: 95 % over episodes; curves stand a little apart, so that equal ones can be seen",
            title_fontsize=8,
        )
        heading(drawn, "Harder from left to right: where each method breaks")


def _pooled(rows: Mapping[str, Any]) -> dict[str, Any]:
    """With the four Fix as one, their episodes added up."""
    fixed = [row for name, row in rows.items() if name.startswith("fix_")]
    found = {name: dict(row) for name, row in rows.items() if not name.startswith("fix_")}
    if fixed:
        found["fix"] = {"episodes": sum(row["episodes"] for row in fixed)}
        for outcome in ("safe", "both"):
            if outcome in fixed[0]:
                found["fix"][outcome] = np.sum([row[outcome] for row in fixed], axis=0).tolist()
    return found


def _panel(axes: Axes, axis: Mapping[str, Any], rows: Mapping[str, Any], outcome: str) -> dict[str, Any]:
    """Each curve a little to the right of and below the one before, so that equal curves can be distinguished."""
    places = np.arange(len(axis["shown"]), dtype=np.float64)
    present = [name for name in _LOOKS if name in rows]
    handles = {}
    for index, name in enumerate(present):
        _, colour, marker = _LOOKS[name]
        away = index - 0.5 * (len(present) - 1)
        low, share, high = _curve(rows[name][outcome], rows[name]["episodes"])
        middle = share - _APART[1] * away
        handles[name] = axes.errorbar(
            places + _APART[0] * away,
            middle,
            np.maximum(0.0, [share - low, high - share]),
            color=colour,
            marker=marker,
            markersize=3.6,
            linewidth=1.1,
            elinewidth=0.7,
        )
    axes.set_xticks(places, [f"{value:g}" for value in axis["shown"]])
    axes.set_xlim(-0.5, len(places) - 0.5)
    axes.set_ylim(-12, 112)
    axes.set_yticks([0, 50, 100], ["0 %", "50 %", "100 %"])
    axes.set_xlabel(axis["label"], fontsize=8)
    axes.tick_params(labelsize=7.5)
    bare(axes)
    return handles


def _curve(hits: Sequence[int], episodes: int) -> tuple[Any, Any, Any]:
    """Lower end, share and upper end [%]."""
    ends = np.array([wilson_interval(count, episodes) for count in hits])
    return 100.0 * ends[:, 0], 100.0 * np.array(hits) / episodes, 100.0 * ends[:, 1]
