"""The paper's Safety Gym experiment: the point robot among hazards, in a force from every direction, every method.

Two tables: each filter with the margin that was calibrated for it, and SafeDPA's margin for all. Seeds are apart:
margins on calibration seeds, RMA-P's penalty and every trained policy on development seeds, what is counted on
evaluation seeds.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, final

import click
import numpy as np

from safedpa.errors import InputError, did_you_mean
from safedpa.safety.margins.conformal import smallest_sample
from safedpa_lab.experiments.common.seeds import seeds_for
from safedpa_lab.experiments.common.statistics import advantages, mean_interval, ratio_interval
from safedpa_lab.experiments.common.workers import check_record, driven
from safedpa_lab.experiments.point.episodes import DEVELOPMENT, Work, account_of, best_penalty, over_seeds
from safedpa_lab.experiments.record import Options, ReportProgress, Result, named_folder, silent
from safedpa_lab.point.baseline_set import LARGEST_FORCE
from safedpa_lab.point.drivers import Wheel, digest_of, penalised, training_seeds, with_weights
from safedpa_lab.point.margin import COVERAGE, Calibration, measured_margins
from safedpa_lab.point.methods import FILTERS, METHODS
from safedpa_sim.point.task import EPISODE_STEPS

__all__ = ["TABLES", "PointExperiment", "point_experiment", "run"]

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
    drives: int = 400
    """That calibrate a margin, in each of two rounds; with hardly more than 99 the largest error of all would be it."""
    seed: int = 0
    processes: int = 2
    date: str = ""
    record: Path | None = None
    """File of finished drives, so that an interrupted run continues."""

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


_CALIBRATING_STEPS: Final = 250
"""Of each drive that calibrates a margin, where episodes are no shorter."""


def point_experiment(experiment: PointExperiment, report_progress: ReportProgress = silent) -> dict[str, Any]:
    """Drives every method through the same layouts, winds and goals.

    Raises InputError where a method's weights are neither in the folder nor among those that ship.
    """
    check_record(experiment.record, Work, account_of)
    margins = _margins(experiment)
    choice = _choice(experiment)
    work = _everything(experiment, {name: row["epsilon"] for name, row in margins.items()}, choice)
    done = driven(account_of, list(work), experiment.processes, report_progress, experiment.record)
    accounts: dict[tuple[str, str], dict[int, dict[str, Any]]] = {}
    for (item, places), outcome in zip(work.items(), done, strict=True):
        for table, name in places:
            accounts.setdefault((table, name), {})[item.training_seed or 0] = _row(name, item, outcome["account"])
    tables = {table: _rows(accounts, table) for table in TABLES}
    _alongside_ppo(tables)
    names = ("date", "seed", "directions", "episodes", "steps", "force", "drives")
    reported = {name: getattr(experiment, name) for name in names}
    return {
        **reported,
        "evaluation_seed": experiment.evaluation,
        "margins": margins,
        "penalty": choice,
        "methods": tables["own"],
        "same_margin": tables["same"],
        "advantages": _advantages(tables, experiment.directions),
    }


def _margins(experiment: PointExperiment) -> dict[str, dict[str, Any]]:
    """Of the filters that the methods have, and SafeDPA's, which the second table gives to all."""
    used = {METHODS[name].filter for name in experiment.methods} - {""}
    if not used:
        return {}
    filters = ",".join(name for name in FILTERS if name in used | {_OWN})
    steps = min(_CALIBRATING_STEPS, experiment.steps)
    asked = Calibration(filters, str(experiment.models), experiment.drives, steps, experiment.force)
    record = experiment.record and experiment.record.with_suffix(".margins.jsonl")
    found: dict[str, dict[str, Any]] = driven(measured_margins, [asked], 1, record=record)[0]["margins"]
    return found


def _choice(experiment: PointExperiment) -> dict[str, Any]:
    """RMA-P's penalty by development drives, as many as are counted."""
    names = penalised(experiment.models) if "rma_p" in experiment.methods else ()
    if not names:
        return {}
    work = [replace(_work(experiment, name, None, None), seed=DEVELOPMENT) for name in names]
    done = driven(account_of, work, experiment.processes, record=experiment.record)
    found = best_penalty({name: one["account"] for name, one in zip(names, done, strict=True)})
    return {**found, "episodes": experiment.directions * experiment.episodes}


