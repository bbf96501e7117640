"""``safedpa export``: what a person sees, and the table that comes out."""

from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest

from safedpa.bus.messages.codec import encode
from safedpa.bus.messages.messages import StateMessage, VerdictMessage
from safedpa.bus.messages.topics import STATE, VERDICT, key_of
from safedpa.errors import RunError
from safedpa.records import McapRecorder, load_run, read_run_from_mcap
from safedpa.records.readers.mcap import read_payloads
from safedpa.records.writers.tables import export_recording
from safedpa.robots.car.system import CAR
from safedpa_services.command_line.group import safedpa

STAMP = {"epoch": 3, "publish_time": 0.0}


def record(path: Path, robots: tuple[str, ...] = ("one",), ticks: int = 40) -> None:
    with McapRecorder(path) as recorder:
        for tick in range(ticks):
            t = 0.05 * tick
            state = StateMessage(
                **STAMP,
                tick=tick,
                robot_time=t,
                values=(np.sin(t), 1 - np.cos(t), t, 1.0 + 0.01 * np.sin(t)),
                applied=(1.0 + 0.1 * np.sin(t), 0.3 * np.cos(t)),
                applied_by="filter",
                period=0.05,
                lockstep=True,
                goal=(0.0, 0.0),
                obstacles=(),
                field=(-4.0, 4.0, -4.0, 4.0),
                footprint=(0.1, 0.4, 0.1),
            )
            verdict = VerdictMessage(
                **STAMP,
                tick=tick,
                robot_time=t,
                status="corrected",
                sentence="corrected: too near",
                action=(1.0, 0.0),
                nominal=(),
                slack=0.01 * tick,
                active=(),
                h_now=1.0,
                h_next=0.9,
                margin=0.05,
                solver="solved",
                microseconds=1.0,
            )
            for robot in robots:
                recorder.write(key_of("fleet", robot, STATE), encode(state), tick, 0)
                if tick != 7:
                    recorder.write(key_of("fleet", robot, VERDICT), encode(verdict), tick, 0)


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_an_exported_drive_is_read_back_equal(tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    record(tmp_path / "drive.mcap")
    out = tmp_path / "tables" / f"drive.{kind}"
    assert safedpa.run(["export", str(tmp_path / "drive.mcap"), "--format", kind, "--out", str(out)]) == 0
    assert capsys.readouterr().out == f"{out}: 39 rows of robot 'one'\n"
    direct, exported = read_run_from_mcap(tmp_path / "drive.mcap", CAR), load_run(out, CAR)
    for name in ("t", "states", "actions"):
        np.testing.assert_array_equal(getattr(direct, name), getattr(exported, name))
    assert [entry.name for entry in out.parent.iterdir()] == [out.name]


def test_the_verdicts_are_in_the_rows_of_their_ticks(tmp_path: Path) -> None:
    record(tmp_path / "drive.mcap")
    out = tmp_path / "drive.parquet"
    assert safedpa.run(["export", str(tmp_path / "drive.mcap"), "--format", "parquet", "--out", str(out)]) == 0
    table = pyarrow.parquet.read_table(out)
    assert table.column_names[-5:] == ["status", "slack", "h_now", "h_next", "margin"]
    assert table["status"].to_pylist() == ["corrected"] * 7 + [None] + ["corrected"] * 31
    assert table["slack"].to_pylist()[8] == pytest.approx(0.08)


def test_bad_input_exits_with_2_and_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(tmp_path / "drive.mcap", ("one", "two"))
    out = tmp_path / "drive.csv"
    arguments = ["export", str(tmp_path / "drive.mcap"), "--format", "csv", "--out", str(out)]
    assert safedpa.run(arguments) == 2
    assert "holds 2 robots: one, two" in capsys.readouterr().err
    assert not out.exists()
    assert safedpa.run([*arguments, "--robot", "two"]) == 0
    assert safedpa.run(["export", str(tmp_path / "no.mcap"), *arguments[2:]]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert "no such file" in lines[0]


def test_a_place_that_cannot_be_written_changes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(tmp_path / "drive.mcap")
    (tmp_path / "file").write_text("retained")
    arguments = ["export", str(tmp_path / "drive.mcap"), "--format", "csv", "--out", str(tmp_path / "file" / "x.csv")]
    assert safedpa.run(arguments) == 1
    assert "cannot be written" in capsys.readouterr().err
    assert (tmp_path / "file").read_text() == "retained"


@pytest.mark.parametrize(("ticks", "rows"), [((0, 1), 1), ((0, 2, 4), 0), ((3,), 0)])
def test_an_export_needs_two_ticks_in_a_row(ticks: tuple[int, ...], rows: int, tmp_path: Path) -> None:
    record(tmp_path / "whole.mcap", ticks=5)
    found = read_payloads(tmp_path / "whole.mcap")
    states = [(key, payload) for key, _, _, payload in found if key.endswith("state")]
    with McapRecorder(tmp_path / "a.mcap") as recorder:
        for tick in ticks:
            recorder.write(*states[tick], tick, 0)
    if rows:
        assert export_recording(tmp_path / "a.mcap", tmp_path / "a.csv", "csv").rows == rows
    else:
        with pytest.raises(RunError, match="robot 'one' has no two consecutive ticks"):
            export_recording(tmp_path / "a.mcap", tmp_path / "a.csv", "csv")


def test_a_cut_off_recording_is_exported_with_a_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "drive.mcap"
    record(path, ticks=400)
    path.write_bytes(path.read_bytes()[:-3000])
    out = tmp_path / "drive.csv"
    assert safedpa.run(["export", str(path), "--format", "csv", "--out", str(out)]) == 0
    assert "cut_off: the recording was not closed" in capsys.readouterr().err
    assert len(load_run(out, CAR).t) > 200
