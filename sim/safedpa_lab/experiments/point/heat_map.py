"""The change of h that each model predicts over turn and thrust, next to the simulator's: the paper's heat map.

At moments near hazards, wind towards 135 degrees: delta h = h(next state) - h(state), h the least room to any hazard
along the stopping manoeuvre, both by the model's own belief; the reference by the simulator and the true wind.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from math import radians
from pathlib import Path
from typing import Any, Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa_lab.experiments.common.figures import BLACK, figure, heading
from safedpa_lab.experiments.record import Options, ReportProgress, Result, named_folder
from safedpa_lab.experiments.report import markdown_table
from safedpa_lab.point.beliefs import LearnedBelief, weights_named
from safedpa_lab.point.margin import Moments, drawn_moments
from safedpa_lab.point.shield import FIXED_DIRECTIONS
from safedpa_sim.point.filtering import ACTION_SCALE, minimum_barrier
from safedpa_sim.point.simulation import after_one_period

_NAMES: Final = ("safedpa", *(f"fix_{direction}" for direction in FIXED_DIRECTIONS), "mix")
_STEPS: Final = 200
"""Of the drives that the moments are drawn from."""
_CALM: Final = 1e-4
"""m: changes below it have no sign worth counting."""


@final
@dataclass(frozen=True)
class HeatMap:
    """What is to be drawn. Raises InputError for numbers that make no map."""

    folder: Path = field(default=Path())
    direction: float = 135.0
    """degrees, the wind's."""
    force: float = 0.008
    """N."""
    points: int = 21
    """Along each of turn and thrust."""
    moments: int = 60
    shown: int = 3
    seed: int = 0

    def __post_init__(self) -> None:
        if self.points < 3 or self.moments < 1 or not 0 <= self.shown <= self.moments:
            raise InputError(
                f"heat map: got {self.points} points, {self.moments} moments, {self.shown} shown; wanted 3 or more "
                "points, 1 or more moments, and no more shown than drawn"
            )


def heat_map(asked: HeatMap) -> dict[str, Any]:
    """For each model correlation and sign agreement over all moments, and the maps of those that are shown."""
    weights = weights_named("learned", asked.folder)
    drawn = drawn_moments(
        weights,
        robots=max(16, asked.moments),
        steps=_STEPS,
        seed=30_000 + asked.seed,
        force=asked.force,
        direction=radians(asked.direction),
    )
    chosen = np.random.default_rng(asked.seed).permutation(len(drawn.state))[: asked.moments]
    if len(chosen) < asked.moments:
        raise InputError(f"heat map: the drives gave {len(chosen)} moments near hazards, wanted {asked.moments}")
    moments = drawn.of(chosen)
    axis = np.linspace(-1.0, 1.0, asked.points)
    actions = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    reference = reference_changes(moments, actions)
    predicted = {name: predicted_changes(name, moments, actions, asked.folder) for name in _NAMES}
    square = (asked.shown, asked.points, asked.points)
    return {
        "direction": asked.direction,
        "force": asked.force,
        "moments": asked.moments,
        "seed": asked.seed,
        "axis": axis.tolist(),
        "agreement": {name: agreement(values, reference) for name, values in predicted.items()},
        "shown": {
            name: values[: asked.shown].reshape(square).round(6).tolist()
            for name, values in {"reference": reference, **predicted}.items()
        },
    }


def agreement(predicted: FloatArray, reference: FloatArray) -> dict[str, float]:
    """How alike two maps (moments, actions) of delta h are.

    ``correlation``: Pearson's over everything; ``rank_correlation``: Spearman's, which the few jumps of h, where the
    manoeuvre turns the other way, do not decide; ``map_correlation``: median over moments of each map's own, which a
    shift of the whole map leaves as it is; ``sign``: share of the actions of which both say that h grows, or that it
    falls, where it changes by more than 0.1 mm; ``error``: median [m].
    """
    clear = np.abs(reference) > _CALM
    own = [_correlation(one, two) for one, two in zip(predicted, reference, strict=True)]
    return {
        "correlation": _correlation(predicted.ravel(), reference.ravel()),
        "rank_correlation": _correlation(_ranks(predicted), _ranks(reference)),
        "map_correlation": float(np.median(own)),
        "sign": float((np.sign(predicted) == np.sign(reference))[clear].mean()),
        "error": float(np.median(np.abs(predicted - reference))),
    }


def _correlation(one: FloatArray, other: FloatArray) -> float:
    return float(np.corrcoef(one, other)[0, 1])


def _ranks(values: FloatArray) -> FloatArray:
    ranks: FloatArray = values.ravel().argsort().argsort().astype(np.float64)
    return ranks


