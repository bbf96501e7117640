"""The paper's pendulum experiments: both questions, every method, every wind direction; and what stands behind them.

Two tables: each filter with the margin that was calibrated for it, and SafeDPA's margin for all. Then both questions
made harder. Seeds are apart: margins on calibration seeds, RMA-P's penalty on a development seed, what
is counted on evaluation seeds.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any, Final, final

import numpy as np

from safedpa.errors import InputError
from safedpa.safety.margins.conformal import smallest_sample
from safedpa_lab.experiments.common.seeds import seeds_for
from safedpa_lab.experiments.common.statistics import advantages
from safedpa_lab.experiments.common.workers import Workers
from safedpa_lab.experiments.pendulum.episodes import QUESTIONS, Choice, Sweeps, Work, accounts, best_penalty, swept
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent
from safedpa_lab.pendulum.difficulty import AXES, Axis, Difficulty, Episodes
from safedpa_lab.pendulum.invariance import largest_wind, least_reserve
from safedpa_lab.pendulum.margin import COVERAGE, measured_margins
from safedpa_lab.pendulum.methods import BALANCING_METHODS, FILTERED, HAZARD_METHODS
from safedpa_lab.pendulum.questions import balanced
from safedpa_lab.pendulum.recovery import recovery, swung_all_around
from safedpa_sim.pendulum.task import AHEAD, BALANCING, HAZARD, LONG_WAY_ROUND, TORQUE, WIND

_FITTED = 5
"""Episodes of each direction whose histories are fitted."""
TABLES: Final = ("own", "same")
"""Each filter's own margin; SafeDPA's for all."""
_METHODS: Final = {1: BALANCING_METHODS, 2: HAZARD_METHODS}


@final
@dataclass(frozen=True)
class PendulumExperiment:
    """What is to be run. Raises InputError for numbers that make no experiment."""

    models: Path
    directions: int = 48
    episodes: int = 5
    sweep_episodes: int = 1
    """Of each direction at each difficulty; 0: no sweeps."""
    drives: int = 120
    """Of each question that calibrate a margin, in each of two rounds."""
    seed: int = 0
    processes: int = 1
    date: str = ""
    axes: tuple[Axis, ...] = AXES

    def __post_init__(self) -> None:
        least = -(-smallest_sample(COVERAGE) // len(QUESTIONS))
        lows = {"directions": 4, "episodes": 1, "sweep_episodes": 0, "drives": least, "seed": 0, "processes": 1}
        for name, low in lows.items():
            if getattr(self, name) < low:
                raise InputError(f"--{name.replace('_', '-')}: got {getattr(self, name)}, wanted {low} or more")
        seeds_for("evaluation", 1, self.seed)

    @property
    def evaluation(self) -> Episodes:
        """What the tables count."""
        return Episodes(seeds_for("evaluation", 1, self.seed)[0], self.directions, self.episodes)


def pendulum_experiment(experiment: PendulumExperiment, report_progress: ReportProgress = silent) -> dict[str, Any]:
    """Runs both questions for every method; the same winds, starts and draws for each."""
    more = _count(experiment, report_progress)
    with Workers(experiment.processes) as workers:
        margins = measured_margins(FILTERED, experiment.models, experiment.drives)
        epsilon = {name: margin["epsilon"] for name, margin in margins.items()}
        tables = _tables(experiment, epsilon, workers, more)
        choice = best_penalty(Choice(experiment.models, experiment.directions, experiment.episodes, Difficulty()))
        sweeps = _sweeps(experiment, _of_each(epsilon), workers, more)
    return {
        "date": experiment.date,
        "seed": experiment.seed,
        "evaluation_seed": experiment.evaluation.seed,
        "directions": experiment.directions,
        "episodes": experiment.episodes,
        "sweep_episodes": experiment.sweep_episodes,
        "assumed": _assumed(),
        "margins": margins,
        "invariance": _invariance(epsilon["safedpa"]),
        "latent": _latent(experiment, epsilon["safedpa"]),
        "penalty": choice,
        "tables": tables,
        "advantages": {name: advantages(table, experiment.directions) for name, table in tables.items()},
        "sweeps": sweeps,
    }


def _count(experiment: PendulumExperiment, report_progress: ReportProgress) -> Callable[[], None]:
    """To be called after each set of episodes."""
    everyone = [method for methods in _METHODS.values() for method in methods]
    filtered = sum(bool(method.filter) for method in everyone)
    sweeps = Sweeps(experiment.models, 1, 1, 0, {}, experiment.axes).size if experiment.sweep_episodes else 0
    total, done = len(everyone) + (len(TABLES) - 1) * filtered + sweeps, count(1)
    return lambda: report_progress(next(done), total)


def _of_each(epsilon: Mapping[str, float]) -> dict[str, float]:
    """The own margin of every method with a filter, by method: that of the model of its filter."""
    by_filter = {method.filter: epsilon[method.name] for method in FILTERED}
    return {method.name: by_filter.get(method.filter, 0.0) for methods in _METHODS.values() for method in methods}


def _tables(
    experiment: PendulumExperiment, epsilon: Mapping[str, float], workers: Workers, more: Callable[[], None]
) -> dict[str, Any]:
    """Counts by table, task and method. Methods without a filter are in the first table only."""
    margins = {"own": _of_each(epsilon), "same": dict.fromkeys(_of_each(epsilon), epsilon["safedpa"])}
    work = [
        (
            (table, question, method.name),
            Work(question, method, margin[method.name], experiment.evaluation, experiment.models, table == "own"),
        )
        for table, margin in margins.items()
        for question, methods in _METHODS.items()
        for method in methods
        if method.filter or table == "own"
    ]
    found: dict[str, Any] = {table: {name: {} for name in QUESTIONS.values()} for table in TABLES}
    for ((table, question, name), _), account in zip(work, accounts((item for _, item in work), workers), strict=True):
        for outcome in ("safe_each", "success_each"):
            if outcome in account:
                account[outcome] = "".join(str(flag) for flag in account[outcome])
        found[table][QUESTIONS[question]][name] = account
        more()
    return found


def _sweeps(
    experiment: PendulumExperiment, margins: Mapping[str, float], workers: Workers, more: Callable[[], None]
) -> dict[str, Any]:
    if not experiment.sweep_episodes:
        return {}
    asked = Sweeps(
        experiment.models,
        experiment.directions,
        experiment.sweep_episodes,
        experiment.evaluation.seed,
        margins,
        experiment.axes,
    )
    return swept(asked, workers, more)


def _latent(experiment: PendulumExperiment, epsilon: float) -> dict[str, Any]:
    """How well the latent identifies the wind, while balancing and in full swings, and how well it could."""
    some = replace(experiment.evaluation, episodes=min(experiment.episodes, _FITTED))
    made = {
        "around": swung_all_around(experiment.models, some),
        "balancing": balanced(FILTERED[0], experiment.models, epsilon, some),
    }
    return {name: recovery(swings, experiment.models, some.directions, some.seed) for name, swings in made.items()}


def _invariance(epsilon: float) -> dict[str, Any]:
    winds = np.linspace(0.0, 6.0, 25)
    edges = {"balancing": BALANCING, "hazard": LONG_WAY_ROUND}
    rows = {
        name: [least_reserve(float(wind), own, epsilon=epsilon).torque for wind in winds] for name, own in edges.items()
    }
    largest = {name: largest_wind(own, epsilon=epsilon) for name, own in edges.items()}
    without = {name: largest_wind(own) for name, own in edges.items()}
    return {"winds": winds.tolist(), "reserve": rows, "largest_wind": largest, "without_margin": without}


def _assumed() -> dict[str, Any]:
    return {
        "torque_bound": TORQUE,
        "wind": WIND,
        "time_ahead": AHEAD,
        "eta": 0.5,
        "balancing_edges": list(BALANCING),
        "hazard": list(HAZARD),
    }


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment pendulum``."""
    asked = {name: value for name, value in options.items() if name != "out"}
    return pendulum_experiment(PendulumExperiment(**asked, date=time.strftime("%Y-%m-%d")), report_progress)
