"""The paper's Safety Gym experiment: the point robot among hazards, in a force from every direction, every method.

Two tables: each filter with the margin that was calibrated for it, and SafeDPA's margin for all. Seeds are apart:
margins on calibration seeds, RMA-P's penalty and every trained policy on development seeds, what is counted on
evaluation seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, final

import numpy as np

from safedpa.errors import InputError
from safedpa.safety.margin import smallest_sample
from safedpa_lab.experiments.advantages import advantages
from safedpa_lab.experiments.car_workers import Workers
from safedpa_lab.experiments.point_episodes import DEVELOPMENT, Work, account_of, best_penalty, over_seeds
from safedpa_lab.experiments.seeds import seeds_for
from safedpa_lab.experiments.statistics import mean_interval, ratio_interval
from safedpa_lab.point.baseline_set import LARGEST_FORCE
from safedpa_lab.point.drivers import Wheel, training_seeds
from safedpa_lab.point.margin import COVERAGE, measured_margins
from safedpa_lab.point.methods import FILTERS, METHODS, Method
from safedpa_sim.point.task import EPISODE_STEPS

__all__ = ["TABLES", "PointExperiment", "point_experiment"]

Tell = Callable[[int, int], None]
TABLES: Final = ("own", "same")
"""Each filter's own margin; SafeDPA's for all."""
_OWN: Final = "safedpa"


@final
@dataclass(frozen=True)
class PointExperiment:
    """What is to be run. Raises InputError for numbers that make no experiment."""

    models: Path
    baselines: Path
    methods: tuple[str, ...] = tuple(METHODS)
    directions: int = 24
    episodes: int = 20
    steps: int = EPISODE_STEPS
    force: float = LARGEST_FORCE
    drives: int = 120
    """That calibrate a margin, in each of two rounds, as long as an episode at most 10 s."""
    seed: int = 0
    processes: int = 2
    date: str = ""

    def __post_init__(self) -> None:
        lows = {"directions": 1, "episodes": 1, "steps": 1, "seed": 0, "processes": 1, "force": 0}
        for name, low in {**lows, "drives": smallest_sample(COVERAGE)}.items():
            if not getattr(self, name) >= low:
                raise InputError(f"--{name}: got {getattr(self, name)}, wanted {low} or more")
        seeds_for("evaluation", 1, self.seed)

    @property
    def evaluation(self) -> int:
        """The seed of what is counted."""
        return seeds_for("evaluation", 1, self.seed)[0]


_CALIBRATING_STEPS: Final = 500


def point_experiment(experiment: PointExperiment, tell: Tell = lambda _done, _all: None) -> dict[str, Any]:
    """Drives every method through the same layouts, winds and goals.

    Raises InputError where a method's weights are neither in the folder nor among those that ship.
    """
    wheel = Wheel(experiment.models, experiment.baselines)
    margins = _margins(experiment, wheel)
    choice = _choice(experiment)
    wheel = replace(wheel, rma_p=choice["chosen"] if choice else wheel.rma_p)
    work = _everything(experiment, wheel, {name: row["epsilon"] for name, row in margins.items()})
    accounts: dict[tuple[str, str], dict[int, dict[str, Any]]] = {}
    with Workers(experiment.processes) as workers:
        done = workers.map(account_of, [item for _, item in work])
        for index, ((place, item), account) in enumerate(zip(work, done, strict=True)):
            accounts.setdefault(place, {})[item.wheel.seed or 0] = account
            tell(index + 1, len(work))
    tables = {table: _rows(accounts, table) for table in TABLES}
    names = ("date", "seed", "directions", "episodes", "steps", "force", "drives")
    told = {name: getattr(experiment, name) for name in names}
    return {
        **told,
        "evaluation_seed": experiment.evaluation,
        "margins": margins,
        "penalty": choice,
        "methods": tables["own"],
        "same_margin": tables["same"],
        "advantages": _advantages(tables, experiment.directions),
    }


def _margins(experiment: PointExperiment, wheel: Wheel) -> dict[str, dict[str, Any]]:
    """Of the filters that the methods have, and SafeDPA's, which the second table gives to all."""
    used = {METHODS[name].filter for name in experiment.methods} - {""}
    if not used:
        return {}
    filters = [name for name in FILTERS if name in used | {_OWN}]
    steps = min(_CALIBRATING_STEPS, experiment.steps)
    return measured_margins(filters, wheel, experiment.drives, steps, experiment.force)


def _choice(experiment: PointExperiment) -> dict[str, Any]:
    if "rma_p" not in experiment.methods:
        return {}
    return best_penalty(experiment.models, replace(_work(experiment, METHODS["rma_p"], Wheel()), seed=DEVELOPMENT))


def _everything(
    experiment: PointExperiment, wheel: Wheel, epsilon: Mapping[str, float]
) -> list[tuple[tuple[str, str], Work]]:
    """By table and method: who has no filter, or SafeDPA's, stands in the first table alone."""
    same = dict.fromkeys(epsilon, epsilon.get(_OWN, 0.0))
    work = []
    for table, margins in zip(TABLES, (epsilon, same), strict=True):
        for name in experiment.methods:
            method = METHODS[name]
            if table == "same" and method.filter in ("", _OWN):
                continue
            for seed in training_seeds(method, experiment.baselines):
                own = replace(wheel, margins=margins, seed=seed)
                first = seed is None or seed == training_seeds(method, experiment.baselines)[0]
                work.append(((table, name), _work(experiment, method, own, table == "own" and first)))
    return work


def _work(experiment: PointExperiment, method: Method, wheel: Wheel, shown: bool = False) -> Work:
    directions, episodes = experiment.directions, experiment.episodes
    return Work(method, wheel, directions, episodes, experiment.steps, experiment.force, experiment.evaluation, shown)


def _rows(accounts: Mapping[tuple[str, str], dict[int, dict[str, Any]]], table: str) -> dict[str, Any]:
    """By method the account of its first training seed, and what all seeds came to where there are several.

    Who has SafeDPA's filter stands in both tables with the same figures.
    """
    rows = {}
    for (found_in, name), by_seed in accounts.items():
        shared = table == "same" and METHODS[name].filter == _OWN and name == _OWN
        if found_in == table or shared:
            row = dict(next(iter(by_seed.values())))
            if len(by_seed) > 1:
                row["over_seeds"] = over_seeds(by_seed)
            rows[name] = row
    _beside(rows, "ppo", "of_ppo")
    return rows


def _beside(rows: dict[str, Any], other: str, key: str) -> None:
    """Goals over another's in the same episodes."""
    if other in rows and any(rows[other]["goals_each"]):
        beside = np.array(rows[other]["goals_each"], dtype=np.float64)
        for row in rows.values():
            row[key] = ratio_interval(np.array(row["goals_each"], dtype=np.float64), beside)


def _advantages(tables: Mapping[str, Mapping[str, Any]], directions: int) -> list[dict[str, Any]]:
    """SafeDPA against each: exact tests of who was safe and who reached a goal, and the difference in goals."""
    if _OWN not in tables["own"]:
        return []
    own = np.array(tables["own"][_OWN]["goals_each"], dtype=np.float64)
    rows = advantages({name: table for name, table in tables.items() if len(table) > 1}, directions)
    for row in rows:
        other = tables[row["question"]][row["against"]]["goals_each"]
        row["goals"] = mean_interval(own - np.array(other, dtype=np.float64))
    return rows
