"""A policy of the point robot goes on learning in winds while SafeDPA's filter holds; next to it the same without.

Every step of the learning is counted. Both learn from the same seed in the same layouts, and meet the same winds.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.errors import InputError, did_you_mean
from safedpa_lab.experiments.common.figures import BLACK, BLUE, GREY, RED, bare, figure, heading
from safedpa_lab.experiments.common.seeds import seeds_for
from safedpa_lab.experiments.common.statistics import seeds_interval, wilson_interval
from safedpa_lab.experiments.common.workers import check_record, driven
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent
from safedpa_lab.experiments.report import interval, markdown_table
from safedpa_lab.point.baseline_set import LARGEST_FORCE
from safedpa_lab.point.online_learning import COUNTS, STARTS, WARMING, Learning, learned

if TYPE_CHECKING:
    from matplotlib.axes import Axes


MARGIN: Final = 0.0013749980236822945
"""m; 99 % of a step of SafeDPA's filter, conformal over 400 drives, calibration seeds 1000100 and 1000101, as
``safedpa experiment point --seed 2300`` measured it."""
BEHIND: Final = {"filter": "SafeDPA's filter", "none": "no filter"}
_JUDGED: Final = 50
"""Distance between the seeds of learning and of evaluation."""
_LEAST_ROBOTS: Final = 16
"""So that an update has a whole batch."""


@final
@dataclass(frozen=True)
class PointLearning:
    """What is to be run. Raises InputError for numbers that make no experiment."""

    starts: tuple[str, ...] = ("shipped", "nothing")
    steps: int = 250_000
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of training."""
    robots: int = 64
    episodes: int = 1
    """Evaluation episodes per wind direction, before and after."""
    margin: float = MARGIN
    """m, of the filter."""
    force: float = LARGEST_FORCE
    """N."""
    seed: int = 2500
    """Of layouts, goals and winds."""
    processes: int = 1
    date: str = ""
    record: Path | None = None
    """File of finished trainings, so that an interrupted run continues."""

    def __post_init__(self) -> None:
        for name in self.starts:
            if name not in STARTS:
                raise InputError(f"--starts: '{name}': {did_you_mean(name, tuple(STARTS))}")
        for name in ("starts", "seeds"):
            given = getattr(self, name)
            if not given or len(set(given)) < len(given):
                raise InputError(f"--{name}: got {list(given)}, wanted one or more, none of them twice")
        lows = {"steps": 1, "robots": _LEAST_ROBOTS, "episodes": 1, "processes": 1, "margin": 0, "force": 0, "seed": 0}
        for name, low in lows.items():
            if not getattr(self, name) >= low:
                raise InputError(f"--{name}: got {getattr(self, name)}, wanted {low} or more")
        if max(self.seeds) >= _JUDGED or min(self.seeds) < 0:
            raise InputError(f"--seeds: got {list(self.seeds)}, wanted numbers from 0 to {_JUDGED - 1}")
        seeds_for("evaluation", _JUDGED + 1, self.seed)


def point_learning(experiment: PointLearning, report_progress: ReportProgress = silent) -> dict[str, Any]:
    """By start and by what the policy learns behind: a curve over the steps, sums over all of them, the end's drives.

    Raises InputError where a start's weights are neither in a folder nor among those that ship.
    """
    check_record(experiment.record, Learning, learned)
    work = _work(experiment)
    done = driven(learned, [one for _, _, one in work], experiment.processes, report_progress, experiment.record)
    names = ("date", "seed", "steps", "seeds", "robots", "episodes", "margin", "force")
    found: dict[str, dict[str, Any]] = {name: {} for name in experiment.starts}
    for start in experiment.starts:
        for behind in BEHIND:
            own = [one for (of, by, _), one in zip(work, done, strict=True) if (of, by) == (start, behind)]
            before = [one["judged"] for one in own if not one["rows"]]
            found[start][behind] = {
                **_account([one for one in own if one["rows"]]),
                "judged_before": before[0] if before else None,
            }
    return {
        **{name: getattr(experiment, name) for name in names},
        "evaluation_seeds": list(seeds_for("evaluation", _JUDGED + 1, experiment.seed)[::_JUDGED]),
        "starts": found,
    }


