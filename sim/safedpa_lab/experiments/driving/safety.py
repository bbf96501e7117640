"""Collisions of the car in random scenes with every load, with the filter and without.

Each episode is the pymunk car in lockstep with the real nodes of adaptation, policy and safety filter. The
filter's model was not fitted to these episodes.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from safedpa.adaptation import AdaptationNode
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety import FilterSettings
from safedpa.safety.defaults import margin_for, settings_named
from safedpa_lab.experiments.common.seeds import seeds_of
from safedpa_lab.experiments.common.statistics import wilson_interval
from safedpa_lab.experiments.common.workers import each_result
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent
from safedpa_lab.experiments.report import markdown_table
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene

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
    """The result of an episode."""

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
    on_episode: ReportProgress = silent,
) -> dict[str, Any]:
    """Every load and seed with the filter and without; one row a load, with 95 % intervals for safe episodes."""
    settings = settings or settings_named("car")
    episodes = [
        Episode(load, seed, filtered, seconds, model, settings)
        for load in LOADS
        for seed in seeds
        for filtered in (True, False)
    ]
    outcomes = each_result(run_episode, episodes, processes, on_episode)
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


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment safety``."""
    seeds, settings = seeds_of(options), settings_named(options["settings"])
    found = safety_experiment(
        seeds, options["seconds"], options["model"], settings, options["processes"], report_progress
    )
    return {"experiment": "safety", "seeds": [seeds.start, seeds.stop - 1], **found}


def report(result: Result) -> str:
    """One row per load, with the filter and without."""

    def row(load: str, on: dict[str, Any], off: dict[str, Any]) -> str:
        collided = [f"{one['collisions']} in {one['episodes'] - one['safe_episodes']}" for one in (on, off)]
        goals = f"{on['goals']} | {off['goals']} | {100 * on['intervention_share']:.0f} %"
        return f"{load} | {on['episodes']} | {' | '.join(collided)} | {goals}"

    first, last = result["seeds"]
    return markdown_table(
        "load | episodes | collisions with filter | without | goals with | without | changed actions",
        (row(one["load"], one["filter_on"], one["filter_off"]) for one in result["rows"]),
        above=f"Seeds {first} to {last}, {result['seconds']:g} s each.",
    )
