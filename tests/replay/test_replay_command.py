"""``safedpa replay`` as a person runs it: sentences, exit codes, files."""

import csv
import dataclasses
import json
from pathlib import Path

import pytest

from safedpa.bus import SETUP, VERDICT, SetupMessage, VerdictMessage, decode, encode
from safedpa.records import McapRecorder
from safedpa.records.readers.mcap import read_payloads
from safedpa_services.command_line.group import safedpa

BOX = str(Path(__file__).parent / "golden" / "car_box.mcap")


def forged(path: Path) -> Path:
    """The box drive with one verdict that was never given."""
    with McapRecorder(path) as recorder:
        for key, at, topic, payload in read_payloads(BOX):
            recorder.write(key, other(payload) if topic is VERDICT else payload, at, at)
    return path


def aged(path: Path) -> Path:
    """The box drive, recorded with settings that only an older program had."""
    with McapRecorder(path) as recorder:
        for key, at, topic, payload in read_payloads(BOX):
            if topic is SETUP:
                setup = decode(SetupMessage, payload)
                former = "slack_tolerance = 0.0001\nslack_linear = 10000.0\n" if setup.settings else ""
                recorder.write(key, encode(dataclasses.replace(setup, settings=setup.settings + former)), at, at)
            else:
                recorder.write(key, payload, at, at)
    return path


def with_own_policy(path: Path) -> Path:
    """The box drive, as if the nominal actions came from the robot's own policy, which is no service."""
    with McapRecorder(path) as recorder:
        for key, at, topic, payload in read_payloads(BOX):
            if topic is not SETUP or decode(SetupMessage, payload).service != "policy":
                recorder.write(key, payload, at, at)
    return path


def other(payload: bytes) -> bytes:
    verdict = decode(VerdictMessage, payload)
    changed = dataclasses.replace(verdict, status="passed", sentence="all is well", slack=1.0)
    return encode(changed) if verdict.tick == 30 else payload


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    code = safedpa.run(["replay", *arguments])  # type: ignore[attr-defined]
    out, err = capsys.readouterr()
    return code, out, err


def test_an_identical_recording(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, BOX)
    assert code == 0
    assert "verdict 120 of 120" in out
    code, out, _ = run(capsys, BOX, "--json", "--from", "1", "--to", "2.999")
    document = json.loads(out)
    assert code == 0
    assert document["agrees"] is True
    assert document["services"][2]["compared"] == {"verdict": 40, "action": 40}


