"""What a robot writes of its run, independent of the network: a summary at the end, and a trace of each period."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
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


@dataclass(frozen=True, slots=True)
class TracedPeriod:
    """One period of the robot. Times [s] are from the monotonic clock, which all processes of the machine share."""

    epoch: int
    tick: int
    published: float
    """Time at which the state of this tick was published."""
    applied_at: float
    """Time from which ``applied`` acted."""
    action_epoch: int
    """Epoch of the accepted message; -1 without one."""
    action_tick: int
    """Tick of the accepted message; -1 without one."""
    applied: tuple[float, ...]
    applied_by: str
    """``filter`` or ``watchdog``."""
    values: tuple[float, ...]
    """The published state."""
    collisions: int
    """Number since the robot's start, including this period."""

    @property
    def age(self) -> float:
        """s between the publication of the state and the start of its action."""
        return self.applied_at - self.published


class TraceWriter:
    """Appends one line of JSON per period to a file, unbuffered, so that the trace survives a crash of the process.

    A full disk ends the trace, not the drive. Raises RecordingError when the file cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self.failed = False
        """Whether a write has failed; nothing is written afterwards."""
        try:
            self._file = path.open("ab", buffering=0)
        except OSError as error:
            raise RecordingError(
                f"--trace {path}: cannot be written ({error.strerror}); choose another file"
            ) from error

    def write(self, period: TracedPeriod) -> None:
        """Appends one period, unless an earlier write has failed."""
        if self.failed:
            return
        try:
            self._file.write(json.dumps(asdict(period)).encode() + b"\n")
        except OSError:
            self.failed = True

    def __enter__(self) -> TraceWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()


def read_trace(path: Path) -> Iterator[TracedPeriod]:
    """Yields the periods in a file, oldest first; an incomplete last line of a killed robot is skipped."""
    for line in path.read_bytes().split(b"\n")[:-1]:
        fields = json.loads(line)
        yield TracedPeriod(**{**fields, "applied": tuple(fields["applied"]), "values": tuple(fields["values"])})
