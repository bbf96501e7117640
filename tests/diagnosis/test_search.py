"""Which effects a search adds, judges twice, replaces by smaller ones, and looks ahead for."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from safedpa.comparison.actuators import delayed_actions
from safedpa.diagnosis.diagnose import diagnose
from safedpa.diagnosis.fit.cross_validation import error_with, heldout_of
from safedpa.diagnosis.fit.data_checks import data_at_horizon
from safedpa.diagnosis.fit.least_squares import fit
from safedpa.diagnosis.fit.multiple_shooting import shooting_of
from safedpa.diagnosis.fit.trial import fit_trial
from safedpa.diagnosis.report_schema import as_document
from safedpa.diagnosis.search import acceptance
from safedpa.diagnosis.search.acceptance import (
    SearchStage,
    fewest_parameters,
    filter_agrees,
    filter_is_certain,
    is_decisive,
    is_spurious_delay,
    order_by_heldout_gain,
)
from safedpa.diagnosis.search.backward_revision import (
    exchange_for_fewer_parameters,
    mark_equivalent_rivals,
    merge_effects,
    split_effect,
)
from safedpa.diagnosis.search.final_parameters import group_jackknife_deviation, with_model_uncertainty
from safedpa.diagnosis.search.forward_selection import run_search
from safedpa.diagnosis.search.initial_model import initial_search
from safedpa.diagnosis.search.search_state import JudgedTrial, accept_trial
from safedpa.dynamics import PhysicsModel, Setting, load_model
from safedpa.effects import effect
from safedpa.records import load_run
from safedpa.records.run import Run
from safedpa.robots.car.dynamics.kinematic_bicycle import KinematicBicycle
from safedpa_lab.hidden import Case, cases_of, write_case
from safedpa_lab.hidden.judge import judged

FEEDBACK = Case("test", 2884420874, {}, drive="throttle", hard=True)
"""Nothing is hidden; unseen blocks alone find a dead zone with 3.6 standard errors and 8 % off the held-out error."""


@pytest.mark.long
def test_an_effect_that_driver_feedback_imitates_is_not_added(tmp_path):
    log = write_case(FEEDBACK, tmp_path / "case")
    model = load_model(str(log.model))
    report = diagnose(model, [load_run(str(path), model.system) for path in log.runs])
    assert report.verdict == "nothing_missing"
    dead_zone = next(item for item in report.candidates if item.effect == "drive_dead_zone")
    assert dead_zone.score > 3.0
    assert dead_zone.heldout_error < 0.97 * report.stages[0].heldout_error
    assert dead_zone.decision == "suspected"
    assert "lasting disturbances" in dead_zone.reason


@pytest.fixture
def opinion(monkeypatch, plain):
    """opinion(name, windows=..., filter=..., std=...) -> (agrees, certain) for one effect with those numbers."""

    def asked(name, windows, filtered, std):
        item = effect("car", name)
        paths = tuple(f"{name}.{p.name}" for p in item.parameters)
        one, other = (
            SimpleNamespace(
                settings={path: SimpleNamespace(value=v) for path, v in zip(paths, values, strict=True)},
                parameters=dict(zip(paths, item.parameters, strict=True)),
            )
            for values in (windows, filtered)
        )
        found = SimpleNamespace(model=other, paths=paths, deviations=np.array(std, dtype=float))
        monkeypatch.setattr(acceptance, "prediction_error_fit", lambda *_: found)
        trial = SimpleNamespace(effects=(name,), fit=SimpleNamespace(model=one, paths=paths, free=None))
        search = SimpleNamespace(shooting=SimpleNamespace(windows=None))
        return filter_agrees(trial, search), filter_is_certain(trial, search)

    return asked


@pytest.mark.parametrize(
    ("name", "windows", "filtered", "std", "wanted"),
    [
        ("quadratic_drag", [0.12], [0.12], [0.01], (True, True)),
        ("quadratic_drag", [0.12], [0.08], [0.01], (True, False)),
        ("quadratic_drag", [0.12], [0.04], [0.001], (False, True)),  # sure, but a third of the windows' number
        ("quadratic_drag", [0.12], [0.1], [0.03], (False, False)),  # as large, but it may be nothing
        ("quadratic_drag", [0.12], [0.1], [np.nan], (True, False)),  # at a bound the filter has no opinion
        ("quadratic_drag", [0.5], [0.25], [0.01], (True, True)),  # half of it is left
        ("quadratic_drag", [0.5], [0.2499], [0.01], (False, True)),
        ("quadratic_drag", [0.5], [0.5], [0.125], (False, False)),  # four deviations and no more
        ("quadratic_drag", [0.5], [0.5], [0.1111], (True, False)),
        ("quadratic_drag", [9.0], [9.0], [1.0], (True, False)),  # nine and no more
        ("quadratic_drag", [9.01], [9.01], [1.0], (True, True)), ("quadratic_drag", [0.5], [0.5], [0.0], (True, False)),
        ("quadratic_drag", [0.001], [0.5], [0.05], (True, True)),  # more than windows found, not less
        ("constant_force", [0.4, 0.01], [0.4, -0.01], [0.01, 0.01], (True, False)),  # one of two may be nothing
        ("constant_force", [1.0, 1.0], [1.0, 0.0], [1e-2, 1.0], (True, False)),
        ("constant_force", [1.0, 1.0], [1.0, 0.0], [1.0, 1e-2], (False, False)),
        ("constant_force", [2.0, 1.0], [0.0, 1.0], [0.10, 0.06], (False, False)),  # 278 of 678 are left
        ("constant_force", [2.0, 1.0], [0.0, 1.0], [0.10, 0.04], (True, False)),  # 625 of 1025
        ("payload", [0.5], [0.5], [0.01], (True, True)),
        ("steering_gain", [1.4], [1.1], [0.01], (False, True)),  # a quarter of what it differs from 1
        ("steering_gain", [1.4], [1.3], [0.01], (True, True)),
        ("drive_dead_zone", [0.15], [0.15], [0.001], (True, False)),  # with a corner it is never certain
    ],
)  # fmt: skip
def test_each_number_counts_by_how_well_the_filter_knows_it(opinion, name, windows, filtered, std, wanted):
    """What is left: sum(w f / s^2) / sum(w^2 / s^2), from where the effect does nothing."""
    assert opinion(name, windows, filtered, std) == wanted


@pytest.mark.parametrize(
    ("gain", "after", "before", "decided"),
    [
        (5.0, 0.09, 0.1, False), (9.0, 0.09, 0.1, True), (8.0, None, 0.1, False), (8.001, None, 0.1, True),
        (5.0, 0.08, 0.1, True), (5.0, None, 0.1, False), (0.0, 0.85 * 0.125, 0.125, False), (0.0, 0.10624, 0.125, True),
        (5.0, 0.18, 0.2, False), (0.0, None, 0.25, False), (0.0, None, 0.2501, True), (5.0, 0.38, 0.4, True),
    ],
)  # fmt: skip
def test_blocks_decide_alone_if_the_gain_is_clear_the_error_falls_far_or_much_is_missing(gain, after, before, decided):
    """While a quarter is missing, the filter takes friction itself for lasting pushes."""
    error = None if after is None else SimpleNamespace(value=after)
    assert is_decisive(gain, error, SimpleNamespace(value=before)) is decided


def test_the_filter_must_confirm_every_effect_and_a_short_recording_decides_nothing(monkeypatch):
    items = [effect("car", name) for name in ("quadratic_drag", "understeer")]
    parameters = {f"{item.name}.{p.name}": p for item in items for p in item.parameters}

    def model(*values):
        settings = {path: SimpleNamespace(value=v) for path, v in zip(parameters, values, strict=True)}
        return SimpleNamespace(settings=settings, parameters=parameters)

    fit = SimpleNamespace(model=model(0.5, 0.5), paths=tuple(parameters), free=None)
    trial = SimpleNamespace(effects=("quadratic_drag", "understeer"), fit=fit)
    search = SimpleNamespace(shooting=SimpleNamespace(windows="windows"))
    asked = []

    def answers(found):
        def refined(*arguments):
            asked.append(arguments)
            return found

        monkeypatch.setattr(acceptance, "prediction_error_fit", refined)
        return filter_agrees(trial, search), filter_is_certain(trial, search)

    small = np.array([0.01, 0.01])
    assert answers(SimpleNamespace(model=model(0.5, 0.5), paths=tuple(parameters), deviations=small)) == (True, True)
    assert answers(SimpleNamespace(model=model(0.5, 0.1), paths=tuple(parameters), deviations=small)) == (False, True)
    assert answers(SimpleNamespace(model=model(0.1, 0.05), paths=tuple(parameters), deviations=small)) == (False, False)
    assert answers(None) == (True, False), "too short for the filter"
    assert {one[3:] for one in asked} == {("windows", 3)}


@pytest.mark.parametrize(
    ("before", "after", "order"),
    [
        (0.6, {"understeer": 0.52, "steering_gain": 0.5, "viscous_drag": 0.36},
         ["viscous_drag", "understeer", "steering_gain"]),
        (0.6, {"understeer": 0.52, "viscous_drag": 0.45}, ["understeer", "viscous_drag"]),  # only a little more
        (0.2, {"understeer": 0.18, "viscous_drag": 0.1}, ["understeer", "viscous_drag"]),  # little is missing
        (0.6, {}, []),
    ],
)  # fmt: skip
def test_while_much_is_missing_the_effect_with_the_far_larger_error_reduction_comes_first(before, after, order):
    """``after``: from the best in the windows on."""
    trials = [SimpleNamespace(effects=(name,)) for name in after]
    errors = {(name,): SimpleNamespace(value=value) for name, value in after.items()}
    found = order_by_heldout_gain(trials, SearchStage(0, trials, {}, errors), SimpleNamespace(value=before))
    assert [trial.effects[0] for trial in found] == order


@pytest.fixture
def searching(plain, with_effect, drive):
    """searching(hidden effects with their numbers, accepted names, their rivals) -> (search, held-out windows) on a
    car's noisy runs."""

    def made(hidden, names, rivals, base=plain, faster=0.0):
        truth = base
        for name, numbers in hidden.items():
            truth = with_effect(truth, name, **numbers)
        runs = [noisy(drive(truth, 20.0, seed, name=str(seed), faster=faster), seed) for seed in range(4)]
        shooting, heldout = shooting_of(runs, 1.0), heldout_of(runs, 1.0)
        search = initial_search(base, shooting, heldout)
        trial = fit_trial(search.current, of_car(names), search.shooting)
        alone = fit_trial(search.current, of_car(rivals[:1]), search.shooting)
        gained = error_with(trial.fit, shooting, heldout)
        search.candidates = [
            JudgedTrial(0, trial, 9.0, gained, "accepted", "gain", ()),
            JudgedTrial(0, alone, 9.0, None, "rejected", "gain", ()),
        ]
        search.rivals = {names[0]: rivals}
        search.library = of_car(dict.fromkeys([*names, *rivals]))
        accept_trial(search, trial)
        return search

    return made


