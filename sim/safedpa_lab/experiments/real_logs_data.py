"""Recordings of real robots from public repositories, found by their file names in a folder of the user's."""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from safedpa.comparison.comparison import with_distinct_names
from safedpa.dynamics import PhysicsModel
from safedpa.errors import RunError
from safedpa.records import load_column_map, load_run
from safedpa.records.column_map.apply import Rows
from safedpa.records.column_map.column_map import native_map
from safedpa.records.quality.quality import run_of_rows
from safedpa.records.run import Run

__all__ = ["BALLS", "CAR", "OTHER_DAY", "PENDULUM", "ball_runs", "mapped_runs", "paths_of"]

CAR = "car_1_Datarecording_09_16_2024_*.csv"
"""Lorenzo-Lyons/DART, System_identification/Data/91_free_driving_16_sept_2024."""
OTHER_DAY = "car_1_Datarecording_09_27_2024_*.csv"
"""The same repository, ROS_packages/racecar_pkg/src/Data: the same car in circles eleven days later."""
PENDULUM = "data_measured.csv"
"""dfki-ric-underactuated-lab/torque_limited_simple_pendulum, results."""
BALLS = "ball_drops.csv"
"""briandesilva/discovery-of-physics-from-data."""


def paths_of(folder: Path, pattern: str) -> list[Path]:
    """Files of that name anywhere under ``folder``, in order."""
    return sorted(path for path in folder.rglob(pattern) if path.is_file())


def mapped_runs(paths: Sequence[Path], model: PhysicsModel, columns: str) -> list[Run]:
    """The recordings through a column map that ships, named so that they can be told apart."""
    mapping = load_column_map(columns)
    if not paths:
        return []
    return with_distinct_names([load_run(path, model.system, mapping) for path in paths], paths)


def ball_runs(path: Path, model: PhysicsModel) -> dict[str, list[Run]]:
    """The drops of each ball, out of a table with the columns drop, t [s], height [m], velocity [m/s], ball.

    Raises RunError when a line is something else.
    """
    drops: dict[str, dict[str, list[list[float]]]] = defaultdict(lambda: defaultdict(list))
    with path.open(encoding="utf-8", newline="") as file:
        for line, cells in enumerate(list(csv.reader(file))[1:], start=2):
            try:
                number, t, height, velocity, ball = cells
                drops[ball.strip()][number].append([float(t), float(height), float(velocity)])
            except ValueError as error:
                raise RunError(
                    f"{path}: line {line}: got {cells}, wanted drop, time, height, velocity and ball"
                ) from error
    return {ball: [_drop(path, model, number, rows) for number, rows in own.items()] for ball, own in drops.items()}


def _drop(path: Path, model: PhysicsModel, number: str, rows: list[list[float]]) -> Run:
    table = np.array(rows)
    measured = Rows(table[:, 0], table[:, 1:], np.empty((len(table), 0)))
    return run_of_rows(path.with_name(f"drop_{number}.csv"), model.system, native_map(model.system), measured, ())
