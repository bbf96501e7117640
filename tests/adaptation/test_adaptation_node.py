"""The adaptation's step, of either estimator: deterministic, patient with gaps, deaf to what cannot be."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some
from tests.messages import stamp, state_of

from safedpa.adaptation import AdaptationNode, EstimatorSettings, HistoryEstimator, LatentEstimator
from safedpa.adaptation.batch_history_estimator import BatchHistoryEstimator
from safedpa.bus import LATENT, LatentMessage, StateMessage
from safedpa.dynamics import LearnedBase, PhysicsModel, Setting, fingerprint, load_model, parse_model
from safedpa.effects.library import effect
from safedpa.errors import InputError, MessageError
from safedpa.networks import HistoryEncoder, Weights

MODEL = parse_model(
    """
    format = 1
    robot = "car"
    [base]
    kind = "kinematic_bicycle"
    drive = "speed_servo"
    wheelbase = 0.32
    speed_gain = 4.0
    acceleration_limit = 5.0
    [[effects]]
    name = "towed_load"
    mass_ratio = { value = 0.0, free = true }
    deceleration = 2.5
    """
)


def state(tick: int, values: tuple[float, ...], applied: tuple[float, ...], **changes: Any) -> StateMessage:
    return state_of(**{**stamp(tick), "values": values, "applied": applied, "lockstep": True, **changes})


def drive(count: int, ratio: float = 0.6) -> list[StateMessage]:
    """States of a loaded car whose target speed steps up and down."""
    values, action, found = np.zeros(4), np.zeros(2), []
    for tick in range(count):
        found.append(state(tick, tuple(values.tolist()), tuple(action.tolist())))
        action = np.array([1.6 if tick // 20 % 2 == 0 else 0.4, 0.1])
        values = MODEL.step(values, action, np.array([ratio]))
    return found


def answers(node: AdaptationNode, states: list[StateMessage], robot: str = "r") -> list[LatentMessage]:
    found = []
    for message in states:
        latent = node.step(robot, message, {})[LATENT]
        assert node.afterwards(robot) == {}
        assert isinstance(latent, LatentMessage)
        found.append(dataclasses.replace(latent, publish_time=0.0))
    return found


def test_it_finds_the_load_and_stamps_the_answer() -> None:
    states = drive(150)
    found = answers(AdaptationNode(MODEL), states)
    assert found[-1].values[0] == pytest.approx(0.6, abs=0.1)
    for asked, latent in zip(states, found, strict=True):
        assert (latent.epoch, latent.tick, latent.robot_time) == (asked.epoch, asked.tick, asked.robot_time)
        assert latent.model == fingerprint(MODEL)
        assert len(latent.values) == len(latent.deviations) == len(MODEL.latent_names)


def test_robots_are_kept_apart() -> None:
    node = AdaptationNode(MODEL)
    loaded, free = drive(150, 0.8), drive(150, 0.0)
    pairs = zip(loaded, free, strict=True)
    together = [(answers(node, [one], "a")[0], answers(node, [two], "b")[0]) for one, two in pairs]
    for robot, states in enumerate((loaded, free)):
        assert [pair[robot] for pair in together] == answers(AdaptationNode(MODEL), states)


def test_an_answer_holds_what_was_learned_before_its_state() -> None:
    states = drive(60)
    straight = answers(AdaptationNode(MODEL), states)
    node = AdaptationNode(MODEL)
    answers(node, states[:40])
    odd = dataclasses.replace(states[40], values=(0.0, 0.0, 0.0, 1.0))
    assert answers(node, [odd])[0] == straight[40], "no one waits for what the newest state teaches"


def test_over_a_gap_in_the_ticks_nothing_is_learned() -> None:
    states = drive(100)
    node = AdaptationNode(MODEL)
    answers(node, states[:50])
    before, after = answers(node, states[70:72])
    assert (after.values, after.deviations) == (before.values, before.deviations)
    assert answers(node, states[72:])[-1].values[0] == pytest.approx(0.6, abs=0.15)


def test_a_state_that_cannot_be_is_answered_and_not_learned() -> None:
    states = drive(60)
    node = AdaptationNode(MODEL)
    answers(node, states[:30])
    glitches = [
        dataclasses.replace(states[30], values=(0.0, 0.0, 0.0, 500.0)),
        dataclasses.replace(states[31], values=(1e11, 0.0, 0.0, 0.0)),
    ]
    shown = [(latent.values, latent.deviations) for latent in answers(node, [*glitches, *states[32:34]])]
    assert shown == shown[:1] * 4, "neither the glitches nor the step out of them are transitions"
    assert np.isfinite(answers(node, states[34:])[-1].values).all()


def test_a_state_that_is_no_number_is_never_learned() -> None:
    """The codec refuses it on the bus; a node that is called directly takes it as a state that cannot be."""
    node = AdaptationNode(MODEL)
    states = drive(32)
    answers(node, states[:30])
    broken = state(30, (float("nan"), 0.0, 0.0, 0.0), (0.0, 0.0))
    before, after = answers(node, [broken, states[31]])
    assert (after.values, after.deviations) == (before.values, before.deviations)


@pytest.mark.parametrize(("values", "applied"), [((0.0,) * 3, (0.0,) * 2), ((0.0,) * 4, (0.0,)), ((), ())])
def test_a_state_of_the_wrong_length_is_refused(values: tuple[float, ...], applied: tuple[float, ...]) -> None:
    with pytest.raises(MessageError, match=r"wanted 4 \(x, y, yaw, speed\) and 2"):
        AdaptationNode(MODEL).step("r", state(0, values, applied), {})


def test_forgotten_means_as_at_the_start() -> None:
    node = AdaptationNode(MODEL)
    first = answers(node, drive(50))
    node.forget("r")
    node.forget("never seen")
    assert answers(node, drive(50)) == first


def test_settings_that_do_not_fit_the_model_are_refused_before_any_robot_comes() -> None:
    with pytest.raises(InputError, match="measurement_deviation"):
        AdaptationNode(MODEL, EstimatorSettings(measurement_deviation=(0.1, 0.1)))


def learned(weights: Weights) -> PhysicsModel:
    nominal = load_model("car")
    settings = {path: setting for path, setting in nominal.settings.items() if path.startswith("base.")}
    return PhysicsModel(LearnedBase(nominal.base, weights), (), settings)


def states(count: int, period: float = 0.05) -> list[StateMessage]:
    draw = np.random.default_rng(0)
    values = np.cumsum(draw.normal(scale=0.05, size=(count, 4)), axis=0)
    actions = draw.normal(scale=0.3, size=(count, 2))
    return [
        state(
            tick, tuple(values[tick].tolist()), tuple(actions[tick].tolist()), robot_time=period * tick, period=period
        )
        for tick in range(count)
    ]


def latents(node: AdaptationNode, messages: list[StateMessage]) -> list[np.ndarray]:
    found = []
    for message in messages:
        answer = node.step("r", message, {})[LATENT]
        assert isinstance(answer, LatentMessage)
        found.append(np.array(answer.values))
        node.afterwards("r")
    return found


def test_the_latent_of_a_tick_encodes_the_history_up_to_it(random_car_weights):
    weights = random_car_weights(3)
    messages, encoder = states(60), HistoryEncoder(weights)
    found = latents(AdaptationNode(learned(weights)), messages)
    np.testing.assert_array_equal(found[0], np.zeros(4))  # where nothing acts, until there is a transition
    values = np.array([message.values for message in messages])
    applied = np.array([message.applied for message in messages])
    for tick in (1, 7, 59):
        rows = encoder.rows(values[: tick + 1], applied[1 : tick + 1])
        np.testing.assert_allclose(found[tick], encoder.encode(encoder.padded(rows)), atol=1e-5)


def test_a_gap_begins_a_new_history(random_car_weights):
    weights = random_car_weights(3)
    messages, encoder = states(60), HistoryEncoder(weights)
    found = latents(AdaptationNode(learned(weights)), messages[:20] + messages[30:])
    np.testing.assert_array_equal(found[20], found[19])
    values = np.array([message.values for message in messages[30:33]])
    applied = np.array([message.applied for message in messages[31:33]])
    np.testing.assert_allclose(found[22], encoder.encode(encoder.padded(encoder.rows(values, applied))), atol=1e-5)


def test_a_robot_of_another_period_is_refused(random_car_weights):
    node = AdaptationNode(learned(random_car_weights(3)))
    first, second = states(2, period=0.1)
    node.step("r", first, {})
    with pytest.raises(MessageError, match=r"period: got 0\.1 s, the networks were trained for 0\.05 s"):
        node.step("r", second, {})


def test_effects_on_top_keep_their_values(random_car_weights):
    free = {"ax": Setting(0.8, free=True), "ay": Setting(0.0)}
    model = learned(random_car_weights(3)).with_effect(effect("car", "constant_force"), free)
    estimator = HistoryEstimator(model)
    estimator.update(np.zeros(4), np.zeros(2), np.full(4, 0.1), 0.05)
    assert estimator.latent[model.latent_names.index("constant_force.ax")] == 0.8
    assert np.abs(estimator.latent[:4]).max() > 0.0


def test_without_a_history_encoder_the_latent_is_estimated_recursively(random_car_weights):
    weights = random_car_weights(3)
    tensors = {name: tensor for name, tensor in weights.tensors.items() if not name.startswith("phi.")}
    model = learned(Weights(tensors, weights.description))
    with pytest.raises(InputError, match="no history encoder"):
        HistoryEstimator(model)
    true = np.array([0.4, -0.3, 0.2, 0.1])
    estimator, state, draw = LatentEstimator(model), np.zeros(4), np.random.default_rng(0)
    for _ in range(200):
        action = draw.uniform([-0.5, -0.3], [2.0, 0.3])
        following = model.step(state, action, true)
        estimator.update(state, action, following, 0.05)
        state = following
    action = np.array([1.0, 0.1])
    error = np.abs(model.step(state, action, estimator.latent) - model.step(state, action, true)).max()
    assert error < 0.2 * np.abs(model.step(state, action, np.zeros(4)) - model.step(state, action, true)).max()


def test_physics_has_no_history_encoder():
    with pytest.raises(InputError, match="got physics"):
        HistoryEstimator(load_model("car"))


def test_what_was_never_measured_is_known_to_half_of_its_range(random_car_weights):
    """And entries that the networks do not estimate are what the file says."""
    weights = random_car_weights(3)
    low, high = np.array([-1.0, -2.0, 0.0, -4.0]), np.array([1.0, 2.0, 3.0, 0.5])
    tensors = {**weights.tensors, "latent_low": low, "latent_high": high}
    tensors.pop("latent_deviation", None)
    free = {"ax": Setting(0.8, free=True), "ay": Setting(0.0)}
    for known, wanted in (({}, [1.0, 2.0, 1.5, 2.25]), ({"latent_deviation": 0.1 * high}, [0.1, 0.2, 0.3, 0.05])):
        model = learned(Weights({**tensors, **known}, weights.description))
        assert HistoryEstimator(model).deviations.tolist() == pytest.approx(wanted)
        loaded = model.with_effect(effect("car", "constant_force"), free)
        found = dict(zip(loaded.latent_names, HistoryEstimator(loaded).deviations.tolist(), strict=True))
        assert found.pop("constant_force.ax") == 0.0
        assert list(found.values()) == pytest.approx(wanted)


PERIOD = 0.05


@given(some.integers(0, 2**32 - 1))
@settings(max_examples=8)
def test_histories_are_those_of_each_alone(seed: int) -> None:
    """Also where one begins again in the midst of it."""
    draw, model, cars = np.random.default_rng(seed), load_model("car_learned"), 3
    assert isinstance(model.base, LearnedBase)
    together, alone = BatchHistoryEstimator(model.base.weights, cars), [HistoryEstimator(model) for _ in range(cars)]
    state = draw.normal(size=(cars, 4)) * 0.2
    together.see(state)
    for tick in range(80):
        before, state = state, state + draw.normal(size=(cars, 4)) * 0.03
        applied = draw.uniform(-0.3, 0.3, (cars, 2))
        if tick == 60:
            together.reset([1])
            alone[1].forget_transient()
        together.acted(applied)
        latents = together.see(state)
        for car in range(cars):
            if tick == 60 and car == 1:  # its state before is not known any more
                continue
            alone[car].update(before[car], applied[car], state[car], PERIOD)
            np.testing.assert_allclose(latents[car], alone[car].latent, atol=2e-6)


def test_weights_without_a_history_encoder_are_refused() -> None:
    base = load_model("car_fix").base
    assert isinstance(base, LearnedBase)
    with pytest.raises(InputError, match="phi"):
        BatchHistoryEstimator(base.weights, 2)