def test_a_forged_verdict_is_named_with_tick_field_and_both_values(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    path = str(forged(tmp_path / "forged.mcap"))
    code, out, _ = run(capsys, path)
    assert code == 1
    assert "tick 30 (1.50 s) verdict.slack: recorded 1.0, replayed 0.0" in out
    assert out.rstrip().endswith("DIFFERENT")
    code, out, _ = run(capsys, path, "--json")
    assert code == 1
    assert {"verdict.slack", "verdict.sentence"} <= {
        f"{item['topic']}.{item['field']}" for item in json.loads(out)["differences"]
    }


def test_what_if_is_only_looked_at(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    table = tmp_path / "ticks.csv"
    code, out, _ = run(capsys, BOX, "--margin", "0.2", "--out", str(table))
    assert code == 0
    assert "RECORDED states (open loop" in out
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert len(rows) == 120
    assert any(row["status_then"] != row["status_now"] for row in rows)
    code, out, _ = run(capsys, BOX, "--eta", "0.1", "--json")
    assert code == 0
    assert json.loads(out)["summary"]["ticks"] == 120


@pytest.mark.parametrize("how", [(), ("--eta", "0.1"), ("--closed-loop",)])
def test_settings_of_an_older_program_are_left_out_and_named_once(capsys, tmp_path, how):
    path = str(aged(tmp_path / "aged.mcap"))
    code, out, _ = run(capsys, path, *how)
    assert code == 0
    assert out.count("former_settings: slack_tolerance, slack_linear: ") == out.count("slack_tolerance") == 1
    assert ("identical: every field of every message" in out) is (how == ())
    code, out, _ = run(capsys, path, *how, "--json")
    assert code == 0
    assert [finding["kind"] for finding in json.loads(out)["findings"]] == ["former_settings"]


def test_the_closed_loop_is_reported_as_text(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, BOX, "--closed-loop")
    assert code == 0
    assert "the drive is identical" in out


def test_what_was_replayed_can_be_replayed(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    again = str(tmp_path / "again.mcap")
    assert run(capsys, BOX, "--out", again)[0] == 0
    code, out, _ = run(capsys, again)
    assert code == 0
    assert "identical" in out


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("nowhere.mcap",), "nowhere.mcap"),
        ((BOX, "--robot", "r2"), "known: r1"),
        ((BOX, "--from", "3", "--to", "2"), "wanted a start before the end"),
        ((BOX, "--eta", "7"), "eta"),
        ((BOX, "--model", "pendulum"), "2 states"),
        ((BOX, "--margin", "nothing.toml"), "nothing.toml"),
        ((BOX, "--out", "table.csv"), "wanted .mcap"),
        ((BOX, "--eta", "0.1", "--out", "table.txt"), "wanted .csv"),
    ],
)
def test_bad_input_is_answered_in_one_line(capsys, arguments, sentence):
    code, _, err = run(capsys, *arguments)
    assert code == 2
    assert sentence in err
    assert err.count("\n") == 1


def test_a_margin_that_ships_is_known_by_its_name(capsys: pytest.CaptureFixture[str]) -> None:
    code, notice, _ = run(capsys, BOX, "--margin", "car")
    assert code == 0
    assert "decided differently in 0 of 120 ticks" in notice


def test_a_recording_opens_in_the_viewer(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="Rerun is not installed")
    drawn = tmp_path / "drive.rrd"
    assert run(capsys, BOX, "--rrd", str(drawn), "--to", "0.5")[0] == 0
    assert drawn.read_bytes()[:3] == b"RRF"
    assert drawn.stat().st_size > 50_000


@pytest.mark.parametrize(
    ("run_of", "out", "refused"),
    [
        ("drives", "drives/new.mcap", True),  # it would be read as one more file of the run
        ("drives", "drives/a.mcap", True),
        ("drives", "drives/report.json", False),
        ("drives", "elsewhere/new.mcap", False),
        ("drives", "new.mcap", False),
        ("drives/a.mcap", "drives/a.mcap", True),
        ("drives/a.mcap", "drives/new.mcap", False),  # the file alone is the run
        ("drives/a.mcap", "drives/../drives/a.mcap", True),
    ],
)
def test_a_recording_is_not_written_into_the_run_that_is_read(
    run_of: str, out: str, refused: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """The recordings are empty, which is noticed later."""
    monkeypatch.chdir(tmp_path)
    Path("drives").mkdir()
    for name in ("a", "b"):
        Path(f"drives/{name}.mcap").touch()
    code, _, err = run(capsys, run_of, "--out", out)
    assert code == 2
    assert ("would count as a recording of this run" in err) is refused
    assert ("the file is empty" in err) is not refused


def test_nominal_actions_of_the_robots_own_policy_are_accepted_as_recorded(capsys, tmp_path: Path) -> None:
    code, out, _ = run(capsys, str(with_own_policy(tmp_path / "own.mcap")))
    assert code == 0
    assert "policy: no setup was recorded; its outputs are accepted as recorded" in out
    assert "identical: every field" in out
    recorded = [decode(VerdictMessage, payload) for _, _, topic, payload in read_payloads(BOX) if topic is VERDICT]
    assert f"smallest h_now {min(verdict.h_now for verdict in recorded):.3g}\n" in out
    assert f" {sum(verdict.status == 'passed' for verdict in recorded)} passed" in out