def _everything(
    experiment: PointExperiment, epsilon: Mapping[str, float], choice: Mapping[str, Any]
) -> dict[Work, list[tuple[str, str]]]:
    """What is to be driven, each with the tables and methods that it is counted for.

    Who has no filter, or SafeDPA's, stands in the first table alone; SafeDPA itself in both, with the same drives.
    """
    work: dict[Work, list[tuple[str, str]]] = {}
    for name in experiment.methods:
        method = METHODS[name]
        driven_as = choice["chosen"] if name == "rma_p" and choice else name
        for seed in training_seeds(method, experiment.baselines):
            own = _work(experiment, driven_as, seed, epsilon.get(method.filter))
            work.setdefault(own, []).append(("own", name))
            if name == _OWN:
                work[own].append(("same", name))
            elif method.filter not in ("", _OWN):
                work.setdefault(replace(own, epsilon=epsilon[_OWN]), []).append(("same", name))
    return work


def _work(experiment: PointExperiment, name: str, seed: int | None, epsilon: float | None) -> Work:
    models, baselines = str(experiment.models), str(experiment.baselines)
    plain = Work(
        name,
        models,
        baselines,
        "",
        seed,
        epsilon,
        experiment.directions,
        experiment.episodes,
        experiment.steps,
        experiment.force,
        experiment.evaluation,
        shown=True,
    )
    wheel = Wheel(experiment.models, experiment.baselines, seed=seed)
    return replace(plain, weights=digest_of(plain.driven, wheel))


def _row(name: str, work: Work, account: Mapping[str, Any]) -> dict[str, Any]:
    method = METHODS[name]
    reported = {"title": method.title, "reported": method.reported, "filter": method.filter, "epsilon": work.epsilon}
    return {**reported, **account}


def _rows(accounts: Mapping[tuple[str, str], dict[int, dict[str, Any]]], table: str) -> dict[str, Any]:
    """By method the results of its first training seed, and the means over several seeds."""
    rows = {}
    for (found_in, name), by_seed in accounts.items():
        if found_in == table:
            row = dict(next(iter(by_seed.values())))
            if len(by_seed) > 1:
                row["over_seeds"] = over_seeds(by_seed)
            rows[name] = row
    return rows


def _alongside_ppo(tables: Mapping[str, Mapping[str, Any]]) -> None:
    """Goals over PPO's, with the benchmark's inputs, in the same episodes; in both tables."""
    ppo = np.array(tables["own"].get("ppo", {}).get("goals_each", ()), dtype=np.float64)
    if ppo.any():
        for row in (row for table in tables.values() for row in table.values()):
            row["of_ppo"] = ratio_interval(np.array(row["goals_each"], dtype=np.float64), ppo)


def _advantages(tables: Mapping[str, Mapping[str, Any]], directions: int) -> list[dict[str, Any]]:
    """SafeDPA against each method: exact tests of safety and goals reached, and the difference in goals."""
    if _OWN not in tables["own"]:
        return []
    own = np.array(tables["own"][_OWN]["goals_each"], dtype=np.float64)
    rows = advantages({name: table for name, table in tables.items() if len(table) > 1}, directions)
    for row in rows:
        other = tables[row["question"]][row["against"]]["goals_each"]
        row["goals"] = mean_interval(own - np.array(other, dtype=np.float64))
    return rows


_MODELS, _BASELINES = Path("learned/point"), Path("learned/point_baselines")
_QUICK = {"directions": 8, "episodes": 4, "steps": 500}


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment point``."""
    named_folder("--models", options["models"], _MODELS)
    named_folder("--baselines", options["baselines"], _BASELINES)
    asked = {name: value for name, value in options.items() if name not in ("quick", "out")}
    if options["methods"] is None:
        asked["methods"] = _trained(options["models"], options["baselines"])
    else:
        asked["methods"] = _named(options["methods"])
    experiment = PointExperiment(**asked | (_QUICK if options["quick"] else {}), date=time.strftime("%Y-%m-%d"))
    return point_experiment(experiment, report_progress)


def _trained(models: Path, baselines: Path) -> tuple[str, ...]:
    """All methods with weights; prints a warning for each of the others."""
    names = with_weights(models, baselines)
    for name in METHODS:
        if name not in names:
            click.echo(f"warning: {name}: left out, there are no weights of it", err=True)
    return names


def _named(methods: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in methods.split(",") if name.strip())
    for name in names or ("",):
        if name not in METHODS:
            raise InputError(f"--methods: '{name}': {did_you_mean(name, tuple(METHODS))}")
    return names
