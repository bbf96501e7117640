"""Which recordings are whose: folders, files, and recordings of many robots."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from safedpa.bus.wire.codec import encode
from safedpa.bus.wire.messages import StateMessage
from safedpa.bus.wire.topics import STATE, key_of
from safedpa.errors import InputError
from safedpa.fleet.robot_recordings import robots_in, split_recording
from safedpa.fleet.robots import robots_in_folder, robots_of_files
from safedpa.records import McapRecorder, read_run_from_mcap
from safedpa.robots.car.system import CAR


def record(path: Path, robots: tuple[str, ...], ticks: int = 60) -> Path:
    with McapRecorder(path) as recorder:
        for tick in range(ticks):
            for number, robot in enumerate(robots):
                t = 0.05 * tick
                state = StateMessage(
                    epoch=3, publish_time=0.0, tick=tick, robot_time=t,
                    values=(np.sin(t), 1 - np.cos(t), t, 1.0 + 0.1 * number),
                    applied=(1.0 + 0.1 * np.sin(t), 0.3 * np.cos(t)), applied_by="filter",
                    period=0.05, lockstep=True, goal=(), obstacles=(), field=(), footprint=(),
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
    touched(
        tmp_path / "a" / "1.csv", tmp_path / "a" / "may" / "2.parquet", tmp_path / "b" / "1.csv", tmp_path / "x.csv"
    )
    touched(tmp_path / "b" / "notes.txt", tmp_path / "b" / ".hidden.csv", tmp_path / ".trash" / "1.csv")
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
    pieces = split_recording(cut, tmp_path / "pieces")
    assert 100 < len(read_run_from_mcap(pieces["one"], CAR).t) < 2000


def test_what_is_no_recording_is_left_out_with_a_reason(tmp_path):
    record(tmp_path / "all.mcap", ("one", "two"))
    touched(tmp_path / "notes.mcap", tmp_path / "table.csv")
    found = robots_in_folder(tmp_path, "robot")
    assert sorted(path.name for path, _ in found.left_out) == ["notes.mcap", "table.csv"]


def test_nothing_to_find_is_bad_input(tmp_path):
    with pytest.raises(InputError, match="holds no recording"):
        robots_in_folder(tmp_path)
    with pytest.raises(InputError, match="is no folder"):
        robots_in_folder(tmp_path / "none")
    touched(tmp_path / "a.csv")
    with pytest.raises(InputError, match="--by file"):
        robots_in_folder(tmp_path, "folder")
    with pytest.raises(InputError, match="no MCAP file"):
        robots_in_folder(tmp_path, "robot")
    with pytest.raises(InputError, match="--fleet"):
        robots_of_files([])
