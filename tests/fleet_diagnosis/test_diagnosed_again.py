"""Which robots of a fleet are diagnosed again, and which recordings are split; the diagnosis itself is made up."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from tests.fleet_diagnosis.test_fleet_robots import record

from safedpa.dynamics import load_model, write_model
from safedpa.errors import InputError, RecordingError
from safedpa.fleet import Fleet, Options, RobotLogs, diagnose_fleet
from safedpa.fleet.fleet_diagnosis import clear_others, kept, read_result, write_result
from safedpa.fleet.inputs import options_digest
from safedpa.fleet.one_robot import RobotResult, Task, diagnosed_robot, not_diagnosed
from safedpa.fleet.robots import RobotsFound, robots_in_folder


class Hands:
    """Workers that record which robots are diagnosed, each with the same status."""

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
        paths = tuple(tmp_path / "recordings" / name / f"run{number}.csv" for number in (1, 2))
        paths[0].parent.mkdir(parents=True)
        for path in paths:
            path.write_text(f"t,x\n0,{name}\n", encoding="utf-8")
        robots.append(RobotLogs(name, paths))
    (tmp_path / "model.toml").write_text(write_model(load_model("car")), encoding="utf-8")
    return Fleet(RobotsFound(tuple(robots), "folder"), Options(str(tmp_path / "model.toml")), tmp_path / "out")


def diagnosed(asked: Fleet, *, status: str = "unreadable", anew: bool = False) -> tuple[list[str], Any]:
    """Names of the robots that were diagnosed now, and the progress that was reported."""
    hands, progress = Hands(status), list[tuple[int, int]]()
    document = diagnose_fleet(asked, hands, lambda now, whole: progress.append((now, whole)), anew=anew)
    assert document["diagnosed_now"] == len(hands.did)
    return [task.robot.name for task in hands.did], progress


def test_only_new_or_changed_robots_are_diagnosed_unless_all_are_wanted_again(asked: Fleet) -> None:
    assert diagnosed(asked) == (["a", "b", "c"], [(0, 3), (1, 3), (2, 3), (3, 3)])
    assert diagnosed(asked) == ([], [(3, 3)])
    asked.found.robots[1].files[0].write_text("t,x\n0,another\n", encoding="utf-8")
    assert diagnosed(asked) == (["b"], [(2, 3), (3, 3)])
    assert diagnosed(asked, anew=True) == (["a", "b", "c"], [(0, 3), (1, 3), (2, 3), (3, 3)])


def test_a_failure_of_the_program_is_tried_again_and_insufficient_data_are_not(asked: Fleet) -> None:
    diagnosed(asked, status="failed")
    assert diagnosed(asked, status="no_verdict")[0] == ["a", "b", "c"]
    assert diagnosed(asked)[0] == []


def task_of(asked: Fleet, files: Sequence[Path] | None = None, **options: Any) -> Task:
    """The task of robot a."""
    chosen = dataclasses.replace(asked.options, **options)
    return Task(RobotLogs("a", tuple(files or asked.found.robots[0].files)), chosen, options_digest(chosen))


@pytest.fixture
def task(asked: Fleet) -> Task:
    """The task of robot a, which is done."""
    task = task_of(asked)
    write_result(RobotResult("a", not_diagnosed(task, "").document | {"status": "diagnosed"}), asked.out)
    return task


@pytest.mark.parametrize(
    ("changes", "same"),
    [
        ({}, True),
        ({"status": "unreadable"}, True),
        ({"status": "failed"}, False),
        ({"digest": "of another model"}, False),
        ({"format": 0}, False),
        ({"files": []}, False),
    ],
)
def test_a_result_is_kept_with_the_same_inputs_and_a_verdict(
    asked: Fleet, task: Task, changes: dict[str, Any], same: bool
) -> None:
    document = not_diagnosed(task, "").document | {"status": "diagnosed"} | changes
    write_result(RobotResult("a", document), asked.out)
    assert kept(task, asked.out) is same


def test_a_result_that_is_missing_or_broken_is_not_kept(asked: Fleet, task: Task) -> None:
    assert not kept(task_of(asked), asked.out.parent)
    (asked.out / "robots" / "a" / "result.json").write_text("{", encoding="utf-8")
    assert read_result(asked.out / "robots" / "a") is None
    assert not kept(task, asked.out)


def test_copies_with_another_time_or_in_another_folder_are_the_same_recordings(
    asked: Fleet, task: Task, tmp_path: Path
) -> None:
    os.utime(task.robot.files[0], ns=(1, 1))
    assert kept(task_of(asked), asked.out)
    moved = (tmp_path / "recordings" / "a").rename(tmp_path / "archive")
    (tmp_path / "model.toml").rename(moved / "model.toml")
    assert kept(task_of(asked, sorted(moved.glob("*.csv")), model=str(moved / "model.toml")), asked.out)


def test_changed_contents_of_the_same_size_and_fewer_recordings_are_diagnosed_again(asked: Fleet, task: Task) -> None:
    path = task.robot.files[0]
    assert not kept(task_of(asked, [path]), asked.out)
    path.write_bytes(path.read_bytes()[:-2] + b"9\n")
    os.utime(path, ns=(1, 1))
    assert not kept(task_of(asked), asked.out)


@pytest.mark.parametrize("options", [{"horizon": 0.5}, {"columns": "dart_car_columns"}, {}])
def test_another_horizon_column_map_or_model_is_diagnosed_again(
    asked: Fleet, task: Task, options: dict[str, Any]
) -> None:
    if not options:
        text = write_model(load_model("car")) + '\n[[effects]]\nname = "steering_offset"\nangle = 0.01\n'
        Path(asked.options.model).write_text(text, encoding="utf-8")
    other = task_of(asked, **options)
    assert other.digest != task.digest
    assert not kept(other, asked.out)


def test_half_written_folders_and_robots_that_are_gone_are_removed(asked: Fleet, task: Task) -> None:
    write_result(RobotResult("z", not_diagnosed(task, "").document), asked.out)
    for name in (".a.123.part", "mine"):
        (asked.out / "robots" / name).mkdir()
    clear_others([task], asked.out)
    assert sorted(path.name for path in (asked.out / "robots").iterdir()) == ["a", "mine"]


def test_a_folder_that_cannot_be_written_is_reported_with_the_option(asked: Fleet, tmp_path: Path) -> None:
    (tmp_path / "robots").write_text("in the way", encoding="utf-8")
    with pytest.raises(RecordingError, match="--out"):
        write_result(not_diagnosed(task_of(asked), ""), tmp_path)


def test_a_robot_without_a_readable_file_has_a_line_with_the_reason(asked: Fleet) -> None:
    result = diagnosed_robot(task_of(asked))
    assert result.document["status"] == "unreadable"
    assert "column" in result.document["reason"]
    assert len(result.document["unreadable_files"]) == 2
    assert set(result.texts) == set()


def test_a_model_in_the_folder_of_the_results_is_refused(asked: Fleet, tmp_path: Path) -> None:
    for place in (tmp_path / "model.toml", asked.out / "given.toml", asked.out / "model.toml"):
        place.parent.mkdir(exist_ok=True)
        place.write_text(write_model(load_model("car")), encoding="utf-8")
        fleet = Fleet(asked.found, Options(str(place)), asked.out)
        if place != asked.out / "model.toml":
            assert len(diagnosed(fleet, anew=True)[0]) == 3
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
    assert given["one"][0] == tmp_path / "all" / "alone.mcap", "a recording of one robot is used where it is"
    pieces = {path: path.stat().st_mtime_ns for path in (tmp_path / "out" / "recordings").rglob("*.mcap")}
    assert set(pieces) == {path for files in given.values() for path in files} - {given["one"][0]}
    assert len({path.parent for path in pieces}) == 2, "one folder for each recording"
    assert diagnosed(fleet)[0] == []
    assert {path: path.stat().st_mtime_ns for path in pieces} == pieces
    assert not [path for path in (tmp_path / "out").rglob("*") if path.name.startswith(".")]
    assert json.loads((tmp_path / "out" / "fleet.json").read_text(encoding="utf-8"))["by"] == "robot"
