"""Backups: how a throttle brakes, which functions a loop is driven by, and which are refused."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from tests.safety.node_steps import asked, latent_at

from safedpa.bus import ACTION, SURROUNDINGS, Stale, StateMessage
from safedpa.dynamics import AbstractDynamics, PhysicsModel, Setting, load_model
from safedpa.effects import effect
from safedpa.errors import InputError
from safedpa.robots.car.barriers.obstacles import braking_of
from safedpa.robots.car.dynamics.throttle import BrakingByThrottle, throttle_for
from safedpa.runtime.node import SafetyFilterNode
from safedpa.runtime.scene import scene_of
from safedpa.safety import FilterSettings, FunctionBarrier, RolloutBarrier, SafetyFilter
from safedpa.safety.barriers.backup_rollout import BackupRollout, fixed, prediction_of
from safedpa.safety.defaults import margin_for, settings_named
from safedpa.systems.robots import robot_like, robots

SETTINGS = settings_named("car_throttle")
BRAKING = braking_of(SETTINGS)
EFFECTS = {
    "nothing": {},
    "dead zone": {"drive_dead_zone": {"width": 0.16}},
    "back-EMF and friction": {"back_emf": {"coefficient": 1.5}, "rolling_resistance": {"deceleration": 0.8}},
    "lag": {"drive_lag": {"time_constant": 0.08}},
}


def model_with(effects: dict[str, dict[str, float]]) -> PhysicsModel:
    model = load_model("dart_car")
    for name, numbers in effects.items():
        model = model.with_effect(effect("car", name), {key: Setting(value) for key, value in numbers.items()})
    return model


def backup_of(model: PhysicsModel) -> BrakingByThrottle:
    return BrakingByThrottle(model, BRAKING, (-1.0, 1.0))


def reported(values: tuple[float, ...], tick: int = 0) -> StateMessage:
    return StateMessage(
        epoch=1, tick=tick, robot_time=0.05 * tick, publish_time=0.0, values=values, applied=(0.0, 0.0),
        applied_by="filter", period=0.05, lockstep=True, goal=(1.0, 0.0), obstacles=((3.0, 0.0, 0.3),),
        field=(-9.0, 9.0, -9.0, 9.0), footprint=(0.05, 0.23, 0.1),
    )  # fmt: skip


@pytest.mark.parametrize("name", EFFECTS)
@pytest.mark.parametrize("speed", [2.0, 0.9, 0.3, -0.7])
def test_it_brakes_as_the_barriers_count_on(name, speed):
    model = model_with(EFFECTS[name])
    action = backup_of(model)(np.array([1.0, 2.0, 0.4, speed]))
    after = model.step(np.array([1.0, 2.0, 0.4, speed]), action)[3]
    wanted = min(BRAKING.gain * abs(speed), BRAKING.deceleration)
    assert (abs(speed) - abs(after)) / model.period == pytest.approx(wanted, abs=0.02)
    assert np.sign(after) == np.sign(speed)
    assert action[1] == 0.0


@pytest.mark.parametrize("name", EFFECTS)
def test_no_h_falls_under_it(name):
    model = model_with(EFFECTS[name])
    scene = scene_of(model, SETTINGS)
    state, lowest = (0.0, 0.2, 0.1, 1.8), []
    for tick in range(60):
        stack = scene.of(reported(state, tick))
        lowest.append(min(stack.h_floats(state)[:-2]))  # room; the last two are the limits of the speed
        state = tuple(model.step(np.array(state), scene.backup(np.array(state))).tolist())
    assert np.diff(lowest).min() > -2e-4
    assert abs(state[3]) < 0.05


def test_with_friction_beyond_the_desired_braking_it_does_not_push():
    model = model_with({"rolling_resistance": {"deceleration": 3.0}})
    action = backup_of(model)(np.array([0.0, 0.0, 0.0, 2.0]))
    assert action[0] == pytest.approx((3.0 - 2.0) / 4.48, abs=1e-3)


def test_a_state_without_information_is_braked_from_the_last_that_had_some_and_no_further():
    model = model_with({})
    scene = scene_of(model, SETTINGS)
    assert scene.backup(None).tolist() == [0.0, 0.0]
    scene.of(reported((0.0, 0.0, 0.0, 1.5)))
    nothing, throttles = (float("nan"),) * 4, []
    for tick in range(1, 40):
        scene.of(reported(nothing, tick))
        throttles.append(float(scene.backup(None)[0]))
    assert throttles[0] == pytest.approx(-BRAKING.deceleration / 4.48, abs=1e-3)
    assert all(now >= before - 1e-9 for before, now in pairwise(throttles))
    assert throttles[-1] == pytest.approx(0.0, abs=0.02)
    assert max(throttles) <= 0.0


def test_another_model_takes_over_what_the_last_one_knew():
    before, after = scene_of(model_with({}), SETTINGS), scene_of(model_with(EFFECTS["dead zone"]), SETTINGS)
    before.of(reported((0.0, 0.0, 0.0, 1.0)))
    after.remember(before)
    assert after.backup(None)[0] < -0.16


def test_the_latent_counts():
    model = model_with({})
    backup = backup_of(model)
    weak = backup(np.array([0.0, 0.0, 0.0, 1.0]))[0]
    backup.learn(np.array([9.0]))
    assert backup(np.array([0.0, 0.0, 0.0, 1.0]))[0] == pytest.approx(weak * 4.48 / 9.0, abs=1e-3)


def test_more_than_the_motor_can_is_its_bound_and_the_model_says_which_car_it_is():
    model = model_with({})
    state = np.array([0.0, 0.0, 0.0, 1.0])
    assert throttle_for(model, state, 0.0, -50.0, (-1.0, 1.0)) == pytest.approx(-1.0, abs=1e-3)
    assert throttle_for(model, state, 0.0, 50.0, (-0.5, 0.5)) == pytest.approx(0.5, abs=1e-3)
    model = load_model("dart_car")
    assert robot_like(model.system).settings_name == "car_throttle"
    assert robots()["car"].of_system(model.system) is robot_like(model.system)
    assert robots()["car"].of_system(load_model("car").system) is robots()["car"]
    with pytest.raises(InputError, match="the system 'car' takes -1 to 1"):
        scene_of(model, settings_named("car"))


def rolled(broken, ticks: int = 60) -> float:
    """The true speed after 3 s from 1.5 m/s, under what the filter's service answers to states that are ``broken``."""
    model = load_model("dart_car")
    node, true = SafetyFilterNode(model, SETTINGS, margin_for(model)), np.array([0.0, 0.0, 0.0, 1.5])
    for tick in range(ticks):
        state = replace(reported(tuple(true.tolist()), tick), obstacles=())
        state, values = (state, tuple(model.latent.tolist())) if tick == 0 else broken(state, tuple(model.latent))
        latent = replace(latent_at(state, model), values=values)
        action = asked(node, state, latent, (0.2, 0.0), Stale(SURROUNDINGS, 1)).action
        true = np.asarray(model.step(true, np.array(action), model.latent))
    return float(true[3])


