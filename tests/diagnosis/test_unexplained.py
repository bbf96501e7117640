"""What no effect of the library explains is a place or a formula near the truth; laws, from logs to the filter."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from safedpa.diagnosis.diagnose import diagnose
from safedpa.diagnosis.fit.cross_validation import heldout_of
from safedpa.diagnosis.fit.multiple_shooting import shooting_of
from safedpa.diagnosis.report_schema import as_document
from safedpa.diagnosis.search.conditional import region_effect
from safedpa.diagnosis.search.initial_model import initial_search
from safedpa.diagnosis.search.regions import StripRegion
from safedpa.dynamics import PhysicsModel, Setting, load_model
from safedpa.effects import effect, effects_of
from safedpa.fleet.outcome import outcome_of
from safedpa.records import load_run
from safedpa.records.run import Run, Stretch
from safedpa.report.diagnosis_page import report_page
from safedpa.robots.car.dynamics.kinematic_bicycle import KinematicBicycle
from safedpa.safety import FilterSettings, FunctionBarrier, SafetyFilter
from safedpa_lab.experiments.diagnosis.diagnosing import diagnosed
from safedpa_lab.hidden import Case, cases_of, write_case
from safedpa_lab.hidden.lanes import car_commands
from safedpa_services.command_line.group import safedpa

WHEELBASE, GAIN, LIMIT = 0.32, 3.0, 6.0
NOISE = (0.002, 0.002, 0.003, 0.015)


def given():
    values = {"wheelbase": WHEELBASE, "speed_gain": GAIN, "acceleration_limit": LIMIT}
    own = {f"base.{name}": Setting(value) for name, value in values.items()}
    return PhysicsModel(KinematicBicycle("speed_servo"), [], own)


def driven(extra, seed, seconds=40.0, period=0.05):
    """A car simulated in steps of 5 ms with extra(state, action) added to its rates, measured with noise."""
    random = np.random.default_rng(seed)
    rows = round(seconds / period)
    commands = car_commands(random, rows, period, 0.35)
    state = np.array([*random.uniform(-2, 2, 2), random.uniform(-3, 3), 0.5])
    states, actions = [], []
    for row in range(rows):
        action = np.array([commands.drive[row], homeward(state, commands.steer[row])])
        states.append(state)
        actions.append(action)
        for _ in range(10):
            first = rates(state, action) + extra(state, action)
            ahead = state + 0.1 * period * first
            state = state + 0.05 * period * (first + rates(ahead, action) + extra(ahead, action))
    measured = np.array(states) + random.normal(0.0, 1.0, (rows, 4)) * NOISE
    return Run(f"run{seed}", given().system, period * np.arange(rows), measured, np.array(actions), (Stretch(0, rows),))


def homeward(state, steer):
    home = np.arctan2(-state[1], -state[0]) - state[2]
    home = np.arctan2(np.sin(home), np.cos(home))
    away = np.hypot(state[0], state[1]) > 4.0 and abs(home) > 0.6 and state[3] > 0
    return np.clip(1.5 * home, -0.35, 0.35) if away else steer


def rates(state, action):
    servo = np.clip(GAIN * (action[0] - state[3]), -LIMIT, LIMIT)
    turn = state[3] * np.tan(action[1]) / WHEELBASE
    return np.array([state[3] * np.cos(state[2]), state[3] * np.sin(state[2]), turn, servo])


def on_speed(value):
    return np.array([0.0, 0.0, 0.0, value])


FEW = ("quadratic_drag", "viscous_drag", "rolling_resistance", "steering_offset", "steering_gain", "understeer")


def report_of(extra, seed):
    """A diagnosis by the effects that come nearest: the others take time and change nothing."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", name) for name in FEW])
        return diagnose(given(), [driven(extra, seed + run, 25.0) for run in range(4)])


@pytest.fixture(scope="module")
def cube():
    return report_of(lambda state, _: on_speed(-0.1 * state[3] ** 3), 300)


@pytest.fixture(scope="module")
def strip():
    def rough(state, _):
        across = state[0] * np.cos(0.5) + state[1] * np.sin(0.5)
        return on_speed(-1.0 * np.tanh(state[3] / 0.05) * (abs(across - 0.5) < 0.5))

    return report_of(rough, 400)


@pytest.mark.long
def test_cubic_drag_is_reported_as_a_formula_and_not_as_quadratic_drag(cube):
    assert (cube.verdict, cube.added, cube.unexplained.kind) == ("unexplained", (), "formula")
    assert cube.unexplained.depends_on == ("speed",)
    (term,) = cube.unexplained.terms
    assert (term.state, term.term) == ("speed", "speed^3")
    assert abs(term.coefficient + 0.1) < 4.0 * term.std
    assert term.std < 0.01
    assert term.unit == "m/s2 / (m/s)^3"
    assert any(item.decision == "suspected" and "formula" in item.reason for item in cube.candidates)