def servo_car():
    values = {"wheelbase": 0.32, "speed_gain": 4.0, "acceleration_limit": 5.0}
    return PhysicsModel(KinematicBicycle(), (), {f"base.{name}": Setting(value) for name, value in values.items()})


def of_car(names):
    return [effect("car", name) for name in names]


def accepted(search):
    return [item.trial.name for item in search.candidates if item.decision == "accepted"]


def noisy(run, seed):
    random = np.random.default_rng(seed)
    states = run.states + random.normal(0.0, [0.002, 0.002, 0.003, 0.015], run.states.shape)
    return Run(run.name, run.system, run.t, states, run.actions, run.stretches)


TOWED = {"mass_ratio": 0.5, "deceleration": 0.6}


def test_a_payload_and_a_rolling_resistance_are_merged_into_a_towed_load(searching):
    search = searching({"towed_load": TOWED}, ["rolling_resistance", "payload"], ["towed_load"])
    before = search.error.value
    assert merge_effects(search)
    assert search.added == ["towed_load"]
    assert search.error.value <= 1.002 * before
    assert search.current.fit.model.settings["towed_load.mass_ratio"].value == pytest.approx(0.5, rel=0.1)
    assert accepted(search) == ["towed_load"]


def test_two_effects_without_an_equivalent_third_stay(searching):
    hidden = {"turning_drag": {"coefficient": 2.0}}
    search = searching(hidden, ["turning_drag", "steering_lag"], ["towed_load"])
    assert not merge_effects(search)
    assert search.added == ["turning_drag", "steering_lag"]


