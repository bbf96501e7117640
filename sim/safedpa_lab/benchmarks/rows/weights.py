"""Everything that is learned about the shipped robots, from nothing, by the command that made what ships."""

from __future__ import annotations

import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

from safedpa.fleet.workers import available_cores
from safedpa_lab.benchmarks.results import Effort, Entry, Row, Target
from safedpa_lab.benchmarks.usage import output_of

_ROBOTS: Final = ("car", "pendulum", "point")
"""The longest first, so that no core waits for it at the end."""
_MOST_MINUTES: Final = 60.0
_LEFT_OUT: Final = "the baselines of the point robot's experiments (PPO-Lagrangian, CPO) are no part of it"


def measure(effort: Effort) -> Row:
    """``safedpa train ROBOT`` for each, as many at once as there are cores, each on one thread."""
    cores, began = available_cores(), time.perf_counter()
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(cores) as pool:
        minutes = list(pool.map(lambda robot: _trained(robot, Path(folder) / robot, effort), _ROBOTS))
    whole = (time.perf_counter() - began) / 60.0
    each = [
        Entry(f"safedpa train {robot}", {"minutes": found}, "min", problem=robot)
        for robot, found in zip(_ROBOTS, minutes, strict=True)
    ]
    together = Entry(f"safedpa, all of them, {min(cores, len(_ROBOTS))} at once", {"minutes": whole}, "min")
    targets = () if effort.quick else (Target("all phases and ablations", _MOST_MINUTES, whole, "min"),)
    work = "training of all weights of car, pendulum and point robot, from nothing"
    return Row("weights", work, "minutes", (together, *each), targets=targets, notes=(_LEFT_OUT,))


def _trained(robot: str, folder: Path, effort: Effort) -> float:
    """Minutes by the clock."""
    small = ("--small",) if effort.quick else ()
    began = time.perf_counter()
    output_of("train", robot, "--out", str(folder), "--json", *small, environment={"OMP_NUM_THREADS": "1"})
    return (time.perf_counter() - began) / 60.0
