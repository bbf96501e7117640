"""Results never replace the files that were read."""

from __future__ import annotations

import shutil

import pytest

from safedpa.effects import effect
from safedpa_lab.hidden import Case, write_case
from safedpa_services.command_line.group import safedpa


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    case = Case("test", 3, {"quadratic_drag": {"coefficient": 0.12}}, runs=1, seconds=14.0)
    return write_case(case, tmp_path_factory.mktemp("own"))


@pytest.fixture
def here(written, tmp_path, monkeypatch):
    """The current folder, with ``model.toml`` and ``run.csv`` in it."""
    shutil.copy(written.model, tmp_path / "model.toml")
    shutil.copy(written.runs[0], tmp_path / "run.csv")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", "quadratic_drag")])
    return tmp_path


@pytest.mark.long
@pytest.mark.parametrize("command", ["compare", "diagnose"])
def test_without_out_a_new_folder_is_made(command, here, capsys):
    before = {path.name: path.read_bytes() for path in here.iterdir()}
    for _ in range(2):
        assert safedpa.run([command, "model.toml", "run.csv"]) == 0
    told = capsys.readouterr().out
    after = {path.name: path.read_bytes() for path in here.iterdir() if path.is_file()}
    assert after == before
    made = sorted(path.name for path in here.iterdir() if path.is_dir())
    assert len(made) == 2
    assert all(name.startswith(f"{command}-model-20") for name in made)
    assert all(name in told for name in made)


@pytest.mark.parametrize(
    "arguments",
    [
        ["diagnose", "model.toml", "run.csv", "--out", "."],
        ["add", "model.toml", "viscous_drag", "run.csv", "--out", "./model.toml"],
        ["add", "model.toml", "viscous_drag", "run.csv", "--out", "run.csv"],
        ["predict", "model.toml", "run.csv", "--horizon", "0.5", "--out", "run.csv"],
    ],
    ids=["diagnose", "add", "add_over_run", "predict"],
)
def test_an_input_is_not_replaced(arguments, here, capsys):
    before = {path.name: path.read_bytes() for path in here.iterdir()}
    assert safedpa.run(arguments) == 2
    told = capsys.readouterr().err
    assert "is an input of this command" in told
    assert told.count("\n") == 1
    assert {path.name: path.read_bytes() for path in here.iterdir()} == before


def test_force_replaces_it(here):
    before = (here / "model.toml").read_bytes()
    arguments = ["add", "model.toml", "quadratic_drag", "run.csv", "--out", "model.toml"]
    assert safedpa.run([*arguments, "--force"]) == 0
    assert (here / "model.toml").read_bytes() != before
