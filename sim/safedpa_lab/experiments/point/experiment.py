"""The paper's Safety Gym experiment: the point robot among hazards, in a force from every direction, every method.

Two tables: each filter with the margin that was calibrated for it, and SafeDPA's margin for all. Seeds are apart:
margins on calibration seeds, RMA-P's penalty and every trained policy on development seeds, what is counted on
evaluation seeds.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final, final

import click
import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.errors import InputError, did_you_mean
from safedpa.safety.margins.conformal import smallest_sample
from safedpa_lab.experiments.common.seeds import seeds_for
from safedpa_lab.experiments.common.statistics import (
    advantages,
    mean_interval,
    ratio_interval,
    seeds_interval,
    wilson_interval,
)
from safedpa_lab.experiments.common.workers import check_record, driven
from safedpa_lab.experiments.record import Options, ReportProgress, Result, named_folder, silent
from safedpa_lab.point.baseline_set import LARGEST_FORCE
from safedpa_lab.point.drivers import (
    Driven,
    Wheel,
    digest_of,
    driver_of,
    evenly,
    penalised,
    training_seeds,
    windy_task,
    with_weights,
)
from safedpa_lab.point.drivers import driven as drive
from safedpa_lab.point.margin import COVERAGE, Calibration, measured_margins
from safedpa_lab.point.methods import FILTERS, METHODS, Method
from safedpa_sim.point.task import EPISODE_STEPS

DEVELOPMENT: Final = seeds_for("development", 1, 60_000)[0]
"""The seed on which RMA-P's penalty is chosen."""
_SHOWN: Final = 4
"""Directions of which one path is kept for the pictures."""


@final
@dataclass(frozen=True)
class Work:
    """A method with its weights and margin, and the episodes; plain values, so that they can be kept in a file."""

    method: str
    """Of ``METHODS``, or one of RMA-P's grid."""
    models: str
    baselines: str
    weights: str
    """Digest of the policy's file: drives of other weights are no drives of these."""
    training_seed: int | None
    epsilon: float | None
    """m; nothing where there is no filter."""
    directions: int
    episodes: int
    """Of each direction."""
    steps: int
    force: float
    """N."""
    seed: int
    shown: bool = False
    """Whether some paths are kept."""

    @property
    def driven(self) -> Method:
        """What drives."""
        return METHODS.get(self.method) or Method(self.method, "", policy=self.method)


def account_of(work: Work) -> dict[str, Any]:
    """What became of it, with the work's own fields."""
    method, directions, episodes = work.driven, work.directions, work.episodes
    margins = {} if work.epsilon is None else {method.filter: work.epsilon}
    wheel = Wheel(Path(work.models), Path(work.baselines), margins, work.training_seed)
    task = windy_task(evenly(directions, episodes), work.force, work.seed)
    driver = driver_of(method, task, wheel)
    shown = np.arange(0, directions, max(1, directions // _SHOWN)) * episodes if work.shown else np.zeros(0, int)
    found = drive(driver, task, work.steps, shown)
    account = _account(found, directions, work.steps)
    return {**{item.name: getattr(work, item.name) for item in fields(work)}, "account": account}


def best_penalty(found: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The policy of RMA-P's grid with the highest return less cost, of what became of each on development drives."""
    rows: dict[str, Any] = {}
    for name, account in found.items():
        reward, cost = account["reward"][0], account["cost"][0]
        rows[name] = {"reward": reward, "cost": cost, "score": reward - cost, "safe": account["safe_episodes"]}
    best = max(rows, key=lambda name: float(rows[name]["score"]))
    return {"chosen": best, "seed": DEVELOPMENT, "rows": rows}


def over_seeds(accounts: dict[int, dict[str, Any]]) -> dict[str, Any]:
    """Means over training seeds of each seed's policy, with 95 % intervals over seeds (Student's t)."""
    shares = np.array([one["safe_episodes"] / one["episodes"] for one in accounts.values()])
    goals, cost = (np.array([one[name][0] for one in accounts.values()]) for name in ("goals", "cost"))
    each = {"safe": seeds_interval(shares), "goals": seeds_interval(goals), "cost": seeds_interval(cost)}
    return {"training_seeds": list(accounts), **each, "each": np.stack((shares, goals, cost), axis=1).tolist()}


def _account(found: Driven, directions: int, steps: int) -> dict[str, Any]:
    count = len(found.goals)
    safe, reached = int((found.cost == 0.0).sum()), int((found.goals > 0.0).sum())

    def by_direction(values: FloatArray) -> list[float]:
        means: list[float] = np.round(values.reshape(directions, -1).mean(axis=1), 5).tolist()
        return means

    return {
        "episodes": count,
        "safe_steps": mean_interval(1.0 - found.cost / steps),
        "safe_episodes": safe,
        "safe_episodes_interval": list(wilson_interval(safe, count)),
        "unsafe_steps": int(found.cost.sum()),
        "goals": mean_interval(found.goals),
        "reached": reached,
        "reached_interval": list(wilson_interval(reached, count)),
        "reward": mean_interval(found.reward),
        "cost": mean_interval(found.cost),
        "least_room": round(float(found.least_room.min()), 4),
        "first_goal_median": _finite(float(np.median(found.first_goal))),
        "corrected": round(found.corrected, 5),
        "relaxed": round(found.relaxed, 5),
        "milliseconds_per_episode": round(1e3 * found.processor_seconds / count, 2),
        "microseconds_per_decision": round(1e6 * found.processor_seconds / count / steps, 2),
        "directions_safe_steps": by_direction(1.0 - found.cost / steps),
        "directions_safe_episodes": by_direction((found.cost == 0.0).astype(float)),
        "directions_goals": by_direction(found.goals),
        "goals_each": found.goals.astype(int).tolist(),
        "safe": safe,
        "success": reached,
        "both": int(((found.cost == 0.0) & (found.goals > 0.0)).sum()),
        "safe_each": _flags(found.cost == 0.0),
        "success_each": _flags(found.goals > 0.0),
        "shown": found.shown,
    }


def _flags(flags: NDArray[np.bool_]) -> str:
    return "".join("1" if flag else "0" for flag in flags)


def _finite(number: float) -> float | None:
    return round(number, 2) if np.isfinite(number) else None


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
