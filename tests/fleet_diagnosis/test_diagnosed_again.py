"""Which recordings are whose, which robots are diagnosed again, how results are replaced, what all robots have."""

import dataclasses
import json
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.messages import stamp, state_of

from safedpa.bus.messages.codec import encode
from safedpa.bus.messages.topics import STATE, key_of
from safedpa.dynamics import load_model, write_model
from safedpa.errors import InputError, RecordingError
from safedpa.fleet import Fleet, Options, RobotLogs, diagnose_fleet
from safedpa.fleet.one_robot import RobotResult, Task, diagnose_robot, failed_result, options_digest
from safedpa.fleet.results import clear_others, has_current_result, read_result, write_result
from safedpa.fleet.robots import DiscoveredRobots, robots_in, robots_in_folder, robots_of_files, split_recording
from safedpa.records import McapRecorder, read_run_from_mcap
from safedpa.robots.car.system import CAR
from safedpa_lab.hidden import Case, write_cases


def record(path: Path, robots: tuple[str, ...], ticks: int = 60) -> Path:
    with McapRecorder(path) as recorder:
        for tick in range(ticks):
            for number, robot in enumerate(robots):
                t = 0.05 * tick
                state = state_of(
                    np.sin(t), 1 - np.cos(t), t, 1.0 + 0.1 * number, **stamp(tick),
                    applied=(1.0 + 0.1 * np.sin(t), 0.3 * np.cos(t)),
                )  # fmt: skip
                recorder.write(key_of("fleet", robot, STATE), encode(state), int(1e9 * t), int(1e9 * t))
    return path


def touched(*paths: Path) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("t\n0\n", encoding="utf-8")


def named(found):
    return {robot.name: sorted(path.name for path in robot.files) for robot in found.robots}


def test_each_folder_is_a_robot_with_all_below_it(tmp_path):
    names = ("a/1.csv", "a/may/2.parquet", "b/1.csv", "x.csv", "b/notes.txt", "b/.hidden.csv", ".trash/1.csv")
    touched(*(tmp_path / name for name in names))
    found = robots_in_folder(tmp_path)
    assert found.by == "folder"
    assert named(found) == {"a": ["1.csv", "2.parquet"], "b": ["1.csv"]}
    assert [path.name for path, _ in found.left_out] == ["x.csv"]


def test_each_file_is_a_robot(tmp_path):
    touched(tmp_path / "a.csv", tmp_path / "a.parquet", tmp_path / "b.csv")
    assert named(robots_in_folder(tmp_path)) == {"a": ["a.csv"], "a.parquet": ["a.parquet"], "b": ["b.csv"]}
    touched(tmp_path / "c" / "a.csv")
    assert "c_a" in named(robots_in_folder(tmp_path, "file"))


def test_what_a_diagnosis_wrote_is_no_recording(tmp_path):
    touched(tmp_path / "a" / "1.csv", tmp_path / "out" / "recordings" / "x.mcap", tmp_path / "out" / "fleet.json")
    assert named(robots_in_folder(tmp_path)) == {"a": ["1.csv"]}


def test_files_that_are_named_one_by_one(tmp_path):
    paths = [tmp_path / "a" / "1.csv", tmp_path / "a" / "2.csv", tmp_path / "b" / "1.csv"]
    touched(*paths)
    assert named(robots_of_files(paths)) == {"a": ["1.csv", "2.csv"], "b": ["1.csv"]}
    assert named(robots_of_files(paths[:2])) == {"a_1": ["1.csv"], "a_2": ["2.csv"]}
    assert named(robots_of_files(paths[:2], "folder")) == {"a": ["1.csv", "2.csv"]}


def test_one_recording_of_many_robots(tmp_path):
    record(tmp_path / "all.mcap", ("one", "two"))
    record(tmp_path / "more.mcap", ("two", "three"))
    found = robots_in_folder(tmp_path)
    assert found.by == "robot"
    assert named(found) == {"one": ["all.mcap"], "three": ["more.mcap"], "two": ["all.mcap", "more.mcap"]}