def test_a_towed_load_without_resistance_becomes_a_payload(searching):
    hidden = {"payload": {"mass_ratio": 0.5}, "steering_lag": {"time_constant": 0.15}}
    search = searching(hidden, ["towed_load", "steering_lag"], ["viscous_drag", "payload"])
    before = search.error.value
    exchange_for_fewer_parameters(search)
    assert search.added == ["payload", "steering_lag"]
    assert search.error.value <= 1.002 * before
    assert accepted(search) == ["steering_lag + payload"]


def test_a_towed_load_that_resists_stays(searching):
    hidden = {"towed_load": TOWED, "steering_lag": {"time_constant": 0.15}}
    search = searching(hidden, ["towed_load", "steering_lag"], ["payload", "rolling_resistance"])
    exchange_for_fewer_parameters(search)
    assert search.added == ["towed_load", "steering_lag"]


def test_two_effects_are_exchanged_for_two_with_fewer_parameters(searching):
    """A towed load and a drag stood for a resistance and a servo that stays below its command."""
    hidden = {"rolling_resistance": {"deceleration": 0.5}, "speed_command_gain": {"gain": 0.8}}
    names, true = ["towed_load", "viscous_drag"], ["speed_command_gain", "rolling_resistance"]
    search = searching(hidden, names, true, servo_car(), 2.5)
    before = search.error.value
    exchange_for_fewer_parameters(search)
    assert search.added == true
    assert search.error.value <= 1.002 * before
    assert accepted(search) == [" + ".join(true)]


