"""Commands do not change their input files, and write only their own new files."""

import hashlib
import subprocess
import sys
from pathlib import Path

import pytest

from safedpa.dynamics import load_model, save_model
from safedpa.effects import effect
from safedpa_services.command_line.group import safedpa

pytestmark = [pytest.mark.slow, pytest.mark.processes]

COMMANDS = (  # a command line, and what it leaves behind
    ("compare model.toml drive.csv", "compare-*"),
    ("compare model.toml recording.mcap --out compared", "compared"),
    ("diagnose model.toml drive.csv --columns map.toml", "diagnose-*"),
    ("diagnose model.toml drive.csv --check", ""),
    ("rehearse model.toml drive.csv --effect quadratic_drag", ""),
    ("add model.toml quadratic_drag drive.csv --out more.toml", "more.toml"),
    ("refit model.toml drive.csv --free base.speed_gain --out more.toml", "more.toml"),
    ("predict model.toml drive.csv --horizon 1 --out predicted.csv", "predicted.csv"),
    ("calibrate recording.mcap --model model.toml --out margin.toml", "margin.toml"),
    ("columns drive.csv --robot car", ""),
    ("export recording.mcap --format csv --out exported.csv", "exported.csv"),
    ("replay recording.mcap --out replayed.mcap", "replayed.mcap"),
    ("effects --robot car", ""),
)
LONG = ("diagnose model.toml drive.csv --columns", "rehearse", "add", "refit")
"""Beginnings of those that search or fit for seconds."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A model, a drive as a recording and as a table, and a column map."""
    folder = tmp_path_factory.mktemp("inputs")
    up = [sys.executable, "-m", "safedpa_services", "up", "--headless", "--lockstep", "--seconds", "12", "--json"]
    subprocess.run([*up, "--out", str(folder / "runs")], check=True, capture_output=True, timeout=600)
    (folder / "recording.mcap").write_bytes(next((folder / "runs").glob("*/recording.mcap")).read_bytes())
    assert (
        safedpa.run(["export", str(folder / "recording.mcap"), "--format", "csv", "--out", str(folder / "drive.csv")])
        == 0
    )
    save_model(load_model("car"), folder / "model.toml")
    names = ("t", "x", "y", "yaw", "speed", "target_speed", "steer")
    mapped = "".join(f'{name} = "{name}"\n' for name in names)
    (folder / "map.toml").write_text(f'format = 1\nrobot = "car"\n[columns]\n{mapped}', encoding="utf-8")
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


@pytest.fixture(autouse=True)
def few(monkeypatch):
    """Reduces the library of effects, which saves time; the files do not depend on it."""
    names = ("quadratic_drag", "rolling_resistance")
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", name) for name in names])


def sums(folder, names):
    return {name: hashlib.md5((folder / name).read_bytes()).hexdigest() for name in names}


@pytest.mark.parametrize(
    ("line", "made"),
    [pytest.param(*each, marks=pytest.mark.long) if each[0].startswith(LONG) else each for each in COMMANDS],
    ids=[line for line, _ in COMMANDS],
)
def test_input_files_are_not_changed(line, made, inputs, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name, data in inputs.items():
        Path(name).write_bytes(data)
    before = sums(tmp_path, inputs)
    assert safedpa.run(line.split()) == 0, capsys.readouterr().err
    assert sums(tmp_path, inputs) == before
    left = {path.name for path in tmp_path.iterdir()} - set(inputs)
    assert left == {path.name for path in tmp_path.glob(made or "nothing")}
    assert len(left) == (1 if made else 0)
    if made:  # and the same again replaces nothing that was made
        first = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
        safedpa.run(line.split())
        assert {path: path.read_bytes() for path in first} == first
