"""Laws of effects from logs to the filter: a carpet is found, reported, added by name, compared and driven with."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from safedpa.diagnosis.diagnose import diagnose
from safedpa.diagnosis.fit.heldout import heldout_of
from safedpa.diagnosis.fit.shooting import shooting_of
from safedpa.diagnosis.search.beginning import begun
from safedpa.diagnosis.search.conditions import of_patch
from safedpa.diagnosis.search.places import Strip
from safedpa.dynamics import load_model
from safedpa.effects import effects_of
from safedpa.fleet.outcome import outcome_of
from safedpa.records import load_run
from safedpa.safety import FilterSettings, FunctionBarrier, SafetyFilter
from safedpa_lab.experiments.diagnosing import diagnosed
from safedpa_lab.hidden import Case, cases_of, write_case
from safedpa_services.command_line.group import safedpa

FLOOR = {"deceleration": 0.9, "x_above": 0.4}


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    laws = {"rolling_resistance": "where x above"}
    case = Case("test", 11, {"rolling_resistance": FLOOR}, laws=laws, runs=4, seconds=30.0)
    return write_case(case, tmp_path_factory.mktemp("carpet"))


def said(arguments, capsys):
    assert safedpa.run([str(item) for item in arguments]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.long
def test_add_fits_number_and_border(log, tmp_path, capsys):
    out = tmp_path / "with.toml"
    words = ["--where", "x above", "--out", out, "--json"]
    document = said(["add", log.model, "rolling_resistance", *log.runs, *words], capsys)
    assert document["sentence"] == "rolling resistance 0.9 m/s2 beyond x = 0.40 m"
    for name, value in FLOOR.items():
        entry = document["parameters"][f"rolling_resistance.{name}"]
        assert abs(entry["value"] - value) < 3.0 * entry["std"]
    assert document["after"] < 0.15 * document["before"]
    compared = said(["compare", out, *log.runs, "--out", tmp_path / "compared", "--json"], capsys)
    assert compared["error"] < 0.02
    settings = FilterSettings(
        system="car", action_low=(-3.0, -0.4), action_high=(3.0, 0.4), backup_action=(0.0, 0.0), eta=0.3
    )
    filtered = SafetyFilter.for_model(load_model(out), settings, [FunctionBarrier(lambda x: 1.0 - x[3])])
    before, behind = (filtered.decide(np.array([x, 0.0, 0.0, 0.95]), (3.0, 0.0)) for x in (-2.0, 3.0))
    assert behind.action[0] - before.action[0] == pytest.approx(0.9 / 3.0, rel=0.05)  # deceleration over the gain


def test_a_strip_open_to_one_side_is_all_beyond_a_line(log):
    """No run crosses its far border, so unseen blocks cannot tell the two apart; the line has two numbers less."""
    model = load_model(log.model)
    runs = [load_run(path, model.system) for path in log.runs]
    search = begun(model, shooting_of(runs, 1.0), heldout_of(runs, 1.0))
    strip = {"angle": 0.0, "offset": 5.4, "half_width": 5.0, "deceleration": 0.9}
    patch = SimpleNamespace(place=Strip(), values=strip, gain=5.0)
    found = of_patch(patch, search, effects_of("car").values())
    law = next(item for item in found.fit.model.effects if item.name == "rolling_resistance").law
    assert (law.shape, law.variable) == ("above", "x")
    assert found.fit.model.settings["rolling_resistance.x_above"].value == pytest.approx(0.4, abs=0.05)


def test_a_number_that_varies_is_added_by_name(log, tmp_path, capsys):
    words = ["--varies", "deceleration with time", "--out", tmp_path / "sag.toml", "--json"]
    document = said(["add", log.model, "rolling_resistance", *log.runs, *words], capsys)
    assert "rolling_resistance.deceleration_per_time" in document["parameters"]
    assert "a second" in document["sentence"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--where", "z above"], "where: got 'z'"),
        (["--where", "x"], "wanted 'VARIABLE above|below|between'"),
        (["--where", "x above", "--varies", "deceleration with time"], "got both"),
        (["--varies", "gain with time"], "varies: got 'gain'"),
        (["--where", "x above", "--edge", "0"], "wanted a width above 0 m"),
    ],
)
def test_unknown_words_are_refused_in_one_line(words, told, log, tmp_path, capsys):
    out = tmp_path / "none.toml"
    arguments = ["add", log.model, "rolling_resistance", *log.runs, "--out", out, *words]
    assert safedpa.run([str(item) for item in arguments]) == 2
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1
    assert not out.exists()


@pytest.mark.long
@pytest.mark.slow
def test_diagnose_reports_the_law_on_the_correct_side(log, tmp_path, capsys):
    document = said(["diagnose", log.model, *log.runs, "--out", tmp_path, "--json"], capsys)
    assert (document["verdict"], document["added"]) == ("effect_missing", ["rolling_resistance"])
    (told,) = document["conditions"]
    assert told["sentence"] == "rolling resistance 0.9 m/s2 beyond x = 0.40 m"
    assert told["sentence"] in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert 'where = "x above"' in (tmp_path / "model.toml").read_text(encoding="utf-8")
    costs = {"robot": "a", "status": "diagnosed", "reason": "", "unreadable_files": []}
    outcome = outcome_of(costs, document)
    assert outcome.found == ()  # a fleet does not pool it with what acts everywhere
    assert outcome.unexplained == told["sentence"]


def diagnosed_case(suite, number, seed, folder):
    case = cases_of(suite, number + 1, seed)[number]
    log = write_case(case, folder)
    return case, diagnosed(log.model, log.runs)


def number_of(suite, seed, name):
    return next(index for index, case in enumerate(cases_of(suite, 10, seed)) if case.name.endswith(name))


@pytest.mark.long
@pytest.mark.parametrize(
    ("suite", "seed", "name"),
    [("patches", 7003, "2739099046"), ("speed_gains", 7002, "3890390788")],
    ids=["carpet_of_three_runs", "border_reported_as_three_effects"],
)
def test_the_law_is_found_and_nothing_else(suite, seed, name, tmp_path):
    case, document = diagnosed_case(suite, number_of(suite, seed, name), seed, tmp_path)
    (effect,) = case.effects
    assert document["added"] == [effect]
    (condition,) = document["conditions"]
    assert condition["words"] == case.laws[effect].removeprefix("where ")
    for path, value in case.effects[effect].items():
        assert document["parameters"][f"{effect}.{path}"]["value"] == pytest.approx(value, rel=0.1, abs=0.1)


CIRCLE = {"rolling_resistance": {"deceleration": 1.2, "at_x": 1.8, "at_y": 0.8, "radius": 1.5}}


@pytest.mark.long
@pytest.mark.slow
def test_a_rough_patch_is_not_reported_across_rooms(tmp_path, monkeypatch):
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [])
    log = write_case(
        Case("test", 194365079, CIRCLE, runs=4, seconds=40.0, laws={"rolling_resistance": "where circle"}), tmp_path
    )
    model = load_model(log.model)
    runs = [load_run(path, model.system) for path in log.runs]
    together = diagnose(model, runs)
    assert together.unexplained.kind == "place"
    assert "different_places" not in {item["kind"] for item in together.data_quality}
    apart = [replace(run, states=run.states + np.array([100.0 * k, 0.0, 0.0, 0.0])) for k, run in enumerate(runs)]
    elsewhere = diagnose(model, apart)
    assert elsewhere.unexplained is None or elsewhere.unexplained.kind != "place"
    assert "different_places" in {item["kind"] for item in elsewhere.data_quality}
