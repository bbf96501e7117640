"""What the filter is told of a model: which functions are affine, what they are given, slopes by differences."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from safedpa.dynamics import PhysicsModel, Setting, load_model, parse_model
from safedpa.effects import effect
from safedpa.safety import Prediction

Values = NDArray[np.float64]
STATE, ACTION = (0.3, -0.2, 0.4, 1.1), (1.3, 0.15)
FADING = """
format = 1
robot = "car"
[base]
kind = "kinematic_bicycle"
drive = "speed_servo"
wheelbase = 0.32
speed_gain = 3.0
acceleration_limit = 6.0
[[effects]]
name = "speed_command_gain"
varies = "gain with time"
gain = 1.0
gain_per_time = 0.01
"""


def line(x: Values) -> tuple[Values, Values]:
    return x, np.eye(1)


def about(x: Values, around: Values) -> tuple[Values, Values]:
    return x, np.eye(1)


def step(x: Values, a: Values) -> Values:
    return x + a * a


@pytest.mark.parametrize(
    ("prediction", "affine"),
    [
        (Prediction(line), True),
        (Prediction(about), False),
        (Prediction(line, step), False),
        (Prediction(about, step), False),
        (Prediction.of_model(load_model("car")), False),
        (Prediction.of_model(load_model("car_learned")), True),
    ],
)
def test_what_is_known_to_be_affine(prediction: Prediction, affine: bool) -> None:
    """Affine is what is linearised once and tried at the corners alone: nothing else may count as it."""
    assert prediction.affine is affine


def test_a_learned_model_with_an_effect_is_not_known_to_be_affine() -> None:
    model = load_model("car_learned").with_effect(effect("car", "steering_gain"), {"gain": Setting(1.1)})
    assert not Prediction.of_model(model).affine


def test_a_prediction_knows_the_system_of_its_model() -> None:
    assert Prediction.of_model(load_model("car")).of_this_project
    assert not Prediction(line).of_this_project


def test_a_function_of_any_number_of_arguments_is_given_all() -> None:
    given: list[Any] = []

    def affine(x: Values, *rest: Any) -> tuple[Values, Values]:
        given.append(rest)
        return x, np.eye(1)

    def stepped(x: Values, *rest: Any) -> Values:
        given.append(rest)
        return x

    x, a, latent = np.zeros(1), np.ones(1), np.full(2, 0.5)
    Prediction(affine).next_state(x, a, latent, None)
    Prediction(line, stepped).next_state(x, a, latent, None)
    assert [len(rest) for rest in given] == [1, 2]
    assert given[0][0] is given[1][1] is latent


def differences(model: PhysicsModel, latent: tuple[float, ...], seconds: float) -> Values:
    """d(next state)/d(state, action) (4, 6) by central differences of the model itself."""
    point, columns = np.array([*STATE, *ACTION]), []
    for index in range(6):
        ends = [point + sign * 1e-6 * np.eye(6)[index] for sign in (1.0, -1.0)]
        after = [model.advance(end[:4], end[4:], (), np.array(latent), time=seconds)[0] for end in ends]
        columns.append((after[0] - after[1]) / 2e-6)
    return np.array(columns).T


@pytest.mark.parametrize("seconds", [0.0, 40.0])
@pytest.mark.parametrize("name", ["as shipped", "another load", "fading"])
def test_slopes_are_those_of_differences_at_that_latent_and_time(name: str, seconds: float) -> None:
    model = parse_model(FADING) if name == "fading" else load_model("car")
    latent = (0.6, 1.5) if name == "another load" else tuple(model.latent.tolist())
    given = latent if name == "another load" else None
    prediction, truth = Prediction.of_model(model), differences(model, latent, seconds)
    after = model.advance(np.array(STATE), np.array(ACTION), (), np.array(latent), time=seconds)[0]
    prediction.tell_time(seconds)
    sensitivity = prediction.sensitivity_of_one(STATE, ACTION, given)
    assert sensitivity is not None
    np.testing.assert_allclose(sensitivity, truth, atol=1e-7)
    np.testing.assert_allclose(prediction.slopes_of_one(STATE, ACTION, given, None), truth[:, 4:], atol=1e-7)
    for _ in range(200):  # first by the model itself, later by its recorded equations
        np.testing.assert_allclose(prediction.following(STATE, ACTION, given, None), after, atol=1e-12)


def test_of_a_function_and_of_actuators_that_remember_no_sensitivity_is_known() -> None:
    assert Prediction(line).sensitivity_of_one((0.0,), (0.0,), None) is None
    late = load_model("car").with_effect(effect("car", "drive_lag"), {"time_constant": Setting(0.1)})
    assert Prediction.of_model(late).sensitivity_of_one(STATE, ACTION, None) is None


def test_dead_time_is_the_actuators_and_functions_tell_of_none() -> None:
    late = load_model("car").with_effect(effect("car", "actuator_delay"), {"seconds": Setting(0.2)})
    assert Prediction.of_model(late).dead_time(None) == pytest.approx(0.2)
    assert Prediction(line).dead_time(None) == 0.0
    assert Prediction(line).begin((0.0,), None, ((0.0,),)) is None
