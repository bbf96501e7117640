"""Counts the false stops of the plausibility of a state in hours of healthy drives.

A stop after the robot has touched something is none: what moves it then is not in the model.

Each drive has its own conditions: loads, slip and wind of the robot's worlds, with and without noise, states that are
lost, commands that act later than the filter knows, and pauses in which no process answers.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from typing import Any, Final

import numpy as np

from safedpa_lab.experiments.common.seeds import seeds_for
from safedpa_lab.experiments.common.workers import each_result
from safedpa_lab.experiments.driving.implausible_states import HEALTHY, StateDrive, run_state_drive
from safedpa_lab.experiments.driving.state_faults import ROBOTS
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent
from safedpa_lab.experiments.report import markdown_table

_LATEST: Final = 0.15
"""s; an unknown delay up to which the filter promises to work."""
_LOST_SHARE: Final = 0.3
_PAUSES: Final = 0.1
"""Pauses per second."""


def healthy_drive(robot: str, index: int, seed: int, seconds: float) -> StateDrive:
    """The drive of this number: its worlds and conditions take turns."""
    worlds = ROBOTS[robot].worlds
    draw = np.random.default_rng([seed, 5])
    return StateDrive(
        robot,
        worlds[index % len(worlds)],
        seed,
        seconds,
        HEALTHY,
        lost_share=float(draw.choice([0.0, _LOST_SHARE])),
        noise=float(draw.choice([0.0, 1.0])),
        late=float(draw.choice([0.0, draw.uniform(0.0, _LATEST)])),
        missed=float(draw.choice([0.0, _PAUSES])),
    )


def false_stops(
    robots: Sequence[str],
    hours: float,
    first_seed: int,
    seconds: float,
    processes: int = 1,
    on_drive: ReportProgress = silent,
) -> dict[str, Any]:
    """One row per robot, each of ``hours``."""
    seeds = seeds_for("evaluation", ceil(3600.0 * hours / seconds), first_seed)
    wanted = [healthy_drive(name, index, seed, seconds) for name in robots for index, seed in enumerate(seeds)]
    found = each_result(run_state_drive, wanted, processes, on_drive)
    return {
        "seeds": [seeds[0], seeds[-1]],
        "seconds": seconds,
        "rows": [_row(name, [one for one in found if one["robot"] == name]) for name in robots],
    }


def _row(robot: str, drives: Sequence[dict[str, Any]]) -> dict[str, Any]:
    stopped = [one for one in drives if one["stopped"] and not one["touched_before"]]
    known = ("seed", "world", "lost_share", "noise", "late", "missed", "stopped")
    return {
        "robot": robot,
        "hours": sum(one["hours"] for one in drives),
        "false_stops": len(stopped),
        "hit": sum(bool(one["hits"]) for one in drives),
        "goals": sum(one["goals"] for one in drives),
        "stops": [{name: one[name] for name in known} for one in stopped],
    }


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment false-stops``."""
    robots = options["robots"] or tuple(name for name, kind in ROBOTS.items() if kind.stops)
    found = false_stops(
        robots, options["hours"], options["first_seed"], options["seconds"], options["processes"], report_progress
    )
    return {"experiment": "false-stops", **found}


def report(result: Result) -> str:
    """One row per robot."""
    return markdown_table(
        "robot | hours | false stops | hit above 0.05 m/s | goals | reasons",
        (
            f"{row['robot']} | {row['hours']:.2f} | {row['false_stops']} | {row['hit']} | {row['goals']} "
            f"| {'; '.join(sorted({one['stopped'][:70] for one in row['stops']})[:4])}"
            for row in result["rows"]
        ),
        above=f"Seeds {result['seeds'][0]} to {result['seeds'][1]}, {result['seconds']:g} s each.",
    )
