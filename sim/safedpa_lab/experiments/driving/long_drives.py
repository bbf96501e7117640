"""Does the car get on for minutes? Random scenes, every load, the shipped loop; stands and goals are counted.

A drive is 120 s long: a car that is caught between the filter and its policy after half a minute shows only there.
Stands are counted twice: as the verdicts tell them, and as the positions show them, whatever the verdicts say.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Any

from safedpa.dynamics import load_model
from safedpa.policy import PolicyNode
from safedpa.safety.deadlock.detector import Stand, record_deadlock
from safedpa.safety.defaults import settings_named
from safedpa_lab.experiments.common.drives import PERIOD, counted, shipped_nodes
from safedpa_lab.experiments.common.seeds import seeds_for
from safedpa_lab.experiments.common.workers import each_result
from safedpa_lab.experiments.margins.drives import DRIVERS
from safedpa_lab.experiments.record import Options, ReportProgress, Result
from safedpa_lab.experiments.report import markdown_table
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene

LONG = 10.0
"""s; the longest accepted stop."""
_STILL = 0.02
"""m; a car that moves less is standing."""
_CRAWL, _CRAWLED = 20.0, 1.0
"""s, and m: a car that moves less in that time crawls."""


@dataclass(frozen=True)
class LongDrive:
    """One drive: scene by load and seed."""

    load: str
    seed: int
    seconds: float = 120.0
    model: str = "car"
    controller: str | None = None
    until_action: float = 0.0
    """s from the measured state until its action acts, as reported by the robot."""
    driver: str = ""
    """Of ``DRIVERS``, for another robot than the car: its model, settings and robot of this seed."""


@dataclass(frozen=True)
class LongOutcome:
    """What became of a drive."""

    load: str
    seed: int
    seconds: float
    collisions: int
    goals: int
    standstills: tuple[Stand, ...]
    """As reported in the verdicts."""
    longest_stand: float
    """s within 2 cm of one place, measured."""
    statuses: dict[str, int]
    least_way: float = math.inf
    """m driven in the slowest 20 s; infinity for a shorter drive."""


def run_long_drive(long: LongDrive) -> LongOutcome:
    """Drives once; the same drive gives the same outcome, bit for bit."""
    driver = DRIVERS[long.driver or "car"]
    model = load_model(driver.model if long.driver else long.model)
    policy = PolicyNode(model, controller=driver.controller if long.driver else long.controller)
    robot: Any = (
        driver.robot(long.seed)
        if long.driver
        else CarRobot(Scene.random(long.seed, long.load), PERIOD, until_action=long.until_action)
    )
    reported: list[Stand] = []
    longest, since, place = 0.0, 0.0, robot.values[:2]
    places = [place]
    nodes = shipped_nodes(model, settings_named(driver.settings), policy)
    ticks = list(drive(robot, nodes, round(long.seconds / model.period)))
    for tick in ticks:
        record_deadlock(reported, tick.verdict)
        x, y = tick.state.values[:2]
        places.append((x, y))
        if math.hypot(x - place[0], y - place[1]) > _STILL:
            since, place = tick.state.robot_time, (x, y)
        longest = max(longest, tick.state.robot_time - since)
    outcome, least_way = counted(robot, ticks), _least_way(places, model.period)
    return LongOutcome(
        long.load, long.seed, long.seconds, outcome.collisions, outcome.goals, tuple(reported), longest,
        dict(outcome.statuses), least_way,
    )  # fmt: skip


def _least_way(places: Sequence[Sequence[float]], period: float) -> float:
    gone = list(accumulate((math.dist(one, other) for one, other in pairwise(places)), initial=0.0))
    return min(
        (later - now for now, later in zip(gone, gone[round(_CRAWL / period) :], strict=False)), default=math.inf
    )


def long_summary(outcomes: Iterable[LongOutcome]) -> dict[str, Any]:
    """Drives, collisions, goals a minute (mean over drives), drives with a long stop, unreported ones, and crawls."""
    drives = list(outcomes)
    long = [item for item in drives if item.longest_stand >= LONG]
    return {
        "drives": len(drives),
        "collisions": sum(item.collisions for item in drives),
        "goals_a_minute": round(sum(60.0 * item.goals / item.seconds for item in drives) / max(len(drives), 1), 2),
        "stands": len(long),
        "crawls": sum(item.least_way < _CRAWLED for item in drives),
        "untold": sum(not item.standstills for item in long),
        "standstills": [
            {"load": item.load, "seed": item.seed, **stand} for item in drives for stand in item.standstills
        ],
    }


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment long-drives``."""
    loads = options["loads"] or ("large_chair",)
    seeds = seeds_for("evaluation", options["drives"], options["first_seed"])
    wanted = [
        LongDrive(load, seed, options["seconds"], controller=options["controller"]) for load in loads for seed in seeds
    ]
    found = each_result(run_long_drive, wanted, options["processes"], report_progress)
    rows = [{"load": load, **_row([one for one in found if one.load == load])} for load in loads]
    return {"experiment": "long-drives", "seeds": [seeds[0], seeds[-1]], "seconds": options["seconds"], "rows": rows}


def _row(drives: Sequence[LongOutcome]) -> dict[str, Any]:
    goals = [one.goals for one in drives]
    longest = [round(one.longest_stand, 2) for one in drives]
    return {**long_summary(drives), "goals": goals, "longest_stands": longest}


def report(result: Result) -> str:
    """One row per load."""
    return markdown_table(
        "load | drives | goals | least | collisions | long stops | unreported | longest [s] | crawls | each drive",
        (
            f"{row['load']} | {row['drives']} | {sum(row['goals'])} | {min(row['goals'])} | {row['collisions']} "
            f"| {row['stands']} | {row['untold']} | {max(row['longest_stands']):.1f} | {row['crawls']} "
            f"| {' '.join(map(str, row['goals']))}"
            for row in result["rows"]
        ),
        above=f"Seeds {result['seeds'][0]} to {result['seeds'][-1]}, {result['seconds']:g} s each.",
    )
