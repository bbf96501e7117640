"""Which robots of a fleet are diagnosed again, and which recordings are split: whoever works is made up."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from tests.fleet_diagnosis.test_fleet_robots import record

from safedpa.dynamics import load_model, write_model
from safedpa.errors import InputError
from safedpa.fleet import Fleet, Options, RobotLogs, diagnose_fleet
from safedpa.fleet.fleet_diagnosis import kept, write_result
from safedpa.fleet.inputs import options_digest
from safedpa.fleet.one_robot import RobotResult, Task, not_diagnosed
from safedpa.fleet.robots import RobotsFound, robots_in_folder


class Hands:
    """Workers that note who is diagnosed, and find that nobody's recordings can be read."""

    def __init__(self, status: str = "unreadable") -> None:
        self.did: list[Task] = []
        self.status = status

    def __call__(self, _work: Any, jobs: Sequence[Any], _failed: Callable[..., Any]) -> Iterator[Any]:
        for job in jobs:
            self.did.append(job)
            document = not_diagnosed(job, "made up").document | {"status": self.status}
            yield RobotResult(job.robot.name, document)


@pytest.fixture
def asked(tmp_path: Path) -> Fleet:
    robots = []
    for name in ("a", "b", "c"):
        path = tmp_path / "recordings" / name / "run.csv"
        path.parent.mkdir(parents=True)
        path.write_text(f"t,x\n0,{name}\n", encoding="utf-8")
        robots.append(RobotLogs(name, (path,)))
    return Fleet(RobotsFound(tuple(robots), "folder"), Options("car"), tmp_path / "out")


def done(asked: Fleet, *, status: str = "unreadable", anew: bool = False) -> tuple[list[str], list[tuple[int, int]]]:
    """Who was diagnosed now, and what was told of the progress."""
    hands, told = Hands(status), list[tuple[int, int]]()
    document = diagnose_fleet(asked, hands, lambda now, whole: told.append((now, whole)), anew=anew)
    assert document["diagnosed_now"] == len(hands.did)
    return [task.robot.name for task in hands.did], told


def test_only_what_is_new_or_has_changed_is_diagnosed_unless_all_is_wanted_anew(asked: Fleet) -> None:
    assert done(asked) == (["a", "b", "c"], [(0, 3), (1, 3), (2, 3), (3, 3)])
    assert done(asked) == ([], [(3, 3)])
    asked.found.robots[1].files[0].write_text("t,x\n0,another\n", encoding="utf-8")
    assert done(asked) == (["b"], [(2, 3), (3, 3)])
    assert done(asked, anew=True) == (["a", "b", "c"], [(0, 3), (1, 3), (2, 3), (3, 3)])


def test_what_the_program_failed_at_is_tried_again_and_what_the_data_do_not_allow_is_not(asked: Fleet) -> None:
    done(asked, status="failed")
    assert done(asked, status="no_verdict")[0] == ["a", "b", "c"]
    assert done(asked)[0] == []


@pytest.mark.parametrize(
    ("changes", "same"),
    [
        ({}, True),
        ({"status": "unreadable"}, True),
        ({"status": "failed"}, False),
        ({"digest": "of another model"}, False),
        ({"format": 0}, False),
        ({"files": []}, False),
        (None, False),
    ],
)
def test_a_result_is_kept_with_the_same_inputs_and_a_verdict(
    asked: Fleet, changes: dict[str, Any] | None, same: bool
) -> None:
    task = Task(asked.found.robots[0], asked.options, options_digest(asked.options))
    if changes is not None:
        document = not_diagnosed(task, "").document | {"status": "diagnosed"} | changes
        write_result(RobotResult("a", document), asked.out)
    assert kept(task, asked.out) is same


def test_a_model_in_the_folder_of_the_results_is_refused_and_one_beside_it_is_not(asked: Fleet, tmp_path: Path) -> None:
    for place in (tmp_path / "model.toml", asked.out / "given.toml", asked.out / "model.toml"):
        place.parent.mkdir(exist_ok=True)
        place.write_text(write_model(load_model("car")), encoding="utf-8")
        fleet = Fleet(asked.found, Options(str(place)), asked.out)
        if place != asked.out / "model.toml":
            assert len(done(fleet)[0]) == 3
            continue
        with pytest.raises(InputError, match="the given model's own folder"):
            diagnose_fleet(fleet, Hands())
        assert place.exists()


def test_each_robot_of_a_recording_of_many_is_given_its_own_piece_split_once(tmp_path: Path) -> None:
    record(tmp_path / "all" / "many.mcap", ("one", "two"), 20)
    record(tmp_path / "all" / "more.mcap", ("two", "three"), 20)
    record(tmp_path / "all" / "alone.mcap", ("one",), 20)
    fleet = Fleet(robots_in_folder(tmp_path / "all"), Options("car"), tmp_path / "out")
    hands = Hands()
    diagnose_fleet(fleet, hands)
    given = {task.robot.name: task.robot.files for task in hands.did}
    assert {name: [path.name for path in files] for name, files in given.items()} == {
        "one": ["alone.mcap", "one.mcap"], "two": ["two.mcap", "two.mcap"], "three": ["three.mcap"],
    }  # fmt: skip
    assert given["one"][0] == tmp_path / "all" / "alone.mcap", "what holds one robot is left where it is"
    pieces = {path: path.stat().st_mtime_ns for path in (tmp_path / "out" / "recordings").rglob("*.mcap")}
    assert set(pieces) == {path for files in given.values() for path in files} - {given["one"][0]}
    assert len({path.parent for path in pieces}) == 2, "one folder for each recording"
    hands = Hands()
    diagnose_fleet(fleet, hands)
    assert hands.did == []
    assert {path: path.stat().st_mtime_ns for path in pieces} == pieces
    assert not [path for path in (tmp_path / "out").rglob("*") if path.name.startswith(".")]
    assert json.loads((tmp_path / "out" / "fleet.json").read_text(encoding="utf-8"))["by"] == "robot"
