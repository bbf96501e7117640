"""What all robots have goes into the model file: from recordings to model.toml, one process, no search."""

from __future__ import annotations

import json

import numpy as np
import pytest

from safedpa.dynamics import load_model
from safedpa.fleet import Fleet, Options, RobotLogs, diagnose_fleet
from safedpa.fleet.one_robot import RobotResult, diagnosed_robot
from safedpa.fleet.robots import RobotsFound
from safedpa_lab.hidden import Case, write_cases

DRAG = 0.12


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Eight cars that all have air drag, one run each, and the model without it."""
    folder = tmp_path_factory.mktemp("drag")
    effects = {"quadratic_drag": {"coefficient": DRAG}}
    cases = [Case("fleet", 50 + i, effects, runs=1, seconds=12.0) for i in range(8)]
    return write_cases(cases, [folder / f"r{i}" for i in range(8)])


def report(index: int) -> dict:
    """What a robot's diagnosis says of it: the number a little different in each."""
    value = {"value": DRAG + 0.001 * (index - 4), "std": 0.002, "unit": "1/m"}
    candidate = {
        "stage": 0, "effect": "quadratic_drag", "parameters": {"coefficient": value}, "heldout_error": 0.02,
        "score": 9.0, "indistinguishable_from": [], "decision": "accepted", "reason": "",
    }  # fmt: skip
    stages = [{"heldout_error": 0.3}, {"heldout_error": 0.02}]
    return {
        "robot": "car", "added": ["quadratic_drag"], "candidates": [candidate], "unexplained": None, "stages": stages,
        "parameters": {"quadratic_drag.coefficient": value}, "data_quality": [],
    }  # fmt: skip


def workers(work, jobs, _failed):
    """The search is left out; what is tried on the robots is really tried."""
    for job in jobs:
        if work is not diagnosed_robot:
            yield work(job)
            continue
        document = {
            "format": 1, "robot": job.robot.name, "status": "diagnosed", "reason": "", "digest": job.digest,
            "files": [], "unreadable_files": [],
        }  # fmt: skip
        yield RobotResult(job.robot.name, document, {"report.json": json.dumps(report(int(job.robot.name[1:])))})


def test_the_updated_model_is_tried_with_the_others_numbers_and_written(recordings, tmp_path):
    robots = tuple(RobotLogs(f"r{i}", tuple(log.runs)) for i, log in enumerate(recordings))
    fleet = Fleet(RobotsFound(robots, "folder"), Options(str(recordings[0].model)), tmp_path)
    document = diagnose_fleet(fleet, workers)
    common = document["common"]
    assert common["model"] == "model.toml"
    (found,) = common["effects"]
    assert found["confirmed"]["better"] == found["confirmed"]["robots"] == 8
    assert found["confirmed"]["after"] < 0.3 * found["confirmed"]["before"]
    model = load_model(tmp_path / "model.toml")
    assert np.isclose(model.settings["quadratic_drag.coefficient"].value, DRAG, atol=0.002)
    assert "Mend the model file" in (tmp_path / "fleet.html").read_text(encoding="utf-8")


def test_a_model_of_an_earlier_fleet_does_not_stay(recordings, tmp_path):
    (tmp_path / "model.toml").write_text("old", encoding="utf-8")
    robots = tuple(RobotLogs(f"r{i}", tuple(log.runs)) for i, log in enumerate(recordings[:3]))
    fleet = Fleet(RobotsFound(robots, "folder"), Options(str(recordings[0].model)), tmp_path)
    assert diagnose_fleet(fleet, workers)["common"] is None  # three are no fleet
    assert not (tmp_path / "model.toml").exists()


def test_a_model_that_does_not_help_is_not_written(recordings, tmp_path):
    robots = tuple(RobotLogs(f"r{i}", tuple(log.runs)) for i, log in enumerate(recordings))
    fleet = Fleet(RobotsFound(robots, "folder"), Options(str(recordings[0].model)), tmp_path)

    def doubtful(work, jobs, failed):
        if work is diagnosed_robot:
            yield from workers(work, jobs, failed)
        else:
            yield from ((job.robot.name, 0.4) for job in jobs)

    document = diagnose_fleet(fleet, doubtful)
    assert document["common"]["model"] is None
    assert not (tmp_path / "model.toml").exists()
    assert "does not belong to the model" in (tmp_path / "fleet.html").read_text(encoding="utf-8")