def test_a_common_delay_that_imitates_two_lags_is_split_into_them(searching):
    hidden = {"steering_lag": {"time_constant": 0.25}, "drive_lag": {"time_constant": 0.1}}
    search = searching(hidden, ["actuator_delay"], ["steering_lag", "drive_lag", "payload"])
    before = search.error.value
    split_effect(search)
    assert search.added == ["steering_lag", "drive_lag"]
    assert search.error.value < 0.9 * before
    assert accepted(search) == ["steering_lag + drive_lag"]


def test_an_effect_that_a_split_pushes_to_its_bound_is_removed(searching):
    hidden = {"steering_lag": {"time_constant": 0.25}, "drive_lag": {"time_constant": 0.1}}
    search = searching(hidden, ["actuator_delay", "turning_drag"], ["steering_lag", "drive_lag", "payload"])
    split_effect(search)
    assert search.added == ["steering_lag", "drive_lag"]
    assert bool(search.current.fit.free.all())
    assert accepted(search) == ["steering_lag + drive_lag"]


def test_a_true_common_delay_is_not_split(searching):
    hidden = {"actuator_delay": {"seconds": 0.12}}
    search = searching(hidden, ["actuator_delay"], ["steering_lag", "drive_lag"])
    split_effect(search)
    assert search.added == ["actuator_delay"]


def test_an_equivalent_rival_is_reported(searching):
    """Below its limit a servo with a drag stays below its command, like one with a smaller gain."""
    hidden = {"viscous_drag": {"coefficient": 0.4}, "payload": {"mass_ratio": 0.3}}
    names, rivals = ["speed_command_gain", "payload"], ["viscous_drag", "rolling_resistance", "steering_lag"]
    search = searching(hidden, names, rivals, servo_car(), 1.0)
    mark_equivalent_rivals(search)
    (reported,) = [item.equals for item in search.candidates if item.decision == "accepted"]
    assert (reported, search.added) == (("viscous_drag",), names)


