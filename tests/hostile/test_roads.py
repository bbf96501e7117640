"""Bombs on every road that a file takes into the product: one line, exit code 2, little memory, nothing written."""

from dataclasses import replace
from pathlib import Path

import pytest

from safedpa.dynamics import load_model, write_model
from safedpa.errors import InputError
from safedpa_lab.experiments.hostile.bombs import BOMBS, Bomb
from safedpa_lab.experiments.hostile.roads import MOST_MEBIBYTES, ROADS, Outcome, Road, pairs, prepare, tried
from safedpa_services.command_line.group import COMMANDS, safedpa

pytestmark = pytest.mark.processes
READ_NO_FILE_OF_OTHERS = {
    "accept", "certificates", "demo", "dismiss", "effects", "go", "reject", "roll-back", "sense", "status", "stop",
    "check",  # runs the Python file that it is given
    "screenshot",  # hands the file to the Rerun viewer
}  # fmt: skip

QUICK = {
    "arrays in arrays", "a key of 50 000 parts in a column map", "5000 columns", "a description of 2 GB",
    "a chunk that says 2^63 bytes", "300 definitions of 27 KB", "topics without numbers", "a message made of itself",
    "a million empty records", "tables merged into tables", "arrays in the header",
}  # fmt: skip
"""One bomb of each ending, made quickly."""


def sample() -> list[tuple[Road, Bomb]]:
    """Each road once and each ending once."""
    bombs, found, turn = {bomb.ending: bomb for bomb in BOMBS if bomb.name in QUICK}, [], 0
    for road in ROADS:
        found.append((road, bombs[road.endings[turn % len(road.endings)]]))
        turn += len(road.endings) > 1
    return found


@pytest.fixture(scope="module", autouse=True)
def _imported() -> None:
    prepare()


@pytest.mark.parametrize(("road", "bomb"), sample(), ids=lambda item: getattr(item, "name", ""))
def test_a_bomb_is_refused_on_its_road(road: Road, bomb: Bomb) -> None:
    found = tried(road, bomb, bomb.make())
    assert not found.hole
    assert found.mebibytes < MOST_MEBIBYTES


def test_the_sample_meets_every_road_and_every_kind_of_bag() -> None:
    chosen = sample()
    assert [road for road, _ in chosen] == list(ROADS)
    assert {bomb.ending for _, bomb in chosen} >= {".toml", ".map", ".json", ".safetensors", ".bag", ".db3", ".ulg"}
    everything = list(pairs())
    assert {road for road, _ in everything} == set(ROADS)
    never = {bomb.ending for bomb in BOMBS} - {bomb.ending for _, bomb in everything}
    assert never == {".npz", ".msgpack"}, "files of our own making, and messages: no one hands them to a command"


def test_every_command_that_reads_a_file_has_a_road() -> None:
    walked = {road.name.split(":")[0].split(" ")[0] for road in ROADS}
    assert walked == set(COMMANDS) - READ_NO_FILE_OF_OTHERS


def test_what_is_wrong_with_a_road_is_seen() -> None:
    """Each way of not refusing as one should is reported as such; a good model is taken."""
    road, bomb = next(pair for pair in sample() if pair[0].name == "compare: model")
    taken = tried(road, bomb, write_model(load_model("car")).encode())
    assert taken.hole.startswith("exit code 0")
    assert "out/compare.html" in taken.written
    refused = Outcome("compare: model", "toml: x", 2, "safedpa: no\n", 0.1, 1.0, ())
    assert not refused.hole
    for wrong in (
        {"code": 1},
        {"notice": "no\nTraceback\n"},
        {"notice": ""},
        {"notice": "\x1b[2J\n"},
        {"notice": "x" * 2000 + "\n"},
        {"mebibytes": 300.0},
        {"written": ("out",)},
    ):
        assert replace(refused, **wrong).hole


@pytest.mark.parametrize("command", ["compare", "diagnose"])
def test_a_refused_recording_leaves_no_folder_behind(command: str, tmp_path: Path) -> None:
    bad, out = tmp_path / "bad.csv", tmp_path / "deep" / "out"
    bad.write_text("a,b\n1,2\n", encoding="utf-8")
    assert safedpa.run([command, "car", str(bad), "--out", str(out)]) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["bad.csv"]
    out.mkdir(parents=True)
    assert safedpa.run([command, "car", str(bad), "--out", str(out)]) == 2
    assert out.is_dir(), "the person's own"


def test_a_folder_in_which_something_was_written_stays(tmp_path: Path) -> None:
    from safedpa.comparison.output import results_folder

    def fails_late() -> None:
        with results_folder(tmp_path / "out", (), (), False) as out:
            (out / "half").write_text("x", encoding="utf-8")
            raise InputError("late")

    with pytest.raises(InputError, match="late"):
        fails_late()
    assert (tmp_path / "out" / "half").exists()


def test_only_a_road_that_may_copy_writes_a_copy_and_nothing_else() -> None:
    """Models are the same in both formats; another format's file is converted, which is no copy."""
    road = next(road for road in ROADS if road.may_copy)
    model = next(bomb for bomb in BOMBS if bomb.name == "1000 effects")
    assert tried(road, model, model.make()).hole == ""
    assert "exit code 0" in tried(replace(road, may_copy=False), model, model.make()).hole
    settings = b'format = 1\nrobot = "car"\n[filter]\neta = 0.2\n'
    found = tried(road, replace(model, name="settings"), settings)
    assert found.code == 2 or found.hole