def test_recordings_of_one_robot_each_are_robots_by_file_though_all_call_it_car(tmp_path):
    for name in ("monday", "tuesday"):
        record(tmp_path / f"{name}.mcap", ("car",))
    assert named(robots_in_folder(tmp_path)) == {"monday": ["monday.mcap"], "tuesday": ["tuesday.mcap"]}
    assert named(robots_in_folder(tmp_path, "robot")) == {"car": ["monday.mcap", "tuesday.mcap"]}


def test_each_piece_of_a_split_recording_is_that_robots_run(tmp_path):
    whole = record(tmp_path / "all.mcap", ("one", "two", "three"))
    pieces = split_recording(whole, tmp_path / "pieces")
    assert sorted(pieces) == ["one", "three", "two"]
    for robot, piece in pieces.items():
        before, after = read_run_from_mcap(whole, CAR, robot), read_run_from_mcap(piece, CAR)
        np.testing.assert_array_equal(before.states, after.states)
        np.testing.assert_array_equal(before.actions, after.actions)
        np.testing.assert_array_equal(before.t, after.t)


def test_a_recording_that_was_cut_off_gives_what_is_there(tmp_path):
    whole = record(tmp_path / "all.mcap", ("one", "two"), 2000)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size * 2 // 3])
    assert robots_in(cut) == (["one", "two"], "")
    assert 100 < len(read_run_from_mcap(split_recording(cut, tmp_path / "pieces")["one"], CAR).t) < 2000


def test_what_is_no_recording_is_left_out_with_a_reason(tmp_path):
    record(tmp_path / "all.mcap", ("one", "two"))
    touched(tmp_path / "notes.mcap", tmp_path / "table.csv")
    found = robots_in_folder(tmp_path, "robot")
    assert sorted(path.name for path, _ in found.left_out) == ["notes.mcap", "table.csv"]


def test_nothing_to_find_is_bad_input(tmp_path):
    with pytest.raises(InputError, match="contains no recording"):
        robots_in_folder(tmp_path)
    with pytest.raises(InputError, match="is not a folder"):
        robots_in_folder(tmp_path / "none")
    touched(tmp_path / "a.csv")
    with pytest.raises(InputError, match="--by file"):
        robots_in_folder(tmp_path, "folder")
    with pytest.raises(InputError, match="no MCAP file"):
        robots_in_folder(tmp_path, "robot")
    with pytest.raises(InputError, match="--fleet"):
        robots_of_files([])


class Hands:
    """Workers that record which robots are diagnosed, each with the same status."""

    def __init__(self, status: str = "unreadable") -> None:
        self.did: list[Task] = []
        self.status = status

    def __call__(self, _work: Any, jobs: Sequence[Any], _failed: Callable[..., Any]) -> Iterator[Any]:
        for job in jobs:
            self.did.append(job)
            document = failed_result(job, "made up").document | {"status": self.status}
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
    return Fleet(DiscoveredRobots(tuple(robots), "folder"), Options(str(tmp_path / "model.toml")), tmp_path / "out")


def diagnosed(asked: Fleet, *, status: str = "unreadable", again: bool = False) -> tuple[list[str], Any]:
    """Names of the robots that were diagnosed now, and the progress that was reported."""
    hands, progress = Hands(status), list[tuple[int, int]]()
    document = diagnose_fleet(asked, hands, lambda now, whole: progress.append((now, whole)), again=again)
    assert document["diagnosed_now"] == len(hands.did)
    return [task.robot.name for task in hands.did], progress


