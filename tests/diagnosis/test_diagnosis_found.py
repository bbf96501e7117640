"""What was hidden is found: logs made by simulators that share no code with the fitted models."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from safedpa.diagnosis.diagnose import diagnose
from safedpa.diagnosis.document import Report, as_document
from safedpa.dynamics import load_model, parse_model, write_model
from safedpa.records import load_run
from safedpa_lab.hidden import Case, write_case

pytestmark = pytest.mark.slow

Diagnose = tuple[Report, Path]


@pytest.fixture(scope="module")
def hidden(tmp_path_factory):
    """hidden(effects, ...) -> report on logs in which the effects are hidden."""

    def made(effects, runs=4, seconds=25.0, seed=7, horizon=1.0, **options):
        case = Case("test", seed, effects, runs=runs, seconds=seconds, **options)
        log = write_case(case, tmp_path_factory.mktemp("log"))
        model = load_model(str(log.model))
        return diagnose(model, [load_run(str(path), model.system) for path in log.runs], horizon)

    return made


def accepted(report, name):
    return next(item for item in report.candidates if item.decision == "accepted" and name in item.effect)


ONE = [("quadratic_drag", {"coefficient": 0.12}), ("steering_lag", {"time_constant": 0.15})]


@pytest.fixture(
    scope="module", params=[ONE[0], pytest.param(ONE[1], marks=pytest.mark.long)], ids=[name for name, _ in ONE]
)
def one(request, hidden):
    """(name, parameters, report) of logs in which one effect is hidden."""
    name, parameters = request.param
    return name, parameters, hidden({name: parameters})


def test_one_effect_is_named_with_its_number(one):
    name, parameters, report = one
    assert report.verdict == "effect_missing"
    assert report.added == (name,)
    first, last = report.stages
    assert last.heldout_error < 0.4 * first.heldout_error
    assert last.runs_improved == "4/4"
    for key, value in parameters.items():
        found = report.parameters[f"{name}.{key}"]
        assert abs(found.value - value) < max(4 * found.std, 0.01 * value)
        assert found.std < 0.05 * value
    model = report.models[-1]
    assert [item.name for item in model.effects] == [name]
    assert parse_model(write_model(model)).settings == model.settings


def test_the_document_has_the_format_of_the_contract(one):
    name, parameters, report = one
    document = json.loads(json.dumps(as_document(report), allow_nan=False))
    assert {
        "format", "robot", "verdict", "added", "stages", "candidates", "where", "unexplained", "next_experiment",
        "data_quality",
    } <= set(document)  # fmt: skip
    assert document["format"] == 1
    assert document["stages"][0]["effects"] == []
    assert set(document["stages"][0]) == {"effects", "heldout_error", "per_state", "runs_improved"}
    assert set(document["candidates"][0]) == {
        "stage", "effect", "parameters", "heldout_error", "score", "indistinguishable_from", "decision", "reason",
    }  # fmt: skip
    for key in parameters:
        assert accepted(report, name).parameters[key].unit == {"coefficient": "1/m", "time_constant": "s"}[key]
    assert {"variable", "low", "high", "error", "share", "samples"} <= set(document["where"][0])


@pytest.mark.long
def test_two_effects_are_both_found(hidden):
    report = hidden({"rolling_resistance": {"deceleration": 0.45}, "steering_offset": {"angle": 0.04}})
    assert set(report.added) == {"rolling_resistance", "steering_offset"}
    errors = [stage.heldout_error for stage in report.stages]
    assert errors[0] > errors[1] > errors[2]


@pytest.mark.long
def test_viscous_drag_and_a_command_gain_are_one_where_the_servo_is_free(hidden):
    report = hidden({"viscous_drag": {"coefficient": 0.3}}, hard=True)
    assert report.added[0] in ("viscous_drag", "speed_command_gain")
    group = {report.added[0], *accepted(report, report.added[0]).indistinguishable_from}
    assert {"viscous_drag", "speed_command_gain"} <= group


@pytest.mark.long
def test_a_payload_is_reported_as_taken_up_by_a_free_servo_gain(hidden):
    report = hidden({"payload": {"mass_ratio": 0.3}}, hard=True)
    assert "payload" not in report.added
    payload = next(item for item in report.candidates if item.effect == "payload")
    assert payload.indistinguishable_from == ("base.speed_gain",)
    assert "speed_gain" in payload.reason


CARPET = {"deceleration": 1.2, "at_x": 1.8, "at_y": 0.8, "radius": 1.5}


@pytest.mark.long
def test_a_carpet_is_reported_with_its_position(hidden):
    laws = {"rolling_resistance": "where circle"}
    report = hidden({"rolling_resistance": CARPET}, laws=laws, seconds=40.0, seed=194365079)
    assert report.verdict == "effect_missing"
    assert report.added == ("rolling_resistance",)
    (told,) = report.conditions
    assert (told.kind, told.words) == ("where", "circle")
    assert "inside the circle of 1.5" in told.sentence
    for name, value in CARPET.items():
        assert report.parameters[f"rolling_resistance.{name}"].value == pytest.approx(value, abs=0.1)
    model = report.models[-1]
    assert parse_model(write_model(model)).effects == model.effects