@pytest.mark.parametrize(
    "broken",
    [
        lambda state, latent: (replace(state, values=()), latent),
        lambda state, latent: (replace(state, values=(), sources=("laser",)), latent),
        lambda state, latent: (replace(state, values=(0.0, 0.0, 0.0, 60.0)), latent),
        lambda state, latent: (state, (*latent, 1.0)),
        lambda state, latent: (state, ()),
        lambda state, latent: (state, (1e9,) * len(latent)),
        lambda state, latent: (state, (-1e9,) * len(latent)),
    ],
    ids=["no values", "no values, sources", "speed of 60", "long latent", "no latent", "vast latent", "vast negative"],
)
def test_whatever_is_reported_wrongly_the_backup_stops_the_car_and_never_drives_it(broken):
    assert abs(rolled(broken)) < 0.2


def test_after_a_step_that_raised_the_car_is_braked_and_not_let_roll():
    model = load_model("dart_car")
    node = SafetyFilterNode(model, SETTINGS, margin_for(model))
    state = reported((0.0, 0.0, 0.0, 1.5))
    node.prepare("r", state)
    first = node.rescue("r", state, "a fault")[ACTION].values
    again = node.rescue("r", replace(state, tick=1), "a fault")[ACTION].values
    assert first[0] < -0.2
    assert again[0] < -0.2
    assert node.rescue("no_one", state, "a fault")[ACTION].values == (0.0, 0.0), "nothing is known of it"


def halved(x: Any, latent: Any = None) -> Any:
    """Affine: a second argument that need not be given makes no step of it."""
    return 0.5 * x, np.eye(1)


def test_functions_are_known_by_their_arguments_and_actuators_that_remember_nothing_are_taken() -> None:
    assert BackupRollout(halved, [1.0]).after(np.array([4.0]), np.array([1.0])) == [3.0]
    assert BackupRollout(lambda x, a: x + 2.0 * a, [1.0]).after(np.array([4.0]), np.array([1.0])) == [6.0]
    model = load_model("car").with_effect(effect("car", "steering_gain"), {"gain": Setting(1.1)})
    assert prediction_of(model).is_project_model


@pytest.mark.parametrize("model", [halved, load_model("car")])
def test_a_users_function_cannot_write_into_what_the_next_one_sees(model: Any) -> None:
    size, actions = (1, [0.0]) if model is halved else (4, [0.0, 0.0])
    loop = BackupRollout(model, actions)
    for kept in (loop.after(np.ones(size), np.array(actions)), fixed(np.ones(size)), loop.action(np.ones(size))):
        with pytest.raises(ValueError, match="read-only"):
            kept[0] = 7.0