def _work(experiment: PointLearning) -> list[tuple[str, str, Learning]]:
    """Start, what is learned behind, and the learning: with and without filter one after the other, seed by seed.

    A policy that was trained before is judged as it is, too.
    """
    seeds = seeds_for("evaluation", _JUDGED + 1, experiment.seed)
    work = []
    for start in experiment.starts:
        own = Learning(
            start,
            None,
            0,
            seeds[0],
            seeds[_JUDGED],
            experiment.steps,
            experiment.robots,
            experiment.episodes,
            experiment.force,
        )
        each = [replace(own, training_seed=seed, layout_seed=seeds[seed]) for seed in experiment.seeds]
        each = [replace(own, steps=0), *each] if STARTS[start].key else each
        epsilon = {"filter": experiment.margin, "none": None}
        work += [(start, behind, replace(one, epsilon=epsilon[behind])) for one in each for behind in BEHIND]
    return work


def _account(done: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Rows of each training seed, sums of all steps, and the policies at the end with intervals over seeds."""
    steps = sum(one["rows"][-1]["steps"] for one in done)
    sums = {name: sum(row[name] for one in done for row in one["rows"]) for name in COUNTS}
    whole = round(sums["episodes"])
    goals = [one["judged"]["goals"][0] for one in done]
    return {
        "rows": {str(one["training_seed"]): one["rows"] for one in done},
        "steps": steps,
        **{name: round(value, 4) for name, value in sums.items()},
        "safe_95": list(wilson_interval(round(sums["safe_episodes"]), whole)) if whole else None,
        "judged": {str(one["training_seed"]): one["judged"] for one in done},
        "goals_at_the_end": seeds_interval(np.array(goals, dtype=np.float64)) if len(goals) > 1 else None,
    }


_QUICK = {"steps": 4096, "seeds": (0,), "robots": 16}


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment point-learning``."""
    asked = {name: value for name, value in options.items() if name not in ("quick", "out")}
    asked |= {"starts": _parts(options["starts"]), "seeds": _numbers(options["seeds"])}
    if options["margin"] is None:
        del asked["margin"]
    experiment = PointLearning(**asked | (_QUICK if options["quick"] else {}), date=time.strftime("%Y-%m-%d"))
    return point_learning(experiment, report_progress)


def _parts(given: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in given.split(",") if part.strip())


def _numbers(given: str) -> tuple[int, ...]:
    parts = _parts(given)
    if not all(part.isdecimal() for part in parts):
        raise InputError(f"--seeds: got '{given}', wanted whole numbers with commas between, as 0,1,2")
    return tuple(int(part) for part in parts)


Rows = Sequence[Mapping[str, Any]]

_COLOURS: Final = {"filter": BLUE, "none": RED}
_PANELS: Final = {"goals": "goals in 1000 steps", "unsafe": "unsafe steps in 1000"}
_PARTS: Final = 5
"""The table shows the first and the last of this many parts of the steps."""
_SMOOTHED: Final = 5
"""Rows over which a drawn curve is the mean."""


def learning_markdown(result: Mapping[str, Any]) -> str:
    """What was run, the steps of learning, and the policies before and after."""
    head = (
        f"Training seeds {_seeds(result)}, {result['robots']} robots each, wind {1e3 * result['force']:g} mN, "
        f"margin {1e3 * result['margin']:.2f} mm, seed {result['seed']} (evaluation "
        f"{' and '.join(map(str, result['evaluation_seeds']))}), {result['date']}."
    )
    parts = [head, "## While learning", driven_table(result), "## Before and after", judged_table(result)]
    return "\n\n".join(parts) + "\n"


def driven_table(result: Mapping[str, Any]) -> str:
    """All steps of the learning of all training seeds together; in the first and in the last fifth of them."""
    rows = []
    for start, behind, row in _each(result):
        goals, gained, changed = (_ends(row["rows"], name) for name in ("goals", "reward", "corrected"))
        safe = f"{row['safe_episodes']:.0f} of {row['episodes']:.0f}"
        reported = [f"{value:.1f}" for value in (*goals, *gained)]
        reported += [f"{value / 10:.1f}" if behind == "filter" else "" for value in changed]
        rows.append(
            f"{STARTS[start].title} | {BEHIND[behind]} | {row['steps']:,} | {row['unsafe']:.0f} "
            f"| {1e3 * row['unsafe'] / row['steps']:.2f} | {safe} | {' | '.join(reported)}"
        )
    return markdown_table(
        "start | behind | steps | unsafe steps | in 1000 | episodes without cost | goals in 1000 steps, first fifth "
        "| last fifth | return, first | last | changed by the filter, %, first | last",
        rows,
    )


def judged_table(result: Mapping[str, Any]) -> str:
    """Episodes without noise of the initial policy, and of the trained ones, by training seed."""
    rows = []
    for start, behind, row in _each(result):
        before = {"nothing yet": row["judged_before"]} if row["judged_before"] else {}
        for name, judged in {**before, **{f"seed {seed}": one for seed, one in row["judged"].items()}}.items():
            changed = f"{100 * judged['corrected']:.1f}" if behind == "filter" else ""
            rows.append(
                f"{STARTS[start].title} | {BEHIND[behind]} | {name} | {interval(judged['goals'])} "
                f"| {judged['safe']} of {judged['episodes']} | {judged['unsafe_steps']} | {changed}"
            )
    return markdown_table(
        "start | behind | learned | goals | episodes without cost | unsafe steps | changed by the filter, %", rows
    )


def per_thousand(rows: Rows, name: str) -> tuple[FloatArray, FloatArray]:
    """Steps at the middle of each row, and the row's count of ``name`` in 1000 steps."""
    ends = np.array([0, *(row["steps"] for row in rows)], dtype=np.float64)
    counts = np.array([row[name] for row in rows], dtype=np.float64)
    return 0.5 * (ends[:-1] + ends[1:]), 1e3 * counts / np.diff(ends)


def smoothed(values: FloatArray, over: int = _SMOOTHED) -> FloatArray:
    """The mean of each value and its neighbours, ``over`` of them where there are as many on both sides."""
    half = over // 2
    means = [values[max(0, place - half) : place + half + 1].mean() for place in range(len(values))]
    return np.array(means, dtype=np.float64)


def _seeds(result: Mapping[str, Any]) -> str:
    return ", ".join(map(str, result["seeds"]))


def _each(result: Mapping[str, Any]) -> list[tuple[str, str, Mapping[str, Any]]]:
    return [(start, behind, row) for start, found in result["starts"].items() for behind, row in found.items()]


def _ends(by_seed: Mapping[str, Rows], name: str) -> tuple[float, float]:
    """In 1000 steps, over the first and over the last fifth of each seed's rows."""
    first, last = [], []
    for rows in by_seed.values():
        each, count = per_thousand(rows, name)[1], max(1, len(rows) // _PARTS)
        first.append(each[:count].mean())
        last.append(each[-count:].mean())
    return float(np.mean(first)), float(np.mean(last))


def write_figure(result: Mapping[str, Any], out: Path) -> None:
    """``point_learning.png`` in the folder ``out``: a column per start; goals above unsafe steps."""
    starts = result["starts"]
    with figure(out / "point_learning.png", 4.9) as drawn:
        panels = drawn.subplots(2, len(starts), sharex=True, sharey="row", squeeze=False)
        for column, (start, found) in enumerate(starts.items()):
            for axes, (name, title) in zip(panels[:, column], _PANELS.items(), strict=True):
                for behind, row in found.items():
                    _curves(axes, row["rows"], name, behind)
                if STARTS[start].key:
                    axes.axvspan(0, WARMING / 1e3, color=GREY, alpha=0.12, linewidth=0)
                axes.set_ylim(bottom=-0.025 * axes.get_ylim()[1])  # so that a curve of nothing is seen whole
                bare(axes)
                if column == 0:
                    axes.set_ylabel(title)
            panels[0, column].set_title(STARTS[start].title, fontsize=9.5, color=BLACK, loc="left")
            panels[1, column].set_xlabel("thousand steps of learning")
        panels[0, 0].legend(fontsize=8.5, loc="upper left")
        heading(
            drawn,
            "A policy that goes on learning, with the filter and without",
            f"training seeds {_seeds(result)} (thin) and their mean, over {_SMOOTHED} updates; grey: only the critic "
            "learns",
        )


def _curves(axes: Axes, by_seed: Mapping[str, Rows], name: str, behind: str) -> None:
    curves = []
    for rows in by_seed.values():
        steps, values = per_thousand(rows, name)
        curves.append(smoothed(values))
        axes.plot(steps / 1e3, curves[-1], color=_COLOURS[behind], linewidth=0.8, alpha=0.4)
    axes.plot(steps / 1e3, np.mean(curves, axis=0), color=_COLOURS[behind], linewidth=2.2, label=BEHIND[behind])