@pytest.mark.long
def test_yaw_drift_with_the_square_of_the_speed_is_not_a_steering_offset():
    report = report_of(lambda state, _: np.array([0.0, 0.0, 0.08 * state[3] ** 2, 0.0]), 500)
    assert report.verdict == "unexplained"
    (term,) = report.unexplained.terms
    assert (term.state, term.term) == ("yaw", "speed^2")
    assert abs(term.coefficient - 0.08) < 0.004


@pytest.mark.long
def test_a_strip_of_rough_floor_is_rolling_resistance_in_that_region(strip):
    assert (strip.verdict, strip.added) == ("effect_missing", ("rolling_resistance",))
    assert [item.phrase for item in strip.conditions] == ["strip"]
    numbers = {path.split(".")[1]: value.value for path, value in strip.parameters.items()}
    assert abs(numbers["deceleration"] - 1.0) < 0.15
    # the strip's normal and offset, whichever of its two directions was found
    sign = np.sign(np.cos(numbers["angle"]))
    along = [sign * np.cos(numbers["angle"]), sign * np.sin(numbers["angle"])]
    assert np.allclose(along, [np.cos(0.5), np.sin(0.5)], atol=0.06)
    assert abs(abs(numbers["offset"]) - 0.5) < 0.1
    assert abs(numbers["half_width"] - 0.5) < 0.1


@pytest.mark.long
def test_report_and_page_show_the_formula_its_map_and_a_warning(cube):
    document = json.loads(json.dumps(as_document(cube), allow_nan=False))
    assert document["unexplained"]["terms"][0]["term"] == "speed^3"
    assert document["unexplained"]["dependence"][0]["variable"] == "speed"
    assert len(document["unexplained"]["map"]["means"]) == len(document["unexplained"]["map"]["up_edges"]) - 1
    run = driven(lambda *_: np.zeros(4), 1, 20.0)
    page = report_page(document, [run], cube.models, "cube")
    assert "It is a formula that fits, not a physical effect" in page
    assert '"id":"unexplained"' in page
    assert "fitted function with one standard deviation" in page


@pytest.mark.long
def test_a_resonance_is_a_dependence_with_its_profile():
    report = report_of(lambda state, _: on_speed(-0.8 * np.exp(-(((state[3] - 1.2) / 0.2) ** 2))), 900)
    rest = report.unexplained
    assert report.verdict == "unexplained"
    assert (rest.kind, rest.depends_on[0]) == ("dependence", "speed")
    lowest = int(np.argmin(rest.profile.values))
    assert abs(rest.profile.knots[lowest] - 1.2) < 0.2
    assert -1.0 < rest.profile.values[lowest] < -0.4
    assert "without a short formula" in rest.expression


@pytest.mark.long
def test_nothing_hidden_leaves_nothing_unexplained():
    report = report_of(lambda *_: np.zeros(4), 600)
    assert report.verdict == "nothing_missing"
    assert report.unexplained is None


FLOOR = {"deceleration": 0.9, "x_above": 0.4}


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    laws = {"rolling_resistance": "where x above"}
    case = Case("test", 11, {"rolling_resistance": FLOOR}, laws=laws, runs=4, seconds=30.0)
    return write_case(case, tmp_path_factory.mktemp("carpet"))


