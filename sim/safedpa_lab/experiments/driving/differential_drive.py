"""The differential drive among obstacles, in four worlds that its model does not know, with the filter and without.

Each drive is the stand-in in lockstep with the real nodes of adaptation, policy and safety filter. One policy
heads straight for its goal and looks at nothing; the other goes round what is in the way.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from safedpa.dynamics import load_model
from safedpa.policy import PolicyNode
from safedpa.safety.defaults import settings_named
from safedpa.systems.robots import robot_named
from safedpa_lab.experiments.common.drives import counted, shipped_nodes, statuses_of
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
    nodes = shipped_nodes(model, settings, PolicyNode(model, wanted.policy))
    simulated = StandInRobot(robot, model.period, wanted.seed, WORLDS[wanted.world])
    ticks = list(drive(simulated, nodes, round(wanted.seconds / model.period)))
    return {
        **asdict(wanted),
        **asdict(counted(simulated, ticks)),
        "way": sum(abs(tick.state.values[3]) * model.period for tick in ticks),
        "microseconds": sorted(tick.verdict.microseconds for tick in ticks)[len(ticks) // 2],
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

    def row(world: str, policy: str) -> dict[str, Any]:
        own = [one for one in found if (one["world"], one["policy"]) == (world, policy)]
        on, off = ([one for one in own if one["filtered"] is filtered] for filtered in (True, False))
        asked = {"world": world, "asked_of_the_world": WORLDS[world], "policy": policy}
        return {**asked, "filter_on": _summary(on), "filter_off": _summary(off)}

    rows = [row(world, policy) for world in WORLDS for policy in POLICIES]
    return {"seeds": [seeds[0], seeds[-1]], "seconds": seconds, "date": time.strftime("%Y-%m-%d"), "rows": rows}


def _summary(drives: Sequence[dict[str, Any]]) -> dict[str, Any]:
    hit = [one for one in drives if one["collisions"]]
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
        "statuses": statuses_of(one["statuses"] for one in drives),
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
