"""The paper's Safety Gym experiment: the point robot among hazards, in a force from every direction, every method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import InputError
from safedpa_lab.experiments.car_workers import Workers
from safedpa_lab.experiments.statistics import mean_interval, ratio_interval, wilson_interval
from safedpa_lab.point.baseline_set import LARGEST_FORCE
from safedpa_lab.point.driven import Driven, driven, windy_task
from safedpa_lab.point.methods import METHODS, Method, driver_of
from safedpa_sim.point.task import EPISODE_STEPS

__all__ = ["PointExperiment", "point_experiment"]

Floats = NDArray[np.float64]
Tell = Callable[[int, int], None]
_SHOWN = 4
"""Directions of which one path is kept for the pictures."""


@final
@dataclass(frozen=True)
class PointExperiment:
    """What is to be run."""

    models: Path
    baselines: Path
    methods: tuple[str, ...] = tuple(METHODS)
    directions: int = 24
    episodes: int = 20
    steps: int = EPISODE_STEPS
    force: float = LARGEST_FORCE
    seed: int = 0
    processes: int = 2
    date: str = ""

    def __post_init__(self) -> None:
        for name, low in (
            ("directions", 1),
            ("episodes", 1),
            ("steps", 1),
            ("seed", 0),
            ("processes", 1),
            ("force", 0),
        ):
            if not getattr(self, name) >= low:
                raise InputError(f"--{name}: got {getattr(self, name)}, wanted {low} or more")


def point_experiment(experiment: PointExperiment, tell: Tell = lambda _done, _all: None) -> dict[str, Any]:
    """Drives every method through the same layouts, winds and goals.

    Raises InputError where a method's weights are neither in the folder nor among those that ship.
    """
    work = [(experiment, METHODS[name]) for name in experiment.methods]
    rows: dict[str, Any] = {}
    with Workers(experiment.processes) as workers:
        for index, (item, row) in enumerate(zip(work, workers.map(_done, work), strict=True)):
            rows[item[1].name] = row
            tell(index + 1, len(work))
    _beside_ppo(rows)
    told = {name: getattr(experiment, name) for name in ("date", "seed", "directions", "episodes", "steps", "force")}
    return {**told, "methods": rows}


def _done(work: tuple[PointExperiment, Method]) -> dict[str, Any]:
    experiment, method = work
    directions, episodes = experiment.directions, experiment.episodes
    task = windy_task(directions, episodes, experiment.force, experiment.seed)
    driver = driver_of(method, task, experiment.models, experiment.baselines)
    shown = np.arange(0, directions, max(1, directions // _SHOWN)) * episodes
    found = driven(driver, task, experiment.steps, shown)
    return {"title": method.title, "filter": method.filter, **_account(found, directions, experiment.steps)}


def _account(found: Driven, directions: int, steps: int) -> dict[str, Any]:
    count = len(found.goals)
    safe, reached = int((found.cost == 0.0).sum()), int((found.goals > 0.0).sum())

    def by_direction(values: Floats) -> list[float]:
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
        "goals_each": found.goals.tolist(),
        "shown": found.shown,
    }


def _finite(number: float) -> float | None:
    return round(number, 2) if np.isfinite(number) else None


def _beside_ppo(rows: dict[str, Any]) -> None:
    """Goals over PPO's in the same episodes."""
    each = {name: np.array(row.pop("goals_each")) for name, row in rows.items()}
    if "ppo" in each and each["ppo"].any():
        for name, row in rows.items():
            row["of_ppo"] = ratio_interval(each[name], each["ppo"])
