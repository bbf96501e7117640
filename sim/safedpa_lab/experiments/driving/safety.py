"""Collisions of the car in random scenes with every load, with the filter and without.

Each episode is the pymunk car in lockstep with the real nodes of adaptation, policy and safety filter. The
filter's model was not fitted to these episodes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from safedpa.dynamics import load_model
from safedpa.safety import FilterSettings
from safedpa.safety.defaults import settings_named
from safedpa_lab.experiments.common.drives import LOADS, PERIOD, Outcome, counted, shipped_nodes, statuses_of
from safedpa_lab.experiments.common.seeds import seeds_of
from safedpa_lab.experiments.common.statistics import share_95
from safedpa_lab.experiments.common.workers import each_result
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent, with_options
from safedpa_lab.experiments.report import markdown_table
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene


@dataclass(frozen=True)
class Episode:
    """One drive: scene by load and seed, with the filter or without."""

    load: str
    seed: int
    filtered: bool
    seconds: float
    model: str
    settings: FilterSettings


def run_episode(episode: Episode) -> Outcome:
    """Drives one episode; the same episode gives the same outcome, bit for bit."""
    settings = dataclasses.replace(episode.settings, enabled=episode.filtered)
    nodes = shipped_nodes(load_model(episode.model), settings)
    robot = CarRobot(Scene.random(episode.seed, episode.load), PERIOD)
    return counted(robot, drive(robot, nodes, round(episode.seconds / PERIOD)))


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
    outcomes: dict[tuple[str, bool], list[Outcome]] = {}
    for one, outcome in zip(episodes, each_result(run_episode, episodes, processes, on_episode), strict=True):
        outcomes.setdefault((one.load, one.filtered), []).append(outcome)
    rows = [
        {"load": load, "filter_on": _summary(outcomes[load, True]), "filter_off": _summary(outcomes[load, False])}
        for load in LOADS
    ]
    return {"seconds": seconds, "rows": rows}


def _summary(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    safe = sum(item.collisions == 0 for item in outcomes)
    return {
        "episodes": len(outcomes),
        "safe_episodes": safe,
        "safe_share_95": share_95(safe, len(outcomes)),
        "collisions": sum(item.collisions for item in outcomes),
        "goals": sum(item.goals for item in outcomes),
        "least_h": min(item.least_h for item in outcomes),
        "intervention_share": round(sum(item.changed for item in outcomes) / sum(item.ticks for item in outcomes), 4),
        "statuses": statuses_of(item.statuses for item in outcomes),
    }


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment safety``."""
    seeds, settings = seeds_of(options), settings_named(options["settings"])
    found = with_options(safety_experiment, options, seeds=seeds, settings=settings, on_episode=report_progress)
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
