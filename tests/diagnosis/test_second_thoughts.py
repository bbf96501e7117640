"""Which of two sure effects comes first while much is missing, and groups of effects that give way to others."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from safedpa.diagnosis.fit.heldout import error_with, heldout_of
from safedpa.diagnosis.fit.shooting import shooting_of
from safedpa.diagnosis.fit.trial import tried
from safedpa.diagnosis.search.beginning import begun
from safedpa.diagnosis.search.judgement import Stage, farthest
from safedpa.diagnosis.search.progress import Judged
from safedpa.diagnosis.search.revision import fewer_numbers, same_at_last, split, united
from safedpa.diagnosis.search.search import accept
from safedpa.dynamics import PhysicsModel, Setting
from safedpa.effects import effect
from safedpa.records.run import Run
from safedpa.robots.car.kinematic_bicycle import KinematicBicycle


def ordered(before, **after):
    """Names in the order in which they are asked, the first the best in the windows."""
    trials = [SimpleNamespace(effects=(name,)) for name in after]
    errors = {(name,): SimpleNamespace(value=value) for name, value in after.items()}
    stage = Stage(0, trials, {}, errors)
    return [trial.effects[0] for trial in farthest(trials, stage, SimpleNamespace(value=before))]


def test_while_much_is_missing_the_effect_that_takes_far_more_off_comes_first():
    assert ordered(0.6, understeer=0.52, steering_gain=0.5, viscous_drag=0.36) == [
        "viscous_drag", "understeer", "steering_gain",
    ]  # fmt: skip


def test_a_little_more_off_the_error_changes_nothing():
    assert ordered(0.6, understeer=0.52, viscous_drag=0.45) == ["understeer", "viscous_drag"]


def test_where_little_is_missing_the_windows_decide():
    assert ordered(0.2, understeer=0.18, viscous_drag=0.1) == ["understeer", "viscous_drag"]
    assert ordered(0.6) == []


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
        search = begun(base, shooting, heldout)
        trial = tried(search.current, of_car(names), search.shooting)
        alone = tried(search.current, of_car(rivals[:1]), search.shooting)
        gained = error_with(trial.fit, shooting, heldout)
        search.candidates = [
            Judged(0, trial, 9.0, gained, "accepted", "gain", ()),
            Judged(0, alone, 9.0, None, "rejected", "gain", ()),
        ]
        search.rivals = {names[0]: rivals}
        accept(search, trial, heldout)
        return search, heldout

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


def test_a_payload_and_a_rolling_resistance_are_a_towed_load(searching):
    search, heldout = searching({"towed_load": TOWED}, ["rolling_resistance", "payload"], ["towed_load"])
    before = search.error.value
    assert united(search, of_car(["rolling_resistance", "payload", "towed_load"]), heldout)
    assert search.added == ["towed_load"]
    assert search.error.value <= 1.002 * before
    ratio = search.current.fit.model.settings["towed_load.mass_ratio"].value
    assert ratio == pytest.approx(0.5, rel=0.1)
    assert accepted(search) == ["towed_load"]


def test_two_effects_without_an_equivalent_third_stay(searching):
    search, heldout = searching(
        {"turning_drag": {"coefficient": 2.0}}, ["turning_drag", "steering_lag"], ["towed_load"]
    )
    assert not united(search, of_car(["turning_drag", "steering_lag", "towed_load"]), heldout)
    assert search.added == ["turning_drag", "steering_lag"]


def test_a_towed_load_that_does_not_resist_is_a_payload(searching):
    hidden = {"payload": {"mass_ratio": 0.5}, "steering_lag": {"time_constant": 0.15}}
    search, heldout = searching(hidden, ["towed_load", "steering_lag"], ["viscous_drag", "payload"])
    before = search.error.value
    fewer_numbers(search, of_car(["towed_load", "steering_lag", "viscous_drag", "payload"]), heldout)
    assert search.added == ["payload", "steering_lag"]
    assert search.error.value <= 1.002 * before
    assert accepted(search) == ["steering_lag + payload"]


def test_a_towed_load_that_resists_stays(searching):
    hidden = {"towed_load": TOWED, "steering_lag": {"time_constant": 0.15}}
    search, heldout = searching(hidden, ["towed_load", "steering_lag"], ["payload", "rolling_resistance"])
    fewer_numbers(search, of_car(["towed_load", "steering_lag", "rolling_resistance", "payload"]), heldout)
    assert search.added == ["towed_load", "steering_lag"]


def test_two_effects_give_way_to_two_with_fewer_numbers(searching):
    """A towed load and a drag stood for a resistance and a servo that stays below its command."""
    hidden = {"rolling_resistance": {"deceleration": 0.5}, "speed_command_gain": {"gain": 0.8}}
    names, true = ["towed_load", "viscous_drag"], ["speed_command_gain", "rolling_resistance"]
    search, heldout = searching(hidden, names, true, servo_car(), 2.5)
    before = search.error.value
    fewer_numbers(search, of_car([*names, *true]), heldout)
    assert search.added == true
    assert search.error.value <= 1.002 * before
    assert accepted(search) == [" + ".join(true)]


def test_a_delay_of_all_actuators_that_stood_for_a_lag_of_each_gives_way_to_both(searching):
    hidden = {"steering_lag": {"time_constant": 0.25}, "drive_lag": {"time_constant": 0.1}}
    search, heldout = searching(hidden, ["actuator_delay"], ["steering_lag", "drive_lag", "payload"])
    before = search.error.value
    split(search, of_car(["actuator_delay", "steering_lag", "drive_lag", "payload"]), heldout)
    assert search.added == ["steering_lag", "drive_lag"]
    assert search.error.value < 0.9 * before
    assert accepted(search) == ["steering_lag + drive_lag"]


def test_an_effect_with_nothing_left_to_do_is_removed_too(searching):
    hidden = {"steering_lag": {"time_constant": 0.25}, "drive_lag": {"time_constant": 0.1}}
    search, heldout = searching(hidden, ["actuator_delay", "turning_drag"], ["steering_lag", "drive_lag", "payload"])
    split(search, of_car(["actuator_delay", "turning_drag", "steering_lag", "drive_lag", "payload"]), heldout)
    assert search.added == ["steering_lag", "drive_lag"]
    assert bool(search.current.fit.free.all())
    assert accepted(search) == ["steering_lag + drive_lag"]


def test_a_delay_of_all_actuators_stays_one(searching):
    search, heldout = searching(
        {"actuator_delay": {"seconds": 0.12}}, ["actuator_delay"], ["steering_lag", "drive_lag"]
    )
    split(search, of_car(["actuator_delay", "steering_lag", "drive_lag"]), heldout)
    assert search.added == ["actuator_delay"]


def test_an_effect_that_predicts_the_same_next_to_the_others_is_reported(searching):
    """Below its limit a servo with a drag stays below its command, like one with a smaller gain."""
    hidden = {"viscous_drag": {"coefficient": 0.4}, "payload": {"mass_ratio": 0.3}}
    names, rivals = ["speed_command_gain", "payload"], ["viscous_drag", "rolling_resistance", "steering_lag"]
    search, heldout = searching(hidden, names, rivals, servo_car(), 1.0)
    same_at_last(search, of_car([*names, *rivals]), heldout)
    (told,) = [item.equals for item in search.candidates if item.decision == "accepted"]
    assert told == ("viscous_drag",)
    assert search.added == names


def test_a_single_effect_has_no_equals(searching):
    search, heldout = searching({"viscous_drag": {"coefficient": 0.4}}, ["viscous_drag"], ["quadratic_drag"])
    same_at_last(search, of_car(["viscous_drag", "quadratic_drag"]), heldout)
    assert [item.equals for item in search.candidates if item.decision == "accepted"] == [()]