def test_only_new_or_changed_robots_are_diagnosed_unless_all_are_wanted_again(asked: Fleet) -> None:
    assert diagnosed(asked) == (["a", "b", "c"], [(0, 3), (1, 3), (2, 3), (3, 3)])
    assert diagnosed(asked) == ([], [(3, 3)])
    asked.found.robots[1].files[0].write_text("t,x\n0,another\n", encoding="utf-8")
    assert diagnosed(asked) == (["b"], [(2, 3), (3, 3)])
    assert diagnosed(asked, again=True) == (["a", "b", "c"], [(0, 3), (1, 3), (2, 3), (3, 3)])


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
    write_result(RobotResult("a", failed_result(task, "").document | {"status": "diagnosed"}), asked.out)
    return task


@pytest.mark.parametrize(
    ("changes", "same"),
    [
        ({}, True), ({"status": "unreadable"}, True), ({"status": "failed"}, False),
        ({"digest": "of another model"}, False), ({"format": 0}, False), ({"files": []}, False),
    ],
)  # fmt: skip
def test_a_result_is_kept_with_the_same_inputs_and_a_verdict(asked, task, changes, same):
    document = failed_result(task, "").document | {"status": "diagnosed"} | changes
    write_result(RobotResult("a", document), asked.out)
    assert has_current_result(task, asked.out) is same


def test_a_result_that_is_missing_or_broken_is_not_kept(asked: Fleet, task: Task) -> None:
    assert not has_current_result(task_of(asked), asked.out.parent)
    (asked.out / "robots" / "a" / "result.json").write_text("{", encoding="utf-8")
    assert read_result(asked.out / "robots" / "a") is None
    assert not has_current_result(task, asked.out)


def test_copies_with_another_time_or_in_another_folder_are_the_same_recordings(asked, task, tmp_path):
    os.utime(task.robot.files[0], ns=(1, 1))
    assert has_current_result(task_of(asked), asked.out)
    moved = (tmp_path / "recordings" / "a").rename(tmp_path / "archive")
    (tmp_path / "model.toml").rename(moved / "model.toml")
    assert has_current_result(task_of(asked, sorted(moved.glob("*.csv")), model=str(moved / "model.toml")), asked.out)


def test_changed_contents_of_the_same_size_and_fewer_recordings_are_diagnosed_again(asked: Fleet, task: Task) -> None:
    path = task.robot.files[0]
    assert not has_current_result(task_of(asked, [path]), asked.out)
    path.write_bytes(path.read_bytes()[:-2] + b"9\n")
    os.utime(path, ns=(1, 1))
    assert not has_current_result(task_of(asked), asked.out)


@pytest.mark.parametrize("options", [{"horizon": 0.5}, {"columns": "dart_car_columns"}, {}])
def test_another_horizon_column_map_or_model_is_diagnosed_again(asked, task, options):
    if not options:
        text = write_model(load_model("car")) + '\n[[effects]]\nname = "steering_offset"\nangle = 0.01\n'
        Path(asked.options.model).write_text(text, encoding="utf-8")
    other = task_of(asked, **options)
    assert other.digest != task.digest
    assert not has_current_result(other, asked.out)


def test_half_written_folders_and_robots_that_are_gone_are_removed(asked: Fleet, task: Task) -> None:
    write_result(RobotResult("z", failed_result(task, "").document), asked.out)
    for name in (".a.123.part", "mine"):
        (asked.out / "robots" / name).mkdir()
    clear_others([task], asked.out)
    assert sorted(path.name for path in (asked.out / "robots").iterdir()) == ["a", "mine"]


def test_a_folder_that_cannot_be_written_is_reported_with_the_option(asked: Fleet, tmp_path: Path) -> None:
    (tmp_path / "robots").write_text("in the way", encoding="utf-8")
    with pytest.raises(RecordingError, match="--out"):
        write_result(failed_result(task_of(asked), ""), tmp_path)


def test_a_robot_without_a_readable_file_has_a_line_with_the_reason(asked: Fleet) -> None:
    result = diagnose_robot(task_of(asked))
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
            assert len(diagnosed(fleet, again=True)[0]) == 3
            continue
        with pytest.raises(InputError, match="contains the given model"):
            diagnose_fleet(fleet, Hands())
        assert place.read_text(encoding="utf-8") == write_model(load_model("car"))


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


