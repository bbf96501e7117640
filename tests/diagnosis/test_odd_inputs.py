"""Odd recordings through the command line: a clear finding, never a confident wrong answer."""

from __future__ import annotations

import json

import numpy as np
import pytest

from safedpa.effects import effect
from safedpa_lab.hidden import Case, write_case
from safedpa_services.command_line.group import safedpa


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    case = Case("test", 3, {"quadratic_drag": {"coefficient": 0.12}}, runs=2, seconds=20.0)
    return write_case(case, tmp_path_factory.mktemp("odd"))


@pytest.fixture(autouse=True)
def few(monkeypatch):
    """What comes nearest; the rest of the library takes time and changes nothing."""
    names = ("quadratic_drag", "viscous_drag")
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", name) for name in names])


def changed(log, folder, change, runs=2):
    """The log's runs with their tables changed: change(table by column name) in place."""
    paths = []
    for path in log.runs[:runs]:
        names = path.read_text(encoding="utf-8").splitlines()[0].split(",")
        table = dict(zip(names, np.loadtxt(path, delimiter=",", skiprows=1).T, strict=True))
        table = change(table) or table
        out = folder / path.name
        np.savetxt(out, np.column_stack(list(table.values())), delimiter=",", header=",".join(table), comments="")
        paths.append(str(out))
    return paths


def diagnosed(log, paths, folder, capsys):
    """(exit code, report or None, standard error)"""
    code = safedpa.run(["diagnose", str(log.model), *paths, "--out", str(folder), "--json"])
    shown = capsys.readouterr()
    return code, json.loads(shown.out) if shown.out else None, shown.err


TOO_LITTLE = ("too little to judge", "no input ever changes")


def swap(one, other):
    def change(table):
        table[one], table[other] = table[other], table[one]

    return change


def scale(factor, *names):
    def change(table):
        for name in names:
            table[name] = factor * table[name]

    return change


def constant(table):
    table["target_speed"][:], table["steer"][:] = 1.0, 0.1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda table: {name: values[:40] for name, values in table.items()}, "too little to judge"),
        (constant, "no input ever changes"),
        (swap("x", "y"), "x and y look swapped"),
        (swap("yaw", "speed"), "yaw"),
        (scale(-1.0, "steer"), "turns against steer"),
        (lambda table: table.update(steer=np.roll(table["steer"], 173)), "not turn as it is steered"),
        (scale(3.6, "speed"), "km/h"),
    ],
    ids=["two_seconds", "constant", "x_and_y", "yaw_and_speed", "steer_flipped", "steer_elsewhere", "km_per_hour"],
)
def test_no_verdict_and_the_reason(change, said, log, tmp_path, capsys):
    code, report, _ = diagnosed(log, changed(log, tmp_path, change), tmp_path, capsys)
    assert code == 0
    assert report["verdict"] == ("undecided" if said in TOO_LITTLE else "unexplained")
    assert report["added"] == []
    assert report["unexplained"]["depends_on"] == []
    assert said in report["unexplained"]["expression"]
    assert not (tmp_path / "margin.toml").exists()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (scale(180.0 / np.pi, "steer"), "looks like degrees"),
        (scale(180.0 / np.pi, "yaw"), "read as degrees"),
        (swap("target_speed", "steer"), "steer reaches"),
        (scale(1000.0, "t"), "looks like ms, not seconds"),
    ],
    ids=["steer_in_degrees", "yaw_in_degrees", "actions_swapped", "milliseconds"],
)
def test_unusable_recordings_are_one_line_and_exit_code_2(change, said, log, tmp_path, capsys):
    code, report, error = diagnosed(log, changed(log, tmp_path, change), tmp_path, capsys)
    assert (code, report) == (2, None)
    assert said in error
    assert error.count("\n") == 1


def teleport(table):
    table["x"][200:] += 3.0
    table["y"][200:] -= 2.0


def lost(table):
    for name in ("x", "y", "yaw", "speed"):
        table[name][100] = np.nan


@pytest.mark.long
@pytest.mark.parametrize(("change", "kind"), [(teleport, "jump"), (lost, "not_a_number")], ids=["teleport", "nan_row"])
def test_a_defect_is_cut_and_reported_and_does_not_change_the_answer(change, kind, log, tmp_path, capsys):
    code, report, _ = diagnosed(log, changed(log, tmp_path, change), tmp_path, capsys)
    assert code == 0
    assert report["added"] == ["quadratic_drag"]
    assert abs(report["parameters"]["quadratic_drag.coefficient"]["value"] - 0.12) < 0.01
    assert kind in {item["kind"] for item in report["data_quality"]}