def notice(arguments, capsys):
    assert safedpa.run([str(item) for item in arguments]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.long
def test_add_fits_the_parameter_and_the_border_of_a_law(log, tmp_path, capsys):
    out = tmp_path / "with.toml"
    phrase = ["--where", "x above", "--out", out, "--json"]
    document = notice(["add", log.model, "rolling_resistance", *log.runs, *phrase], capsys)
    assert document["sentence"] == "rolling resistance 0.9 m/s2 beyond x = 0.40 m"
    for name, value in FLOOR.items():
        entry = document["parameters"][f"rolling_resistance.{name}"]
        assert abs(entry["value"] - value) < 3.0 * entry["std"]
    assert document["after"] < 0.15 * document["before"]
    assert notice(["compare", out, *log.runs, "--out", tmp_path / "compared", "--json"], capsys)["error"] < 0.02
    bounds = {"action_low": (-3.0, -0.4), "action_high": (3.0, 0.4), "backup_action": (0.0, 0.0)}
    settings = FilterSettings(system="car", **bounds, eta=0.3)
    filtered = SafetyFilter.for_model(load_model(out), settings, [FunctionBarrier(lambda x: 1.0 - x[3])])
    before, behind = (filtered.decide(np.array([x, 0.0, 0.0, 0.95]), (3.0, 0.0)) for x in (-2.0, 3.0))
    assert behind.action[0] - before.action[0] == pytest.approx(0.9 / 3.0, rel=0.05)  # deceleration over the gain


def test_a_strip_with_one_border_outside_the_data_becomes_a_half_plane(log):
    """No run crosses its far border, so unseen blocks cannot tell the two apart; the line has two numbers less."""
    model = load_model(log.model)
    runs = [load_run(path, model.system) for path in log.runs]
    search = initial_search(model, shooting_of(runs, 1.0), heldout_of(runs, 1.0))
    strip = {"angle": 0.0, "offset": 5.4, "half_width": 5.0, "deceleration": 0.9}
    region_fit = SimpleNamespace(region=StripRegion(), values=strip, gain=5.0)
    search.library = list(effects_of("car").values())
    found = region_effect(region_fit, search)
    law = next(item for item in found.fit.model.effects if item.name == "rolling_resistance").law
    assert (law.shape, law.variable) == ("above", "x")
    assert found.fit.model.settings["rolling_resistance.x_above"].value == pytest.approx(0.4, abs=0.05)


def test_a_varying_parameter_is_added_by_name(log, tmp_path, capsys):
    phrase = ["--varies", "deceleration with time", "--out", tmp_path / "sag.toml", "--json"]
    document = notice(["add", log.model, "rolling_resistance", *log.runs, *phrase], capsys)
    assert "rolling_resistance.deceleration_per_time" in document["parameters"]
    assert "a second" in document["sentence"]


@pytest.mark.parametrize(
    ("phrase", "reported"),
    [
        (["--where", "z above"], "where: got 'z'"),
        (["--where", "x"], "wanted 'VARIABLE above|below|between'"),
        (["--where", "x above", "--varies", "deceleration with time"], "got both"),
        (["--varies", "gain with time"], "varies: got 'gain'"),
        (["--where", "x above", "--edge", "0"], "wanted a width above 0 m"),
    ],
)
def test_unknown_laws_are_rejected_in_one_line(phrase, reported, log, tmp_path, capsys):
    out = tmp_path / "none.toml"
    arguments = ["add", log.model, "rolling_resistance", *log.runs, "--out", out, *phrase]
    assert safedpa.run([str(item) for item in arguments]) == 2
    error = capsys.readouterr().err
    assert reported in error
    assert error.count("\n") == 1
    assert not out.exists()


@pytest.mark.long
@pytest.mark.slow
def test_diagnose_reports_the_law_on_the_correct_side(log, tmp_path, capsys):
    document = notice(["diagnose", log.model, *log.runs, "--out", tmp_path, "--json"], capsys)
    assert (document["verdict"], document["added"]) == ("effect_missing", ["rolling_resistance"])
    (reported,) = document["conditions"]
    assert reported["sentence"] == "rolling resistance 0.9 m/s2 beyond x = 0.40 m"
    assert reported["sentence"] in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert 'where = "x above"' in (tmp_path / "model.toml").read_text(encoding="utf-8")
    costs = {"robot": "a", "status": "diagnosed", "reason": "", "unreadable_files": []}
    outcome = outcome_of(costs, document)
    assert outcome.found == ()  # a fleet does not pool it with what acts everywhere
    assert outcome.unexplained == reported["sentence"]


@pytest.mark.long
@pytest.mark.parametrize(
    ("suite", "seed", "name"),
    [("patches", 7003, "2739099046"), ("speed_gains", 7002, "3890390788")],
    ids=["carpet_of_three_runs", "border_reported_as_three_effects"],
)
def test_only_the_law_is_found(suite, seed, name, tmp_path):
    case = next(case for case in cases_of(suite, 10, seed) if case.name.endswith(name))
    log = write_case(case, tmp_path)
    document = diagnosed(log.model, log.runs)
    (effect,) = case.effects
    assert document["added"] == [effect]
    (condition,) = document["conditions"]
    assert condition["phrase"] == case.laws[effect].removeprefix("where ")
    for path, value in case.effects[effect].items():
        assert document["parameters"][f"{effect}.{path}"]["value"] == pytest.approx(value, rel=0.1, abs=0.1)


CIRCLE = {"rolling_resistance": {"deceleration": 1.2, "at_x": 1.8, "at_y": 0.8, "radius": 1.5}}


@pytest.mark.long
@pytest.mark.slow
def test_a_rough_patch_is_not_reported_across_rooms(tmp_path, monkeypatch):
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [])
    laws = {"rolling_resistance": "where circle"}
    log = write_case(Case("test", 194365079, CIRCLE, runs=4, seconds=40.0, laws=laws), tmp_path)
    model = load_model(log.model)
    runs = [load_run(path, model.system) for path in log.runs]
    together = diagnose(model, runs)
    assert together.unexplained.kind == "place"
    assert "different_places" not in {item["kind"] for item in together.data_quality}
    apart = [replace(run, states=run.states + np.array([100.0 * k, 0.0, 0.0, 0.0])) for k, run in enumerate(runs)]
    elsewhere = diagnose(model, apart)
    assert elsewhere.unexplained is None or elsewhere.unexplained.kind != "place"
    assert "different_places" in {item["kind"] for item in elsewhere.data_quality}