def test_a_single_effect_gets_no_equivalent_rivals_after_the_search(searching):
    search = searching({"viscous_drag": {"coefficient": 0.4}}, ["viscous_drag"], ["quadratic_drag"])
    mark_equivalent_rivals(search)
    assert [item.equals for item in search.candidates if item.decision == "accepted"] == [()]


def test_the_commands_that_an_effect_delays_are_determined():
    def late(robot, name, *names):
        return set(delayed_actions(effect(robot, name), names))

    assert late("car", "steering_lag", "target_speed", "steer") == {"steer"}
    assert late("car", "actuator_delay", "target_speed", "steer") == {"target_speed", "steer"}
    assert late("car", "drive_delay", "throttle", "steer") == {"throttle"}
    assert late("car", "steering_gain", "target_speed", "steer") == set()
    assert late("car", "quadratic_drag", "target_speed", "steer") == set()
    assert late("pendulum", "torque_lag", "torque") == {"torque"}


@pytest.mark.parametrize(
    ("have", "name", "seconds", "after", "feigned"),
    [
        ({}, "drive_delay", 0.03, 0.095, True),  # less than a row of 0.05 s
        ({}, "drive_delay", 0.03, 0.080, False),  # clearly there
        ({}, "drive_delay", 0.12, 0.095, False),
        ({"steering_lag": 0.1}, "steering_delay", 0.06, 0.095, True),  # late already
        ({"steering_lag": 0.1}, "actuator_delay", 0.06, 0.095, True),
        ({"steering_lag": 0.1}, "actuator_delay", 0.06, 0.080, False),
        ({"steering_lag": 0.1}, "drive_delay", 0.06, 0.095, False),
        ({}, "understeer", 0.02, 0.095, False),
    ],
)
def test_a_delay_that_the_servo_or_another_delay_can_imitate_is_spurious(
    plain, with_effect, have, name, seconds, after, feigned
):
    model = plain
    for other, value in have.items():
        model = with_effect(model, other, time_constant=value)
    item = effect("car", name)
    model = model.with_effect(item, {item.parameters[0].name: Setting(seconds)})
    trial = SimpleNamespace(effects=(name,), fit=SimpleNamespace(model=model))
    assert is_spurious_delay(trial, SimpleNamespace(value=after), SimpleNamespace(value=0.1), 0.05) is feigned


@pytest.fixture(scope="module")
def towing(tmp_path_factory):
    """The pymunk car with a chair, driven for 6 runs of 40 s."""
    log = write_case(cases_of("towing", 1, seed=52)[0], tmp_path_factory.mktemp("towing"))
    model = load_model(str(log.model))
    return log, model, [load_run(str(path), model.system) for path in log.runs]


@pytest.mark.long
def test_uncertainty_about_an_effect_increases_the_deviation_of_the_others(towing):
    """A load's mass moves by several of its deviations with a lag of the drive that takes hardly anything off."""
    _, model, runs = towing
    shooting, heldout = shooting_of(runs, 1.0), heldout_of(runs, 1.0)

    def fitted(*names):
        made = model
        for name in names:
            item = effect("car", name)
            made = made.with_effect(item, {p.name: Setting(p.typical) for p in item.parameters})
        own = shooting.around(made)
        return fit(made, [path for path in made.settings if path.split(".")[0] in names], own, np.full(4, 0.02))

    search = initial_search(model, shooting, heldout)
    less, full = fitted("towed_load"), fitted("towed_load", "drive_lag")
    search.current = SimpleNamespace(fit=full)
    search.error = error_with(full, search.shooting, heldout)
    near, is_decisive = search.error, SimpleNamespace(value=2.0 * search.error.value)
    number = full.paths.index("towed_load.mass_ratio")
    apart = abs(full.values[number] - less.values[less.paths.index("towed_load.mass_ratio")])
    own = max(full.deviations(search.shooting)[number], group_jackknife_deviation(full, search.shooting)[number])
    for error, expected in ((near, np.hypot(own, 0.5 * apart)), (is_decisive, own)):
        search.without = {"drive_lag": (SimpleNamespace(fit=less), error)}
        assert with_model_uncertainty(full, search).deviations(search.shooting)[number] == pytest.approx(expected)
    assert apart > full.deviations(search.shooting)[number]


