"""Margins from runs: which steps teach them, and that they are kept with the model."""

import dataclasses
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.safety.node_steps import CAR, LATE, SETTINGS, latent_at, state_at

from safedpa.bus import LATENT as LATENTS
from safedpa.bus import STATE as STATES
from safedpa.bus import LatentMessage, StateMessage
from safedpa.bus.messages.codec import encode
from safedpa.bus.messages.topics import key_of
from safedpa.calibration import from_runs as live_margin_module
from safedpa.calibration.from_drives import DriveTick, barrier_residuals
from safedpa.calibration.from_recordings import (
    RecordedBound,
    RecordedTransitions,
    calibration_from_recordings,
    recorded_bound,
)
from safedpa.calibration.from_runs import calibration_from_runs, live_margin
from safedpa.dynamics import PhysicsModel, Setting, fingerprint, load_model
from safedpa.effects import effect
from safedpa.errors import InputError
from safedpa.records import McapRecorder
from safedpa.records.run import Run, Stretch
from safedpa.safety.defaults import margin_for, settings_named
from safedpa.safety.margins.calibration import MarginCalibration, margin_from_text
from safedpa_lab.experiments.driving.safety_pays import HIDDEN, incomplete_model, oracle_model


def driven(model: PhysicsModel, rows: int = 300) -> Run:
    """What the model itself does under steps of speed and steer."""
    random = np.random.default_rng(4)
    actions = np.column_stack(
        [np.repeat(random.uniform(0.2, 2.0, 30), 10), np.repeat(random.uniform(-0.3, 0.3, 30), 10)]
    )
    states = np.zeros((rows, 4))
    memory = model.initial_memory(actions[0])
    for row in range(rows - 1):
        states[row + 1], memory = model.advance(states[row], actions[row], memory)
    return Run("run", model.system, model.period * np.arange(rows), states, actions, (Stretch(0, rows),))


@pytest.mark.parametrize("name", HIDDEN)
def test_the_true_model_needs_no_margin_and_the_incomplete_one_does(name: str) -> None:
    true, settings = oracle_model(HIDDEN[name]), settings_named("car")
    run = driven(true)
    right = calibration_from_runs(true, settings, [run], 0.95, "2024-01-01")
    wrong = calibration_from_runs(incomplete_model(), settings, [run], 0.95, "2024-01-01")
    assert right.epsilon["obstacle"] < 1e-9
    assert wrong.epsilon["obstacle"] > 0.002
    assert right.fingerprint != wrong.fingerprint


def test_a_saved_margin_belongs_to_its_model_and_other_robots_and_periods_are_refused(tmp_path) -> None:
    model = incomplete_model()
    calibration = calibration_from_runs(model, settings_named("car"), [driven(model)], 0.95, "2024-01-01")
    calibration.save(tmp_path / "margin.toml")
    assert MarginCalibration.load(tmp_path / "margin.toml") == calibration
    assert margin_for(model, str(tmp_path / "margin.toml")) == calibration
    with pytest.raises(InputError, match=r"got bounds of -0\.6 to 2 1 for throttle"):
        calibration_from_runs(load_model("dart_car"), settings_named("car"), [], 0.9, "2024-01-01")
    run = driven(incomplete_model())
    slow = Run(run.name, run.system, 2.0 * run.t, run.states, run.actions, run.stretches)
    with pytest.raises(InputError, match=r"no transition of 0\.05 s"):
        calibration_from_runs(incomplete_model(), settings_named("car"), [slow], 0.9, "2024-01-01")


def test_a_prediction_without_numbers_is_no_error_of_zero() -> None:
    """A state beyond all numbers: the model has no finite answer, and the margin may not count that as right."""
    run = driven(incomplete_model())
    states = run.states.copy()
    states[7, 3] = 1e308
    wild = Run(run.name, run.system, run.t, states, run.actions, run.stretches)
    with np.errstate(all="ignore"), pytest.raises(InputError, match="errors: got shape"):
        calibration_from_runs(incomplete_model(), settings_named("car"), [wild], 0.9, "2024-01-01")


def stranger() -> PhysicsModel:
    """A car but for the names of its states, so that no robot declares it."""
    model = incomplete_model()
    states = tuple(dataclasses.replace(one, name=f"other_{one.name}") for one in model.system.state)
    model.system = dataclasses.replace(model.system, name="stranger", state=states)
    return model