@pytest.mark.parametrize("wrong", [None, 1.0, "model", [halved]], ids=["none", "number", "text", "list"])
def test_what_is_no_model_cannot_be_driven(wrong: Any) -> None:
    with pytest.raises(InputError, match=r"^model: got .*, wanted a model, a Prediction, affine"):
        RolloutBarrier(wrong, [0.0], lambda x: x[0], 2)


def test_a_backup_answers_with_a_row_of_actions_and_a_path_ends_where_nothing_moves() -> None:
    with pytest.raises(InputError, match=r"^backup: got shape .*, wanted"):
        BackupRollout(lambda x, a: x + a, lambda _: [[1.0]]).action(np.zeros(1))
    assert BackupRollout(lambda x, a: x + a, lambda _: [1.0]).action(np.zeros(1)).tolist() == [1.0]
    path = BackupRollout(lambda x, a: np.maximum(x - 1.0, 0.0), [0.0]).path(np.array([2.0]), 50)
    assert [float(x[0]) for x in path] == [2.0, 1.0, 0.0, 0.0]


@pytest.mark.parametrize("backup", [1.0, [[1.0]], [1.0, np.inf], [np.nan]], ids=str)
def test_a_backup_that_is_one_action_is_a_vector_of_finite_numbers(backup: Any) -> None:
    with pytest.raises(InputError, match=r"^backup: got .*, wanted \(actions,\) finite numbers"):
        BackupRollout(halved, backup)
    with pytest.raises(InputError, match=r"^latent: got .*, wanted \(actions,\) finite numbers"):
        BackupRollout(halved, [1.0], latent=backup)


def test_the_backup_of_a_rollout_is_the_one_along_which_it_looks() -> None:
    def half(x: Any) -> Any:
        return [0.5 * x[0]]

    barrier = RolloutBarrier(lambda x, a: x - a, half, lambda x: x[0], 2)
    assert barrier.backup(np.array([3.0])).tolist() == [1.5]
    held = RolloutBarrier(lambda x, a: x - a, [0.25], lambda x: x[0], 2)
    assert held.backup(np.array([3.0])).tolist() == [0.25]


class Own(AbstractDynamics):
    """A model of one's own: a car that stays where it is."""

    def __init__(self, memory: Any) -> None:
        self.system, self.period, self.latent_names = load_model("car").system, 0.05, ()
        self._memory = memory

    def initial_memory(self, action: Any, latent: Any = None) -> Any:
        return self._memory

    def advance(self, state: Any, action: Any, memory: Any, latent: Any = None, **_: Any) -> tuple[Any, Any]:
        return state, memory

    def affine(self, state: Any, latent: Any = None, *_: Any, **__: Any) -> tuple[Any, Any]:
        return state, np.zeros((4, 2))


@pytest.mark.parametrize("memory", [None, (), (None,), ((), None), (np.empty(0), [])], ids=str)
def test_a_users_model_may_say_in_any_way_that_nothing_is_remembered(memory: Any) -> None:
    assert prediction_of(Own(memory)).system is not None


@pytest.mark.parametrize("memory", [(0.0,), (None, (1.0,)), (np.zeros(1),), ({"steer": 0.1},)], ids=str)
def test_a_users_model_whose_actuators_remember_is_refused(memory: Any) -> None:
    with pytest.raises(InputError, match=r"^model: got one of 'car' with actuator memory"):
        prediction_of(Own(memory))


UNIT = FilterSettings(action_low=(-1.0, -1.0), action_high=(1.0, 1.0), epsilon=0.0)


def made(backup: Any) -> SafetyFilter:
    return SafetyFilter(lambda x: (x, np.eye(2)), [FunctionBarrier(lambda x: 5.0 - x[0])], UNIT, backup=backup)


@pytest.mark.parametrize(
    "backup",
    [np.array([0.5, -0.5]), [0.5, -0.5], (0.5, -0.5), 0.5, "brake", object(), {}],
    ids=lambda one: repr(one)[:9],
)
def test_what_cannot_be_called_is_no_backup(backup: Any) -> None:
    """Its action looks like one; no one would ask it, and the robot would rest where it was to be steered away."""
    assert not callable(backup)
    with pytest.raises(
        InputError, match=f"backup: got {type(backup).__name__}, wanted a function of the state or None"
    ):
        made(backup)


@pytest.mark.parametrize(("backup", "wanted"), [(lambda state: [0.5, -0.5], [0.5, -0.5]), (None, [0.0, 0.0])])
def test_a_backup_that_was_taken_is_what_acts_where_no_state_is_known(backup: Any, wanted: list[float]) -> None:
    assert made(backup).decide(None, None).action.tolist() == wanted
