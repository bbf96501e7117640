"""Recordings of real robots from public repositories, found by their file names in a folder of the user's."""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from safedpa.comparison.comparison import with_distinct_names
from safedpa.comparison.windows import Windows
from safedpa.diagnosis.coverage import within_coverage
from safedpa.diagnosis.report_schema import CoveredRange
from safedpa.dynamics import PhysicsModel, load_model, load_user_file
from safedpa.errors import RunError
from safedpa.records import load_column_map, load_run
from safedpa.records.column_map.column_map import native_map
from safedpa.records.quality.quality import run_of_rows
from safedpa.records.run import RawRows, Run

CAR = "car_1_Datarecording_09_16_2024_*.csv"
"""Lorenzo-Lyons/DART, System_identification/Data/91_free_driving_16_sept_2024."""
OTHER_DAY = "car_1_Datarecording_09_27_2024_*.csv"
"""The same repository, ROS_packages/racecar_pkg/src/Data: the same car in circles eleven days later."""
PENDULUM = "data_measured.csv"
"""dfki-ric-underactuated-lab/torque_limited_simple_pendulum, results."""
BALLS = "ball_drops.csv"
"""briandesilva/discovery-of-physics-from-data."""


@dataclass(frozen=True)
class OtherRobot:
    """A robot whose system, model and column map lie next to its recordings: file names, and what is expected."""

    model: str
    effects_file: str
    """Python file that declares the system and its effects."""
    logs: str
    columns: str = ""
    horizon: float = 1.0
    effects: tuple[tuple[str, ...], ...] = ()
    """One of each set of alternatives has to be named."""
    error: float = 0.0
    """Largest held-out error."""


_FRICTION = (("rate_friction",), ("rate_drag",))
OTHER_ROBOTS = {
    "servo": OtherRobot("servo.toml", "servo.py", "b_*.csv", "cols.toml", 0.4, (("rate_speed_limit",),), 0.15),
    "joint, gain free": OtherRobot("joint.toml", "joint.py", "j1_b.csv", "cols1.toml", 1.0, _FRICTION, 0.06),
    "joint, gain fixed": OtherRobot("joint_fixed.toml", "joint.py", "j1_b.csv", "cols1.toml", 1.0, _FRICTION, 0.06),
    "tanks": OtherRobot("tank40.toml", "tank.py", "val40.csv", "", 1.0, (("pump_lag", "pump_reservoir"),), 0.34),
}
"""mauicv/servo-sysid; shamilmamedov/dynamic_calibration, joint 1 of a UR10e; the cascaded tanks of Schoukens and Noel,
with time divided by 40."""


def other_robot_runs(folder: Path, robot: OtherRobot) -> tuple[PhysicsModel, list[Run]]:
    """The model and its recordings. Raises InputError or RunError for what cannot be read."""
    model_path = paths_of(folder, robot.model)[0]
    load_user_file(model_path.with_name(robot.effects_file))
    model = load_model(str(model_path))
    mapping = load_column_map(str(model_path.with_name(robot.columns))) if robot.columns else None
    paths = sorted(model_path.parent.glob(robot.logs))
    return model, with_distinct_names([load_run(path, model.system, mapping) for path in paths], paths)


def paths_of(folder: Path, pattern: str) -> list[Path]:
    """Files of that name anywhere under ``folder``, in order."""
    return sorted(path for path in folder.rglob(pattern) if path.is_file())


def mapped_runs(paths: Sequence[Path], model: PhysicsModel, columns: str) -> list[Run]:
    """The recordings through a column map that ships, with distinct names."""
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
    measured = RawRows(table[:, 0], table[:, 1:], np.empty((len(table), 0)))
    return run_of_rows(path.with_name(f"drop_{number}.csv"), model.system, native_map(model.system), measured, ())


VARIABLES = ("speed", "throttle")
"""What drives: laws of drive and drag that agree at some pairs of these differ at others."""
_NEAR = 0.05
"""Of each variable's range over all rows (2 to 98 %): rows closer than that, in every variable, are alike."""
_STAYS = 0.9
_LEAST = 1.0
"""s of driving without which a row counts as not covered."""


def uncovered(seen: Sequence[Run], unseen: Run) -> float:
    """Share of the rows of ``unseen`` about which the logs in ``seen`` hold less than a second of driving."""
    from scipy.spatial import cKDTree

    own, others = _rows(unseen), np.concatenate([_rows(run) for run in seen])
    low, high = np.quantile(np.concatenate([own, others]), (0.02, 0.98), axis=0)
    near = np.maximum(_NEAR * (high - low), 1e-9)
    found = cKDTree(others / near).query_ball_point(own / near, 1.0, p=np.inf, return_length=True)
    period = float(np.median([run.period for run in seen]))
    return float((found * period < _LEAST).mean())


def reported_windows(coverage: Sequence[CoveredRange], windows: Windows) -> NDArray[np.bool_]:
    """Windows (windows,) that begin, end and for nine tenths of their rows stay where a report says that it holds."""
    good = within_coverage(coverage, windows.system, windows.states, windows.actions)
    spans = zip(windows.start.tolist(), windows.end.tolist(), strict=True)
    return np.array([good[begin] and good[end] and good[begin : end + 1].mean() >= _STAYS for begin, end in spans])


def _rows(run: Run) -> NDArray[np.float64]:
    """(rows, variables)"""
    names = (*run.system.state_names, *run.system.action_names)
    table = np.concatenate([np.column_stack([states, actions]) for _, states, actions in run.parts()])
    return np.asarray(table[:, [names.index(name) for name in VARIABLES]], dtype=np.float64)