def reference_changes(moments: Moments, actions: FloatArray) -> FloatArray:
    """delta h (moments, actions) as the simulator has it, for actions (actions, 2) in [-1, 1]: thrust, turn."""
    every = moments.of(np.repeat(np.arange(len(moments.state)), len(actions)))
    done = np.tile(actions, (len(moments.state), 1)) * ACTION_SCALE
    following, _ = after_one_period(every.state, done, every.rate, every.wind)
    motion = every.motion()
    change = minimum_barrier(following, every.hazards, motion) - minimum_barrier(every.state, every.hazards, motion)
    return change.reshape(len(moments.state), len(actions))


def predicted_changes(name: str, moments: Moments, actions: FloatArray, folder: Path = Path()) -> FloatArray:
    """delta h (moments, actions) by SafeDPA, with phi's latents, or by another model's name, which knows none."""
    belief = LearnedBelief(weights_named("learned" if name == "safedpa" else name, folder))
    every = moments.of(np.repeat(np.arange(len(moments.state)), len(actions)))
    believed = belief.predict(every.state, every.latent)
    following = believed.next_state(np.tile(actions, (len(moments.state), 1)))
    change = minimum_barrier(following, every.hazards, believed.motion) - minimum_barrier(
        every.state, every.hazards, believed.motion
    )
    return change.reshape(len(moments.state), len(actions))


TITLES: Final = {
    "reference": "simulator",
    "safedpa": "SafeDPA",
    "fix_135": "Fix-135",
    "mix": "Mix",
    "fix_225": "Fix-225",
    "fix_45": "Fix-45",
    "fix_315": "Fix-315",
}
"""In the order of the columns."""


def heat_map_markdown(result: dict[str, Any]) -> str:
    """One row a model."""
    points = len(result["axis"])
    rows = []
    for name, title in TITLES.items():
        if name != "reference":
            row = result["agreement"][name]
            rows.append(
                f"{title} | {row['rank_correlation']:.3f} | {row['correlation']:.3f} | {row['map_correlation']:.3f} "
                f"| {100 * row['sign']:.1f} % | {1000 * row['error']:.2f} mm"
            )
    return (
        markdown_table(
            "model | rank correlation | correlation | of a map, median | same sign | error, median",
            rows,
            above=f"{result['moments']} moments near hazards x {points} x {points} actions, force {result['force']:g} "
            f"N towards {result['direction']:g} degrees, seed {result['seed']}, {result['date']}.",
        )
        + "\n"
    )


def write_figure(result: dict[str, Any], out: Path) -> None:
    """``point_heat_map.png`` in the folder ``out``: a row per moment, a column per model, one scale."""
    shown = {name: 1000.0 * np.array(result["shown"][name]) for name in TITLES}
    rows = len(shown["reference"])
    with figure(out / "point_heat_map.png", 0.9 + 1.25 * rows) as drawn:
        panels = drawn.subplots(rows, len(TITLES), sharex=True, sharey=True, squeeze=False)
        for row, axes_of_row in enumerate(panels):
            largest = np.abs(shown["reference"][row]).max()
            for axes, (name, maps) in zip(axes_of_row, shown.items(), strict=True):
                _map(axes, maps[row], largest)
                if row == 0:
                    axes.set_title(_title(name, result), fontsize=7.5, color=BLACK)
            axes_of_row[0].set_ylabel(f"thrust\nup to {largest:.0f} mm", fontsize=7.5)
        for axes in panels[-1]:
            axes.set_xlabel("turn", fontsize=7.5)
        heading(
            drawn,
            f"What each action does to h, wind towards {result['direction']:g} degrees",
            "blue: h grows, room is gained; vermilion: it falls; black line: no change. Numbers: rank correlation with "
            f"the simulator over {result['moments']} moments",
        )


def _title(name: str, result: dict[str, Any]) -> str:
    if name == "reference":
        return "simulator\n"
    return f"{TITLES[name]}\n{result['agreement'][name]['rank_correlation']:.3f}"


def _map(axes: Any, changes: np.ndarray[Any, Any], largest: float) -> None:
    from matplotlib.colors import LinearSegmentedColormap

    colours = LinearSegmentedColormap.from_list("room", ["#D55E00", "#F4F4F4", "#0072B2"])
    axes.imshow(
        changes, origin="lower", extent=(-1, 1, -1, 1), cmap=colours, vmin=-largest, vmax=largest, aspect="auto"
    )
    if changes.min() < 0.0 < changes.max():
        axis = np.linspace(-1.0, 1.0, changes.shape[0])
        axes.contour(axis, axis, changes, levels=[0.0], colors=BLACK, linewidths=0.9)
    axes.grid(visible=False)
    axes.set_xticks([-1, 0, 1], ["-1", "0", "1"], fontsize=6)
    axes.set_yticks([-1, 0, 1], ["-1", "0", "1"], fontsize=6)


def run(options: Options, _report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment point-heat-map``."""
    named_folder("--models", options["folder"])
    asked = {name: value for name, value in options.items() if name != "out"}
    return {"date": time.strftime("%Y-%m-%d"), **heat_map(HeatMap(**asked, shown=min(3, options["moments"])))}
