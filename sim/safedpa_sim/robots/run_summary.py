"""The summary of a robot's run, written when it ends."""

from __future__ import annotations

import json
import math
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

from safedpa.errors import InputError, RecordingError
from safedpa_sim.robots.robot import SimulatedRobot

_SHARES = {"p50": 0.5, "p99": 0.99, "p999": 0.999}


def summarise_run(robot: SimulatedRobot, latencies: list[float], overruns: int, end: str) -> dict[str, Any]:
    """Returns ticks, goals, collisions, watchdog ticks, refusals, sense-to-act latency and trajectory hash of a run.

    ``latencies`` [s] are from the first publication of a state to the acceptance of its action; without any, all
    percentiles are null.
    """
    return {
        "ticks": robot.tick,
        "robot_seconds": round(robot.tick * robot.period, 9),
        "lockstep": robot.lockstep,
        **robot.about,
        "goals_reached": robot.goals_reached,
        "collisions": len(robot.collisions),
        "collision_list": [asdict(collision) for collision in robot.collisions],
        "watchdog_ticks": robot.watchdog_ticks,
        "refusals": dict(sorted(robot.guard.refusals.items())),
        "latency_us": {name: percentile(latencies, share) for name, share in _SHARES.items()},
        "overruns": overruns,
        "trajectory_sha256": robot.trajectory_hash,
        "end": end,
    }


def percentile(seconds: list[float], share: float) -> float | None:
    """Returns the smallest entry that at least ``share`` of all do not exceed, in microseconds; None if empty."""
    if not seconds:
        return None
    return 1e6 * sorted(seconds)[math.ceil(share * len(seconds)) - 1]


def check_writable(path: Path) -> None:
    """Raises InputError when no file can be written there, before the run instead of at its end."""
    if path.is_dir() or not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        raise InputError(f"--summary {path}: cannot be written; give a file in an existing, writable folder")


def write_summary(summary: dict[str, Any], path: Path) -> None:
    """Writes one line of JSON atomically. Raises RecordingError when writing fails."""
    unfinished = path.with_name(path.name + ".unfinished")
    try:
        unfinished.write_text(json.dumps(summary) + "\n", encoding="utf-8")
        unfinished.replace(path)
    except OSError as error:
        raise RecordingError(f"{path}: not written ({error.strerror}); make room or choose another folder") from error
