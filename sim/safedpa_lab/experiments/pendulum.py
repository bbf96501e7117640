"""The paper's pendulum experiments: both questions, every method, every wind direction; and what stands behind them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np

from safedpa.errors import InputError
from safedpa_lab.experiments.car_workers import Workers
from safedpa_lab.experiments.statistics import wilson_interval
from safedpa_lab.pendulum.balancing import balanced, balanced_account
from safedpa_lab.pendulum.crossing import crossed, crossed_account
from safedpa_lab.pendulum.invariance import largest_wind, least_reserve
from safedpa_lab.pendulum.margin import measured_margin
from safedpa_lab.pendulum.methods import BALANCING_METHODS, HAZARD_METHODS, Method
from safedpa_lab.pendulum.recovery import recovery, swung_all_around
from safedpa_lab.pendulum.rollouts import Swung
from safedpa_sim.pendulum.task import AHEAD, BALANCING, HAZARD, LONG_WAY_ROUND, TORQUE, WIND

__all__ = ["PendulumExperiment", "pendulum_experiment"]

Tell = Callable[[int, int], None]
_FITTED = 5
"""Episodes of each direction whose histories are fitted."""
_SHOWN = 6
"""Swings of each method that are kept for the phase portraits."""


@final
@dataclass(frozen=True)
class PendulumExperiment:
    """What is to be run."""

    models: Path
    directions: int = 24
    episodes: int = 20
    seed: int = 0
    processes: int = 2
    date: str = ""

    def __post_init__(self) -> None:
        for name, low in (("directions", 4), ("episodes", 1), ("seed", 0), ("processes", 1)):
            if getattr(self, name) < low:
                raise InputError(f"--{name}: got {getattr(self, name)}, wanted {low} or more")


@final
@dataclass(frozen=True)
class _Work:
    question: int
    method: Method
    experiment: PendulumExperiment
    epsilon: float


def pendulum_experiment(experiment: PendulumExperiment, tell: Tell = lambda _done, _all: None) -> dict[str, Any]:
    """Runs both questions for every method; the same winds, starts and draws for each."""
    margin = measured_margin(experiment.models, experiment.seed, experiment.directions)
    work = [_Work(1, method, experiment, margin["epsilon"]) for method in BALANCING_METHODS]
    work += [_Work(2, method, experiment, margin["epsilon"]) for method in HAZARD_METHODS]
    found: dict[str, Any] = {"balancing": {}, "hazard": {}}
    latent: dict[str, Any] = {}
    with Workers(experiment.processes) as workers:
        for index, (item, account) in enumerate(zip(work, workers.map(_done, work), strict=True)):
            latent = latent or account.pop("latent", {})
            found["balancing" if item.question == 1 else "hazard"][item.method.name] = account
            tell(index + 1, len(work))
    return {
        "date": experiment.date,
        "seed": experiment.seed,
        "directions": experiment.directions,
        "episodes": experiment.episodes,
        "assumed": _assumed(),
        "margin": margin,
        "invariance": _invariance(margin["epsilon"]),
        "latent": latent,
        **found,
    }


def _done(work: _Work) -> dict[str, Any]:
    experiment, method = work.experiment, work.method
    count = experiment.directions
    options = (experiment.models, work.epsilon, count, experiment.episodes, experiment.seed)
    if work.question == 1:
        swings = balanced(method, *options)
        account = balanced_account(swings, count)
        if method.name == "safedpa":
            account["latent"] = _latent(experiment, swings)
    else:
        swings = crossed(method, *options)
        account = crossed_account(swings, count)
        account["interval_success"] = list(wilson_interval(account["success"], account["episodes"]))
        account["interval_both"] = list(wilson_interval(account["both"], account["episodes"]))
        shown = np.linspace(0, len(swings.states[0]) - 1, 2 * _SHOWN).astype(int)
        account["shown"] = np.round(swings.states[::4, shown], 3).transpose(1, 0, 2).tolist()
    account["title"] = method.title
    account["interval_safe"] = list(wilson_interval(account["safe"], account["episodes"]))
    return account


def _latent(experiment: PendulumExperiment, swings: Swung) -> dict[str, Any]:
    """How well the wind is told by the latent, while balancing and in swings all around, and how well it could be."""
    models, directions, seed = experiment.models, experiment.directions, experiment.seed
    episodes = min(experiment.episodes, _FITTED)
    around = swung_all_around(models, directions, episodes, seed)
    some = np.arange(directions * experiment.episodes).reshape(directions, -1)[:, :episodes].ravel()
    swings = replace(
        swings, states=swings.states[:, some], torques=swings.torques[:, some], latents=swings.latents[:, some]
    )
    return {
        name: recovery(found, models, directions, seed) for name, found in (("around", around), ("balancing", swings))
    }


def _invariance(epsilon: float) -> dict[str, Any]:
    winds = np.linspace(0.0, 6.0, 25)
    rows = {
        name: [least_reserve(float(wind), edges, epsilon=epsilon).torque for wind in winds]
        for name, edges in (("balancing", BALANCING), ("hazard", LONG_WAY_ROUND))
    }
    largest = {
        "balancing": largest_wind(BALANCING, epsilon=epsilon),
        "hazard": largest_wind(LONG_WAY_ROUND, epsilon=epsilon),
    }
    return {"winds": winds.tolist(), "reserve": rows, "largest_wind": largest}


def _assumed() -> dict[str, Any]:
    return {
        "torque_bound": TORQUE,
        "wind": WIND,
        "time_ahead": AHEAD,
        "eta": 0.5,
        "balancing_edges": list(BALANCING),
        "hazard": list(HAZARD),
    }