@pytest.mark.parametrize(
    ("made", "settings"), [(stranger, "car"), (lambda: load_model("point_wind"), "point")], ids=["stranger", "point"]
)
def test_a_robot_around_whose_states_no_barriers_can_be_drawn_gets_no_margin(made: Any, settings: str) -> None:
    model, chosen = made(), settings_named(settings)
    states, actions = np.zeros((4, len(model.system.state))), np.zeros((4, len(model.system.action)))
    run = Run("run", model.system, model.period * np.arange(4), states, actions, (Stretch(0, 4),))
    with pytest.raises(InputError, match="wanted a robot that supports calibration from logs"):
        calibration_from_runs(model, chosen, [run], 0.5, "2024-01-01")
    assert live_margin(model, chosen, run, ()) == ""
    nothing: Any = None  # not one transition is looked at
    assert recorded_bound(model, chosen, nothing, np.zeros(0, dtype=bool), 0.5) == RecordedBound({}, {})


def swung(model: PhysicsModel, rows: int = 400) -> Run:
    """A pendulum under torques at random, each held for a tenth of a second."""
    torques = np.repeat(np.random.default_rng(6).uniform(-8.0, 8.0, (rows // 10, 1)), 10, axis=0)
    states = np.zeros((rows, 2))
    for row in range(rows - 1):
        states[row + 1] = model.step(states[row], torques[row])
    return Run("swing", model.system, model.period * np.arange(rows), states, torques, (Stretch(0, rows),))


def test_a_pendulum_needs_the_margin_that_its_payload_makes() -> None:
    """h errs by corridor_seconds times the error of the rate: the same at either edge of any corridor."""
    bare, settings = load_model("pendulum"), settings_named("pendulum")
    run = swung(bare.with_effect(effect("pendulum", "tip_mass"), {"mass": Setting(0.5)}))
    loaded = bare.with_effect(effect("pendulum", "tip_mass"), {"mass": Setting(0.5)})
    right = calibration_from_runs(loaded, settings, [run], 0.95, "2024-01-01")
    wrong = calibration_from_runs(bare, settings, [run], 0.95, "2024-01-01")
    assert right.epsilon["corridor"] < 1e-9
    predicted = np.array([bare.step(state, torque) for state, torque in zip(run.states, run.actions, strict=True)])
    ahead = predicted[:-1] @ [1.0, 0.25] - run.states[1:] @ [1.0, 0.25]
    assert wrong.epsilon["corridor"] == pytest.approx(np.quantile(np.abs(ahead), 0.95), rel=0.1)
    assert wrong.fingerprint != right.fingerprint
    text = live_margin(loaded, settings, run, ())
    assert margin_from_text(text).epsilon["corridor"] < 1e-9, "so an effect can be accepted while it swings"


def test_a_robot_of_another_rate_gets_a_margin_of_its_own_steps_with_a_corrected_model() -> None:
    """Of steps of 0.05 s there are none in its run, and one without a margin could not be accepted at all."""
    model, settings = incomplete_model(), settings_named("car")
    usual = margin_from_text(live_margin(model, settings, driven(oracle_model(HIDDEN["steering_offset"])), ()))
    quick = oracle_model(HIDDEN["steering_offset"]).with_period(0.01)
    found = margin_from_text(live_margin(model, settings, driven(quick), ()))
    assert (usual.period, found.period) == pytest.approx((0.05, 0.01))
    assert found.fingerprint == usual.fingerprint == fingerprint(model)
    assert 0.0 < found.epsilon["obstacle"] < usual.epsilon["obstacle"]
    jitters = driven(oracle_model(HIDDEN["steering_offset"]))
    jitters = dataclasses.replace(jitters, t=1.02 * jitters.t)
    assert margin_from_text(live_margin(model, settings, jitters, ())).period == 0.05


@pytest.mark.parametrize("newest", [{"obstacle": 0.01, "field": 0.03}, None])
def test_the_larger_margin_of_all_and_of_the_newest_half_counts(newest, monkeypatch):
    """Of the half only stretches that hold a transition; where it is too short, all of the run decides alone."""
    asked: list[tuple[Stretch, ...]] = []
    tables = [{"obstacle": 0.02, "field": 0.01, "speed": 0.05}, newest]

    def calibrated(*given: object) -> MarginCalibration:
        (run,) = given[2]  # type: ignore[misc]
        asked.append(run.stretches)
        if (table := tables[len(asked) - 1]) is None:
            raise InputError("too short")
        return MarginCalibration(table, 0.99, 100, "2024-01-01", "f")

    monkeypatch.setattr(live_margin_module, "calibration_from_runs", calibrated)
    model = incomplete_model()
    stretches = (Stretch(0, 6), Stretch(5, 11), Stretch(6, 12), Stretch(13, 20))
    run = dataclasses.replace(driven(model, 20), stretches=stretches)
    found = margin_from_text(live_margin(model, settings_named("car"), run, ())).epsilon
    assert asked == [stretches, (Stretch(10, 12), Stretch(13, 20))]
    assert found == {"obstacle": 0.02, "field": 0.03 if newest else 0.01, "speed": 0.05}


STAMP = {"epoch": 1, "tick": 0, "robot_time": 0.0, "publish_time": 0.0}
STATE = StateMessage(
    **STAMP, values=(0.0, 0.0, 0.0, 1.0), applied=(0.0, 0.0), applied_by="filter", period=0.05, lockstep=False,
    goal=(1.0, 1.0), obstacles=(), field=(-4.0, 4.0, -4.0, 4.0), footprint=(0.1, 0.3, 0.2),
)  # fmt: skip
LATENT = LatentMessage(**STAMP, model="0123456789ab", values=(0.0,), deviations=(0.1,))


def tick(number: int, *, by: str = "filter", adapted: bool = True) -> DriveTick:
    """The state of a tick is its number, and its latent ten times that; who drove until there."""
    state = replace(STATE, tick=number, values=(float(number), 0.0, 0.0, 1.0), applied=(0.1 * number, 0.0))
    latent = replace(LATENT, tick=number, values=(10.0 * number,)) if adapted else None
    return DriveTick(replace(state, applied_by=by, robot_time=STATE.period * number), latent)


def test_a_transition_holds_what_was_known_before_it_and_what_became_of_it() -> None:
    found = RecordedTransitions([[tick(3), tick(4), tick(5)], [tick(8), tick(9)]])
    assert found.state[:, 0].tolist() == [3.0, 4.0, 8.0]
    assert found.following[:, 0].tolist() == [4.0, 5.0, 9.0]
    np.testing.assert_allclose(found.action[:, 0], [0.4, 0.5, 0.9])  # what led to the second state
    assert found.latent[:, 0].tolist() == [30.0, 40.0, 80.0]
    assert found.drive.tolist() == [0, 0, 1]


def test_over_gaps_and_where_adaptation_was_silent_there_is_no_transition() -> None:
    found = RecordedTransitions([[tick(0), tick(1, adapted=False), tick(2), tick(3)]])
    assert found.state[:, 0].tolist() == [0.0, 2.0]
    assert RecordedTransitions([[tick(0), tick(2), tick(3)]]).state[:, 0].tolist() == [2.0]


@pytest.mark.parametrize("by", ["watchdog", "no_one"])
def test_steps_under_another_action_than_the_filters_are_left_out(by: str) -> None:
    found = RecordedTransitions([[tick(0), tick(1, by=by), tick(2)]])
    assert found.state[:, 0].tolist() == [1.0]


@pytest.mark.parametrize("ticks", [[], [tick(0)], [tick(0, adapted=False), tick(1)], [tick(0), tick(1, by="watchdog")]])
def test_where_none_is_left_it_says_so(ticks: list[DriveTick]) -> None:
    with pytest.raises(InputError, match="no transition with an action of the filter and a latent"):
        RecordedTransitions([ticks])


def recorded(path: Path, *reported: tuple[str, int, int], model: str = "0123456789ab") -> Path:
    """State and latent of each (robot, epoch, tick), in this order; of tick 2 no latent was heard."""
    with McapRecorder(path) as recorder:
        for robot, epoch, number in reported:
            state = replace(tick(number).state, epoch=epoch, values=(0.01 * number, 0.0, 0.0, 0.2))
            latent = replace(LATENT, epoch=epoch, tick=number, values=tuple(CAR.latent.tolist()), model=model)
            recorder.write(key_of("fleet", robot, STATES), encode(state), number, number)
            if number != 2:
                recorder.write(key_of("fleet", robot, LATENTS), encode(latent), number, number)
    return path


def test_each_start_of_each_robot_is_a_drive_with_its_ticks_in_order(tmp_path: Path) -> None:
    """Three robots that start twice each, and messages in any order; the fifth drive measures the coverage."""
    reported = [(robot, epoch, number) for robot in "abc" for epoch in (7, 8) for number in range(60)]
    mixed = [reported[place] for place in np.random.default_rng(0).permutation(len(reported)).tolist()]
    path = recorded(tmp_path / "drive.mcap", *mixed, model=fingerprint(CAR))
    made = calibration_from_recordings(CAR, SETTINGS, [path], 0.5, "2024-01-01")
    assert (made.drives, made.transitions, made.period) == (5, 5 * 59, 0.05)
    few = recorded(tmp_path / "few.mcap", *reported[:240], model=fingerprint(CAR))
    with pytest.raises(InputError, match="drives: got 4, wanted at least 5 to hold one of them out; record more"):
        calibration_from_recordings(CAR, SETTINGS, [few], 0.5, "2024-01-01")


def test_latents_of_another_model_are_refused(tmp_path: Path) -> None:
    """They have the same numbers, and another meaning: a margin from them would be of neither model."""
    path = recorded(tmp_path / "drive.mcap", ("a", 7, 0), ("a", 7, 1), model="ba9876543210")
    with pytest.raises(
        InputError, match=r"drive\.mcap: latents of model ba9876543210, wanted .*; drive with that model"
    ):
        calibration_from_recordings(CAR, SETTINGS, [path], 0.5, "2024-01-01")


def drive(**changed: Any) -> list[DriveTick]:
    """Six ticks of a car that drives straight on at 0.5 m/s; ``changed`` is what is different at the third."""
    ticks = []
    for tick in range(6):
        state = state_at(tick, (0.025 * tick, 0.0, 0.0, 0.5), applied=(0.5, 0.0))
        ticks.append(DriveTick(state, latent_at(state)))
    latent = ticks[3].latent if changed.pop("adapted", True) else None
    ticks[3] = DriveTick(replace(ticks[3].state, **changed), latent)
    return ticks


def reached(ticks: list[DriveTick]) -> list[int]:
    """Ticks whose measured h was compared with a prediction; the car comes 0.025 m nearer to the wall in each."""
    found = barrier_residuals(CAR, SETTINGS, ticks)["obstacle"]
    assert found.shape[1] == 4
    first = barrier_residuals(CAR, SETTINGS, drive())["obstacle"][0, 1]
    return [round(1 + (first - measured) / 0.025) for measured in found[:, 1]]


def test_steps_of_a_robot_that_waits_do_not_make_the_margin_smaller() -> None:
    """A margin of a drive with an hour of rest is that of the drive alone."""
    moving = drive()
    at = (0.125, 0.0, 0.0, 0.0)
    resting = [state_at(tick, at, applied=(0.0, 0.0)) for tick in range(6, 60)]
    ticks = [*moving, *(DriveTick(state, latent_at(state)) for state in resting)]
    assert len(barrier_residuals(CAR, SETTINGS, ticks)["obstacle"]) == len(moving)
    assert barrier_residuals(CAR, SETTINGS, ticks[10:])["obstacle"].shape == (0, 4)


@pytest.mark.parametrize(
    ("changed", "counted"),
    [
        ({}, [1, 2, 3, 4, 5]), ({"applied_by": "watchdog"}, [1, 2, 4, 5]), ({"applied_by": "none"}, [1, 2, 4, 5]),
        ({"tick": 7}, [1, 2, 5]), ({"tick": 4}, [1, 2, 5]), ({"tick": 2}, [1, 2, 5]), ({"footprint": ()}, [1, 2, 5]),
        ({"goal": ()}, [1, 2, 3, 4, 5]), ({"adapted": False}, [1, 2, 3, 4, 5]),
    ],
    ids=str,
)  # fmt: skip
def test_only_steps_under_the_filters_own_action_count(changed: dict[str, Any], counted: list[int]) -> None:
    assert reached(drive(**changed)) == counted


def test_what_the_recorded_action_leads_to_is_compared_with_what_came() -> None:
    heights = barrier_residuals(CAR, SETTINGS, drive())
    assert set(heights) >= {"obstacle", "speed"}
    np.testing.assert_allclose(heights["obstacle"][:, 0], heights["obstacle"][:, 1], atol=1e-9)
    faster = [tick._replace(state=replace(tick.state, applied=(1.5, 0.0))) for tick in drive()]
    hoped, came = barrier_residuals(CAR, SETTINGS, faster)["obstacle"][:, :2].T
    assert (hoped < came - 1e-3).all(), "a car with a command to drive faster is expected nearer to the wall"


@pytest.mark.parametrize("twice", [12, 21])
def test_actuators_remember_their_commands_over_a_state_that_was_recorded_twice(twice: int) -> None:
    run = driven(LATE, 30)
    applied = [run.actions[0], *run.actions]
    states = [state_at(k, tuple(run.states[k].tolist()), applied=tuple(applied[k].tolist())) for k in range(30)]
    ticks = [DriveTick(state, latent_at(state, LATE)) for state in [*states[: twice + 1], *states[twice:]]]
    heights = barrier_residuals(LATE, SETTINGS, ticks)["obstacle"]
    assert len(heights) == 29
    np.testing.assert_allclose(heights[:, 0], heights[:, 1], atol=1e-9)


def test_without_ticks_there_are_no_errors() -> None:
    assert barrier_residuals(CAR, SETTINGS, []) == {}
    assert barrier_residuals(CAR, SETTINGS, [DriveTick(tick.state, None) for tick in drive()]) == {}