def result(name: str, number: int, texts: dict[str, str]) -> RobotResult:
    document: dict[str, Any] = {"robot": name, "number": number}
    return RobotResult(name, document, texts)


def held(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text(encoding="utf-8") for path in folder.iterdir()}


def test_a_result_takes_the_place_of_the_one_before(tmp_path: Path) -> None:
    folder = tmp_path / "robots"
    for number, texts in enumerate(({"a.md": "first", "b.md": "only in the first"}, {"a.md": "second"}, {})):
        write_result(result("r1", number, texts), tmp_path)
        files = held(folder / "r1")
        assert json.loads(files.pop("result.json")) == {"robot": "r1", "number": number}
        assert files == texts
        assert [path.name for path in folder.iterdir()] == ["r1"], "nothing of the former, and no part"
    write_result(result("r2", 7, {}), tmp_path)
    assert sorted(path.name for path in folder.iterdir()) == ["r1", "r2"]


def test_where_it_cannot_be_written_the_one_before_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_result(result("r1", 1, {"a.md": "first"}), tmp_path)
    before, folder = held(tmp_path / "robots" / "r1"), tmp_path / "robots"

    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, os.strerror(28))

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_text", full)
        with pytest.raises(RecordingError, match="cannot be written"):
            write_result(result("r1", 2, {"a.md": "second"}), tmp_path)
    assert (held(folder / "r1"), [path.name for path in folder.iterdir()]) == (before, ["r1"])
    assert read_result(folder / "r2") is None


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
        if work is not diagnose_robot:
            yield work(job)
            continue
        document = {
            "format": 1, "robot": job.robot.name, "status": "diagnosed", "reason": "", "digest": job.digest,
            "files": [], "unreadable_files": [],
        }  # fmt: skip
        yield RobotResult(job.robot.name, document, {"report.json": json.dumps(report(int(job.robot.name[1:])))})


def fleet_of(recordings, out):
    robots = tuple(RobotLogs(f"r{i}", tuple(log.runs)) for i, log in enumerate(recordings))
    return Fleet(DiscoveredRobots(robots, "folder"), Options(str(recordings[0].model)), out)


def test_the_updated_model_is_tried_with_the_others_numbers_and_written(recordings, tmp_path):
    document = diagnose_fleet(fleet_of(recordings, tmp_path), workers)
    common = document["common"]
    assert common["model"] == "model.toml"
    (found,) = common["effects"]
    assert found["confirmed"]["better"] == found["confirmed"]["robots"] == 8
    assert found["confirmed"]["after"] < 0.3 * found["confirmed"]["before"]
    model = load_model(tmp_path / "model.toml")
    assert np.isclose(model.settings["quadratic_drag.coefficient"].value, DRAG, atol=0.002)
    assert "Correct the model file" in (tmp_path / "fleet.html").read_text(encoding="utf-8")


def test_a_model_of_an_earlier_fleet_does_not_stay(recordings, tmp_path):
    (tmp_path / "model.toml").write_text("old", encoding="utf-8")
    assert diagnose_fleet(fleet_of(recordings[:3], tmp_path), workers)["common"] is None  # three are no fleet
    assert not (tmp_path / "model.toml").exists()


def test_a_model_that_does_not_help_is_not_written(recordings, tmp_path):

    def doubtful(work, jobs, failed):
        if work is diagnose_robot:
            yield from workers(work, jobs, failed)
        else:
            yield from ((job.robot.name, 0.4) for job in jobs)

    assert diagnose_fleet(fleet_of(recordings, tmp_path), doubtful)["common"]["model"] is None
    assert not (tmp_path / "model.toml").exists()
    assert "does not belong to the model" in (tmp_path / "fleet.html").read_text(encoding="utf-8")
