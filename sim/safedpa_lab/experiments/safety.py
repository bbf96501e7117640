"""Does the filter keep the car from hitting anything? Random scenes, every load, with the filter and without.

Each episode is the pymunk car in lockstep with the real nodes of adaptation, policy and safety filter. Nothing in the
filter's model was fitted to the episodes that are counted here.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

from safedpa.adaptation import AdaptationNode
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety import FilterSettings
from safedpa.safety.defaults import margin_for, settings_named
from safedpa_lab.experiments.statistics import wilson_interval
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.core import CarRobot
from safedpa_sim.robots.scene import Scene

__all__ = ["LOADS", "Episode", "Outcome", "run_episode", "safety_experiment"]

LOADS = ("none", "box", "chair", "large_chair")
_PERIOD = 0.05


@dataclass(frozen=True)
class Episode:
    """One drive: scene by load and seed, with the filter or without."""

    load: str
    seed: int
    filtered: bool
    seconds: float
    model: str
    settings: FilterSettings


@dataclass(frozen=True)
class Outcome:
    """What became of an episode."""

    load: str
    filtered: bool
    collisions: int
    goals: int
    ticks: int
    interventions: int
    least_h: float
    """Smallest barrier value that was measured, m."""
    trajectory: str
    statuses: dict[str, int]


def run_episode(episode: Episode) -> Outcome:
    """Drives one episode; the same episode gives the same outcome, bit for bit."""
    model: PhysicsModel = load_model(episode.model)
    settings = dataclasses.replace(episode.settings, enabled=episode.filtered)
    nodes = [AdaptationNode(model), PolicyNode(model), SafetyFilterNode(model, settings, margin_for(model))]
    robot = CarRobot(Scene.random(episode.seed, episode.load), _PERIOD)
    statuses: Counter[str] = Counter()
    least_h = float("inf")
    ticks = round(episode.seconds / _PERIOD)
    for tick in drive(robot, nodes, ticks):
        statuses[tick.verdict.status] += 1
        least_h = min(least_h, tick.verdict.h_now)
    changed = sum(count for status, count in statuses.items() if status not in ("passed", "disabled"))
    return Outcome(
        episode.load,
        episode.filtered,
        len(robot.collisions),
        robot.goals_reached,
        ticks,
        changed,
        least_h,
        robot.trajectory_hash,
        dict(statuses),
    )


def safety_experiment(
    seeds: Iterable[int],
    seconds: float,
    model: str = "car",
    settings: FilterSettings | None = None,
    processes: int = 2,
    on_episode: Callable[[int, int], None] = lambda _done, _all: None,
) -> dict[str, Any]:
    """Every load and seed with the filter and without; one row a load, with 95 % intervals for safe episodes."""
    settings = settings or settings_named("car")
    episodes = [
        Episode(load, seed, filtered, seconds, model, settings)
        for load in LOADS
        for seed in seeds
        for filtered in (True, False)
    ]
    outcomes = []
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context) as pool:
        for outcome in pool.map(run_episode, episodes, chunksize=4):
            outcomes.append(outcome)
            on_episode(len(outcomes), len(episodes))
    return {"seconds": seconds, "rows": [_row(load, outcomes) for load in LOADS]}


def _row(load: str, outcomes: list[Outcome]) -> dict[str, Any]:
    return {
        "load": load,
        "filter_on": _summary([item for item in outcomes if item.load == load and item.filtered]),
        "filter_off": _summary([item for item in outcomes if item.load == load and not item.filtered]),
    }


def _summary(outcomes: list[Outcome]) -> dict[str, Any]:
    safe = sum(item.collisions == 0 for item in outcomes)
    statuses: Counter[str] = Counter()
    for item in outcomes:
        statuses.update(item.statuses)
    return {
        "episodes": len(outcomes),
        "safe_episodes": safe,
        "safe_share_95": [round(bound, 4) for bound in wilson_interval(safe, len(outcomes))],
        "collisions": sum(item.collisions for item in outcomes),
        "goals": sum(item.goals for item in outcomes),
        "least_h": min(item.least_h for item in outcomes),
        "intervention_share": round(
            sum(item.interventions for item in outcomes) / sum(item.ticks for item in outcomes), 4
        ),
        "statuses": dict(sorted(statuses.items())),
    }
