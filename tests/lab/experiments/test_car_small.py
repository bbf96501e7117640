"""A small car experiment through the command line: the physics model, and a learned one with a tiny weights file."""

from __future__ import annotations

import json

import pytest
from PIL import Image

from safedpa_services.command_line.group import safedpa

pytestmark = pytest.mark.slow

SMALL = ["--processes", 1, "--load", "none", "--load", "box", "--episodes", 1, "--first-seed", 1, "--drives", 1]
SMALL += ["--drive-ticks", 120]


def run(*arguments):
    return safedpa.run(["experiment", "car", *map(str, arguments)])


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    """One run with everything in it, as a person would start it."""
    folder = tmp_path_factory.mktemp("car")
    assert run(*SMALL, "--models", folder, "--out", folder) == 0
    return folder


@pytest.fixture(scope="module")
def result(out):
    return json.loads((out / "car.json").read_text())


def test_the_filter_keeps_the_goal_seeker_from_contact(result):
    cells = {(cell["method"], cell["load"]): cell for cell in result["cells"]}
    for load in ("none", "box"):
        assert cells["physics", load]["safe"]["hits"] == 1
        assert cells["physics", load]["changed_share"] > 0.0
        assert cells["goal_seeker", load]["safe"]["hits"] == 0
        assert cells["goal_seeker", load]["changed_share"] == 0.0
        for cell in (cells["physics", load], cells["goal_seeker", load]):
            assert cell["both"]["hits"] <= min(cell["success"]["hits"], cell["safe"]["hits"])
            low, high = cell["success"]["interval_95"]
            assert low <= cell["success"]["share"] <= high


def test_methods_without_a_model_are_left_out_by_name(result):
    assert any("SafeDPA is left out" in sentence for sentence in result["left_out"])
    assert set(result["methods"]) == {"physics", "goal_seeker"}


def test_tables_and_pictures_are_written(out):
    text = (out / "car.md").read_text()
    assert "| Physics model |" in text
    assert "1.00 / 0.75" in text  # the paper's SafeDPA without load
    for name in ("car_table.png", "car_predictions.png", "car_errors.png", "car_latent.png", "car_margin.png"):
        with Image.open(out / name) as picture:
            assert picture.width == 1290
            assert len(picture.getcolors(10**6)) > 20
    assert (out / "car.rrd").stat().st_size > 1000


@pytest.mark.long
def test_finished_episodes_are_not_driven_again(out, monkeypatch, capsys):
    def refused(_):
        raise AssertionError("an episode was driven again")

    monkeypatch.setattr("safedpa_lab.experiments.car_cells.run_group", refused)
    before = (out / "cells" / "physics-box.json").read_text()
    assert run(*SMALL, "--models", out, "--out", out, "--part", "table", "--json") == 0
    shown = json.loads(capsys.readouterr().out)
    assert [cell["episodes"] for cell in shown["cells"]] == [1, 1, 1, 1]
    assert (out / "cells" / "physics-box.json").read_text() == before


@pytest.mark.long
def test_another_margin_is_another_cell(out, monkeypatch, capsys):
    class DrivenError(Exception):
        pass

    def driven(_):
        raise DrivenError

    monkeypatch.setattr("safedpa_lab.experiments.car_cells.run_group", driven)
    with pytest.raises(DrivenError):
        run(*SMALL, "--models", out, "--out", out, "--part", "table", "--margin", 0.03)
    capsys.readouterr()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--method", "safdpa"], "did you mean 'safedpa'"),
        (["--method", "safedpa"], "safedpa train car"),
        (["--load", "sofa"], "sofa"),
        (["--part", "tables"], "did you mean 'table'"),
        (["--episodes", 0], "wanted at least 1"),
        (["--first-seed", 4950], "wanted seeds from 0"),
        (["--margin", "wide"], "wanted 'conformal', 'theorem' or a number"),
        (["--drive-ticks", 30], "at least 120"),
        (["--out", "/proc/no/where"], "choose another folder"),
    ],
)
def test_invalid_options_are_refused_in_one_line(arguments, told, tmp_path, capsys):
    assert run("--models", tmp_path, *arguments) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert told in shown.err
    assert shown.err.count("\n") == 1
