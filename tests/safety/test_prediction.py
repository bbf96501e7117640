"""How the filter uses a model: affine functions, derivatives by differences, the influence of actions on h."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from safedpa.dynamics import PhysicsModel, Setting, load_model, parse_model
from safedpa.effects import effect
from safedpa.equations.chain_rule import chain_rule
from safedpa.safety import Prediction
from safedpa.safety.barriers.function import central_differences

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


def test_a_prediction_knows_the_system_of_its_model_and_of_an_effect_not_whether_it_is_affine() -> None:
    model = load_model("car_learned").with_effect(effect("car", "steering_gain"), {"gain": Setting(1.1)})
    assert not Prediction.of_model(model).affine
    assert Prediction.of_model(load_model("car")).is_project_model
    assert not Prediction(line).is_project_model


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
    prediction.report_time(seconds)
    sensitivity = prediction.sensitivity_floats(STATE, ACTION, given)
    assert sensitivity is not None
    np.testing.assert_allclose(sensitivity, truth, atol=1e-7)
    np.testing.assert_allclose(prediction.control_matrix_floats(STATE, ACTION, given, None), truth[:, 4:], atol=1e-7)
    for _ in range(200):  # first by the model itself, later by its recorded equations
        np.testing.assert_allclose(prediction.next_state_floats(STATE, ACTION, given, None), after, atol=1e-12)


def test_of_functions_and_actuators_that_remember_neither_sensitivity_nor_dead_time_is_guessed() -> None:
    assert Prediction(line).sensitivity_floats((0.0,), (0.0,), None) is None
    late = load_model("car").with_effect(effect("car", "drive_lag"), {"time_constant": Setting(0.1)})
    assert Prediction.of_model(late).sensitivity_floats(STATE, ACTION, None) is None
    late = load_model("car").with_effect(effect("car", "actuator_delay"), {"seconds": Setting(0.2)})
    assert Prediction.of_model(late).dead_time(None) == pytest.approx(0.2)
    assert Prediction(line).dead_time(None) == 0.0
    assert Prediction(line).effect_start((0.0,), None, ((0.0,),)) is None


def curved(x: np.ndarray) -> np.ndarray:
    return np.array([np.sin(x[0]) + x[1] ** 2, np.exp(x[1]), x[0]])


def slopes_of(x: np.ndarray) -> np.ndarray:
    return np.array([[np.cos(x[0]), 2.0 * x[1]], [0.0, np.exp(x[1])], [1.0, 0.0]])


@pytest.mark.parametrize("unit", [1e-9, 1e-6, 1.0, 1e6, 1e9])
@pytest.mark.parametrize("state", [(0.7, -0.3), (0.0, 0.0), (0.7, 0.0), (1e-20, 0.3)])
@pytest.mark.parametrize("moved", [(1.0, 1.0), (0.0, 0.0), (1e-14, 0.3), (0.0, 1.0)])
def test_in_any_unit_at_any_place_whatever_moves(unit: float, state: tuple[float, ...], moved: tuple[float, ...]):
    x = np.array(state)
    found = central_differences(lambda y: curved(y / unit), unit * x, unit * np.array(moved), np.ones(3))
    np.testing.assert_allclose(found * unit, slopes_of(x), atol=2e-4 if 1e-14 in moved else 2e-6)


def test_a_place_far_from_where_it_is_counted_from() -> None:
    far = np.array([5e5, 4e6])
    found = central_differences(lambda x: curved(x - far), far + 0.25, np.array([1.0, 1.0]), np.ones(3))
    np.testing.assert_allclose(found, slopes_of(np.array([0.25, 0.25])), atol=1e-5)


def test_neither_an_extremum_nor_what_answers_only_far_off_has_a_slope() -> None:
    """A flat stretch as wide as the entry moves; a large step would believe in the hill behind it."""
    found = central_differences(
        lambda x: np.array([max(0.0, x[0] - 3.0) ** 2]), np.array([1.0]), np.array([1.5]), np.array([1.0])
    )
    np.testing.assert_array_equal(found, [[0.0]])
    found = central_differences(
        lambda x: np.array([1.0 + x[0] ** 2 + 5.0 * x[0] ** 3]), np.zeros(1), np.ones(1), np.ones(1)
    )
    np.testing.assert_allclose(found, [[0.0]], atol=1e-9)


@pytest.mark.parametrize("moved", [0.0, 1.0])
@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_a_step_so_large_that_only_curvature_answers_is_not_believed(moved: float, unit: float) -> None:
    found = central_differences(
        lambda x: np.array([1.0 + (x[0] / unit) ** 3]), np.zeros(1), np.array([unit * moved]), np.ones(1)
    )
    np.testing.assert_allclose(found * unit, [[0.0]], atol=1e-7)


def test_one_value_that_answers_is_enough_for_all() -> None:
    """What is small next to its own size does not make the step grow for the others."""
    steps = []

    def function(x: np.ndarray) -> np.ndarray:
        steps.append(abs(float(x[0])))
        return np.array([x[0], 1e9 + 0.0 * x[0]])

    found = central_differences(function, np.zeros(1), np.ones(1), np.array([1.0, 1e9]))
    np.testing.assert_allclose(found, [[1.0], [0.0]], atol=1e-9)
    assert len(steps) == 2
    assert steps[0] == pytest.approx(np.finfo(float).eps ** (1.0 / 3.0))


def test_steps_end_where_the_entry_has_moved_to() -> None:
    steps = []

    def function(x: np.ndarray) -> np.ndarray:
        steps.append(abs(float(x[0])))
        return np.array([1.0])

    central_differences(function, np.zeros(1), np.array([2.0]), np.ones(1))
    assert 0.001 < max(steps) <= 2.0
    steps.clear()
    central_differences(function, np.array([0.0, 3.0]), np.zeros(2), np.ones(1))
    assert 3e6 < max(steps) <= 3.1e9


def test_a_function_that_refuses_a_step_has_no_slope_there() -> None:
    def refusing(x: np.ndarray) -> np.ndarray:
        if x[0] != 2.0:
            raise ValueError("only here")
        return np.array([x[1]])

    for broken in (refusing, lambda x: np.array([np.nan if x[0] != 2.0 else x[1]])):
        found = central_differences(broken, np.array([2.0, 1.0]), np.ones(2), np.ones(1))
        np.testing.assert_allclose(found, [[0.0, 1.0]], atol=1e-9)


def test_one_value_that_is_no_number_makes_the_step_none() -> None:
    found = central_differences(
        lambda x: np.array([x[0], np.nan if abs(x[0] - 2.0) > 0.0 else 1.0]), np.array([2.0]), np.ones(1), np.ones(2)
    )
    np.testing.assert_array_equal(found, [[0.0], [0.0]])


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e9])
def test_how_large_a_value_is_says_what_an_answer_is(size: float) -> None:
    steps: list[float] = []

    def function(x: np.ndarray) -> np.ndarray:
        steps.append(abs(float(x[0])))
        return size * np.array([1.0 + x[0]])

    found = central_differences(function, np.zeros(1), np.zeros(1), np.array([size]))
    np.testing.assert_allclose(found, [[size]], rtol=1e-5)
    assert steps[-1] == pytest.approx(1e-9)


def test_far_from_the_origin_the_step_grows_with_the_rounding() -> None:
    steps: list[float] = []

    def function(x: np.ndarray) -> np.ndarray:
        steps.append(abs(float(x[0]) - 1e6))
        return np.array([x[0] - 1e6])

    central_differences(function, np.array([1e6]), np.ones(1), np.ones(1))
    assert steps[0] == pytest.approx(np.cbrt(np.finfo(float).eps * 1e6), rel=1e-3)


@pytest.mark.parametrize(
    ("rows", "states", "actions"), [(1, 1, 1), (3, 2, 1), (2, 4, 3), (0, 2, 2), (3, 5, 2), (3, 3, 2), (2, 4, 1)]
)
def test_it_is_the_product_of_both(rows: int, states: int, actions: int) -> None:
    random = np.random.default_rng(rows)
    slopes, g = random.normal(size=(rows, states)), random.normal(size=(states, actions))
    found = chain_rule(slopes.tolist(), g.tolist())
    np.testing.assert_allclose(np.array(found).reshape(rows, actions), slopes @ g, rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize(("states", "slopes"), [(2, 1), (2, 3), (4, 3), (4, 5)])
def test_slopes_of_other_states_are_refused(states: int, slopes: int) -> None:
    with pytest.raises(ValueError, match=f"h has slopes of {slopes} states, the model of {states}"):
        chain_rule([[1.0] * states, [1.0] * slopes], [[1.0, 2.0]] * states)


def test_rows_do_not_share_their_numbers() -> None:
    one, other = chain_rule([[1.0], [2.0]], [[3.0]])
    one[0] = 0.0
    assert other == [6.0]


def test_of_a_car_it_is_the_same_sum_in_the_same_order() -> None:
    random = np.random.default_rng(9)
    slopes, g = random.normal(size=(50, 4)).tolist(), random.normal(size=(4, 2)).tolist()
    slopes += [[-0.0, 0.0, -0.0, 0.0], [1e308, 1e308, -1e308, 1.0]]
    wanted = []
    for p in slopes:
        row = [0.0, 0.0]
        for slope, entries in zip(p, g, strict=True):
            row = [row[0] + slope * entries[0], row[1] + slope * entries[1]]
        wanted.append(row)
    assert repr(chain_rule(slopes, g)) == repr(wanted)
    assert repr(chain_rule([tuple(p) for p in slopes], g)) == repr(wanted)


def test_of_no_state_nothing_changes() -> None:
    assert chain_rule([[], []], []) == [[], []]