@pytest.mark.long
def test_a_towed_chair_is_found_with_its_mass_and_no_false_effects(towing):
    """No number appears twice in the report with different values."""
    log, model, runs = towing
    report = diagnose(model, runs)
    document = as_document(report)
    outcome = judged("towing", document, json.loads(log.truth.read_text(encoding="utf-8")), None, 0.0)
    assert outcome.first_named
    assert outcome.wrong == ()
    assert max(abs(value) for value in outcome.deviations) < 2.0
    for item in report.candidates:
        if item.decision == "accepted" and set(item.effect.split(" + ")) <= set(report.added):
            for key, value in item.parameters.items():
                assert value == report.parameters[key if "." in key else f"{item.effect}.{key}"]
            assert item.heldout_error in [stage.heldout_error for stage in report.stages]


NAMES = ("towed_load", "rolling_resistance", "viscous_drag")


@pytest.fixture(scope="module")
def stage(tmp_path_factory):
    """(search, trials by effect) of a car with a free gain whose dry friction is hidden."""
    hidden = {"rolling_resistance": {"deceleration": 0.6}}
    case = Case("test", 4, hidden, drive="throttle", hard=True, runs=3, seconds=15)
    log = write_case(case, tmp_path_factory.mktemp("free_gain"))
    model = load_model(str(log.model))
    evidence = data_at_horizon([load_run(str(path), model.system) for path in log.runs], 1.0)
    search = initial_search(model, evidence.shooting, evidence.heldout)
    return search, {name: fit_trial(search.current, [effect("car", name)], search.shooting) for name in NAMES}


def test_of_two_equivalent_effects_the_one_with_fewer_parameters_is_added(stage):
    """(gain u - m d) / (1 + m) with a free gain is gain u - d."""
    search, trials = stage
    assert fewest_parameters(trials["towed_load"], list(trials.values()), search) is trials["rolling_resistance"]


def test_an_effect_that_explains_something_else_is_not_replaced(stage):
    search, trials = stage
    towed = trials["towed_load"]
    assert fewest_parameters(towed, [towed, trials["viscous_drag"]], search) is towed
    assert fewest_parameters(trials["viscous_drag"], list(trials.values()), search) is trials["viscous_drag"]


@pytest.fixture(scope="module")
def carpet(tmp_path_factory):
    case = Case(
        "test", 11, {"rolling_resistance": {"deceleration": 0.9, "x_above": 0.4}},
        laws={"rolling_resistance": "where x above"}, runs=2, seconds=15.0,
    )  # fmt: skip
    return write_case(case, tmp_path_factory.mktemp("carpet"))


@pytest.mark.parametrize("given", [0.0, 0.5])
def test_the_effects_of_the_model_stay_and_their_free_numbers_are_fitted(carpet, given):
    """A carpet beyond a line: with the library it would be found, and the plain resistance would get a law."""
    model = load_model(carpet.model)
    if given:
        model = model.with_effect(effect("car", "rolling_resistance"), {"deceleration": Setting(given, free=True)})
    runs = [load_run(path, model.system) for path in carpet.runs]
    search = run_search(model, [], shooting_of(runs, 1.0), heldout_of(runs, 1.0))
    found = search.current.fit.model
    assert [type(item) for item in found.effects] == [type(item) for item in model.effects]
    assert (search.added, search.candidates) == ([], [])
    assert found.settings.keys() == model.settings.keys()
    changed = {name for name, setting in found.settings.items() if setting.value != model.settings[name].value}
    assert changed == {name for name, setting in model.settings.items() if setting.free}
    assert search.error.value <= search.first_error.value
