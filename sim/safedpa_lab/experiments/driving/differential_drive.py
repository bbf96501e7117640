"""The differential drive among obstacles, in four worlds that its model does not know, with the filter and without.

Each drive is the stand-in in lockstep with the real nodes of adaptation, policy and safety filter. One policy
heads straight for its goal and looks at nothing; the other goes round what is in the way.
"""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from safedpa.adaptation import AdaptationNode
from safedpa.dynamics import load_model
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import margin_for, settings_named
from safedpa.systems.robots import robot_named
from safedpa_lab.experiments.common.seeds import seeds_for
from safedpa_lab.experiments.common.statistics import wilson_interval
from safedpa_lab.experiments.common.workers import each_result
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent
from safedpa_lab.experiments.report import markdown_table
from safedpa_sim.closed_loop import drive
from safedpa_sim.differential_drive.stand_in import WORLDS
from safedpa_sim.robots.stand_in_robot import StandInRobot

_ROBOT = "differential_drive"
POLICIES = ("straight", "goal_seeker")
_UNFILTERED = 4
"""Every so many scenes are driven without the filter as well: what happens then is no question."""


@dataclass(frozen=True)
class WheelsDrive:
    """One drive: world, scene, policy, with the filter or without."""

    world: str
    seed: int
    policy: str
    filtered: bool
    seconds: float


def run_drive(wanted: WheelsDrive) -> dict[str, Any]:
    """Drives it; the same drive gives the same numbers."""
    robot = robot_named(_ROBOT)
    model = load_model(str(robot.model))
    settings = dataclasses.replace(settings_named(_ROBOT), enabled=wanted.filtered)
    policy = PolicyNode(model, wanted.policy)
    nodes = [AdaptationNode(model), policy, SafetyFilterNode(model, settings, margin_for(model))]
    simulated = StandInRobot(robot, model.period, wanted.seed, WORLDS[wanted.world])
    statuses: Counter[str] = Counter()
    least_h, way, microseconds = float("inf"), 0.0, []
    for tick in drive(simulated, nodes, round(wanted.seconds / model.period)):
        statuses[tick.verdict.status] += 1
        least_h = min(least_h, tick.verdict.h_now)
        way += abs(tick.state.values[3]) * model.period
        microseconds.append(tick.verdict.microseconds)
    return {
        **dataclasses.asdict(wanted),
        "collisions": len(simulated.collisions),
        "goals": simulated.goals_reached,
        "way": way,
        "least_h": least_h,
        "statuses": dict(statuses),
        "microseconds": sorted(microseconds)[len(microseconds) // 2],
    }


def wheels_experiment(
    seeds: Sequence[int],
    seconds: float,
    processes: int = 1,
    report_progress: ReportProgress = silent,
) -> dict[str, Any]:
    """Every world, seed and policy with the filter, some without; one row a world and policy."""
    wanted = [
        WheelsDrive(world, seed, policy, filtered, seconds)
        for world in WORLDS
        for policy in POLICIES
        for index, seed in enumerate(seeds)
        for filtered in ((True, False) if index % _UNFILTERED == 0 else (True,))
    ]
    found = each_result(run_drive, wanted, processes, report_progress)
    rows = [
        {
            "world": world,
            "asked_of_the_world": WORLDS[world],
            "policy": policy,
            "filter_on": _summary([one for one in found if _is(one, world, policy) and one["filtered"]]),
            "filter_off": _summary([one for one in found if _is(one, world, policy) and not one["filtered"]]),
        }
        for world in WORLDS
        for policy in POLICIES
    ]
    return {"seeds": [seeds[0], seeds[-1]], "seconds": seconds, "date": time.strftime("%Y-%m-%d"), "rows": rows}


def _is(one: dict[str, Any], world: str, policy: str) -> bool:
    return bool(one["world"] == world and one["policy"] == policy)


def _summary(drives: Sequence[dict[str, Any]]) -> dict[str, Any]:
    hit = [one for one in drives if one["collisions"]]
    statuses: Counter[str] = Counter()
    for one in drives:
        statuses.update(one["statuses"])
    return {
        "drives": len(drives),
        "drives_with_a_collision": len(hit),
        "share_95": wilson_interval(len(hit), len(drives)),
        "collisions": sum(one["collisions"] for one in drives),
        "which": [one["seed"] for one in hit],
        "goals": sum(one["goals"] for one in drives),
        "metres": sum(one["way"] for one in drives),
        "least_h": min(one["least_h"] for one in drives),
        "median_microseconds": sorted(one["microseconds"] for one in drives)[len(drives) // 2],
        "statuses": dict(sorted(statuses.items())),
    }


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment differential-drive``."""
    seeds = seeds_for("evaluation", options["drives"], options["first_seed"])
    found = wheels_experiment(seeds, options["seconds"], options["processes"], report_progress)
    return {"experiment": "differential-drive", **found}


def report(result: Result) -> str:
    """One row per world and policy."""
    return markdown_table(
        "world | policy | drives | with a collision | goals | without the filter: with a collision | of",
        (
            f"{row['world']} | {row['policy']} | {on['drives']} | {on['drives_with_a_collision']} | {on['goals']} "
            f"| {off['drives_with_a_collision']} | {off['drives']}"
            for row in result["rows"]
            for on, off in [(row["filter_on"], row["filter_off"])]
        ),
    )
