"""A policy of the point robot goes on learning in winds while SafeDPA's filter holds; next to it the same without.

Every step of the learning is counted. Both learn from the same seed in the same layouts, and meet the same winds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, final

import numpy as np

from safedpa.errors import InputError, did_you_mean
from safedpa_lab.experiments.retained_drives import check_record, driven
from safedpa_lab.experiments.seeds import seeds_for
from safedpa_lab.experiments.statistics import seeds_interval, wilson_interval
from safedpa_lab.point.baseline_set import LARGEST_FORCE
from safedpa_lab.point.learning_tally import COUNTS
from safedpa_lab.point.online_learning import STARTS, Learning, learned

__all__ = ["BEHIND", "MARGIN", "PointLearning", "point_learning"]

ReportProgress = Callable[[int, int], None]

MARGIN: Final = 0.0013749980236822945
"""m; 99 % of a step of SafeDPA's filter, conformal over 400 drives, calibration seeds 1000100 and 1000101, as
``safedpa experiment point --seed 2300`` measured it."""
BEHIND: Final = {"filter": "SafeDPA's filter", "none": "no filter"}
_JUDGED: Final = 50
"""Seeds between those in which is learned and the one in which is judged."""
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
    """Of each of 24 directions of the wind, in which a policy is judged before and after."""
    margin: float = MARGIN
    """m, of the filter."""
    force: float = LARGEST_FORCE
    """N."""
    seed: int = 2500
    """Of layouts, goals and winds."""
    processes: int = 1
    date: str = ""
    record: Path | None = None
    """Where whole learnings are kept, so that an experiment goes on where it was cut off."""

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


def point_learning(
    experiment: PointLearning, report_progress: ReportProgress = lambda _done, _all: None
) -> dict[str, Any]:
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
