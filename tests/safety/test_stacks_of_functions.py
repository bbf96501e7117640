"""Barriers side by side and motions are those alone: margins of each kind, recorded equations."""

from __future__ import annotations

from functools import cache
from math import isfinite
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from safedpa.dynamics import LearnedBase, PhysicsModel, Setting, load_model
from safedpa.effects import effect
from safedpa.equations import Given
from safedpa.errors import InputError
from safedpa.operations import FLOATS
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.safety import AbstractBarrier, Barriers, FilterSettings, FunctionBarrier, Prediction, SafetyFilter
from safedpa.safety.barriers.base import CachingBarrierSet
from safedpa.safety.barriers.limits import SpeedBarrier
from safedpa.safety.margins.active import ActiveMargins
from safedpa.safety.prediction.predictor import AffineMotion
from safedpa.safety.solver.sqp import DecisionError

Values = NDArray[np.float64]
AT, G, WIDTHS = [0.3, -0.2, 0.9], [[0.5, 0.0], [0.1, -2.0], [1.0, 0.3]], [4.0, 0.25]


def bowl(kind: str, count: int, shift: float = 0.0) -> FunctionBarrier:
    """h_i = i - |x - shift|^2."""
    names = tuple(f"{kind} {row}" for row in range(count))
    return FunctionBarrier(
        lambda x: np.arange(count) - ((x - shift) ** 2).sum(),
        lambda x: np.tile(-2.0 * (x - shift), (count, 1)),
        names,
        kind,
    )


class Moving(AbstractBarrier):
    """Looks from where a tick began."""

    kind, names = "moving", ("moving",)

    def __init__(self, origin: float = 0.0) -> None:
        self.origin = origin

    def h(self, state: Values) -> Values:
        return np.array([self.origin + state.sum()])

    def h_and_grad(self, state: Values) -> tuple[Values, Values]:
        return self.h(state), np.ones((1, len(state)))

    def starting_at(self, state: Values) -> Moving:
        return Moving(float(state[0]))


PARTS: dict[str, list[AbstractBarrier]] = {
    "one": [bowl("a", 2)],
    "three": [bowl("a", 2), bowl("b", 1, 0.5), bowl("a", 3, -0.1)],
    "of its own slopes": [Moving(), FunctionBarrier(lambda x: [x[0] ** 2, x[1]], names=("p", "q"))],
}


@pytest.mark.parametrize("name", PARTS)
def test_a_stack_is_its_parts(name: str) -> None:
    parts, x, g = PARTS[name], np.array(AT), np.array(G)
    stack, evaluated = Barriers(parts), [part.h_and_grad(x) for part in parts]
    h, gradient = (np.concatenate([pair[index] for pair in evaluated]) for index in (0, 1))
    rows = range(len(h))
    assert stack.names == tuple(name for part in parts for name in part.names)
    assert stack.kinds == tuple(part.kind for part in parts for _ in part.names)
    assert stack.rows == {kind: tuple(row for row in rows if stack.kinds[row] == kind) for kind in stack.kinds}
    assert stack.per_row({"a": 0.5}, 0.1) == [0.5 if kind == "a" else 0.1 for kind in stack.kinds]
    for whole in (stack, CachingBarrierSet(stack)):
        np.testing.assert_array_equal(whole.h(x), h)
        np.testing.assert_allclose(whole.grad_h(x), gradient, atol=1e-9)
        np.testing.assert_allclose(whole.lie_derivative_floats(AT, G, WIDTHS, rows), gradient @ g, atol=1e-6)
        np.testing.assert_allclose(
            whole.lie_derivative_floats(AT, G, WIDTHS, [len(h) - 1]), (gradient @ g)[-1:], atol=1e-6
        )
        assert whole.h_floats(AT) == h.tolist()
        assert whole.scalar_rows(3).h_floats(AT) == h.tolist()
        assert whole.scalar_rows(3) is whole.scalar_rows(3)
    for part, (_, slopes) in zip(parts, evaluated, strict=True):
        np.testing.assert_allclose(part.lie_derivative(x, g), slopes @ g, atol=1e-6)


def test_a_range_over_which_a_slope_is_measured_is_the_actions_whole_one() -> None:
    """A function without a gradient is differenced over a thousandth of what all of the action's range moves."""
    seen: list[float] = []

    def h(x: Values) -> float:
        seen.append(float(x[0]))
        return float(x[0])

    Barriers([FunctionBarrier(h)]).lie_derivative_floats([1.0], [[2.0]], [5.0], [0])
    assert max(seen) - min(seen) == pytest.approx(2.0 * 1e-3 * 2.0 * 5.0)


def test_a_stack_looks_from_where_the_tick_began_if_any_part_does() -> None:
    fixed = Barriers([bowl("a", 2), bowl("b", 1)])
    assert fixed.starting_at([3.0, 0.0, 0.0]) is fixed
    mixed = Barriers([bowl("a", 1), Moving(), bowl("b", 1)])
    for whole in (mixed, CachingBarrierSet(mixed)):
        moved = whole.starting_at([3.0, 0.0, 0.0])
        assert moved is not whole
        np.testing.assert_allclose(moved.h(np.ones(3)) - whole.h(np.ones(3)), [0.0, 3.0, 0.0])
    remembering = CachingBarrierSet(fixed)
    assert remembering.starting_at([3.0, 0.0, 0.0]) is remembering


def test_no_part_writes_into_what_the_next_one_sees_and_a_wrong_shape_is_named() -> None:
    class Writing(Moving):
        def h(self, state: Values) -> Values:
            state[0] = 7.0
            return state[:1]

    with pytest.raises(ValueError, match="read-only"):
        Barriers([Writing()]).h_floats(AT)
    with pytest.raises(InputError, match=r"h: got shape \(3,\), wanted \(1,\)"):
        Barriers([type("Wide", (Moving,), {"h": lambda self, state: state})()]).h_floats(AT)


@pytest.mark.parametrize("index", [None, 0, 2])
def test_a_speed_s_slope_is_one_over_its_own_entry(index: int | None) -> None:
    part, entry = SpeedBarrier(-1.0, 2.0, index), 3 if index is None else index
    assert part.reads == (("x", "y", "yaw", "speed") if index is None else ())
    state = [0.1, 0.2, 0.3, 0.4, 0.5]
    reported = part.grad_bound(Given(state, part.shared, part.each[0], part.form), FLOATS)
    assert list(reported) == [float(at == entry) for at in range(5)]
    np.testing.assert_array_equal(np.abs(part.h_and_grad(np.array(state[:4]))[1]), [reported[:4]] * 2)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ([("a", 0.1)], "is no table by kind of barrier, but list"),
        (None, "is no table by kind of barrier, but NoneType"),
        ({"a": True}, "is not a finite number"),
        ({"a": "0.1"}, "is not a finite number"),
        ({"a": None}, "is not a finite number"),
        ({"aa": 0.1}, "for 'aa', a kind without barriers: did you mean 'a'"),
        ({3: 0.1}, "for '3', a kind without barriers: known: a, b"),
    ],
)
def test_margins_that_are_none_are_refused_with_the_reason(asked: Any, message: str) -> None:
    with pytest.raises(DecisionError, match=message):
        ActiveMargins({"a": 0.02}).resolve(Barriers([bowl("a", 1), bowl("b", 1)]), asked)


def test_without_a_margin_there_is_none_and_without_a_gradient_differences_are_taken_over_little() -> None:
    stack = Barriers([bowl("a", 1), bowl("b", 1)])
    assert ActiveMargins({"a": 0.02}).resolve(stack, {}) == ([0.02, 0.0], 0.02)
    assert ActiveMargins({"a": 0.02, "default": 0.01}).resolve(stack, {}) == ([0.02, 0.01], 0.02)
    for asked in ({"b": 2}, MappingProxyType({"b": 2})):
        assert ActiveMargins({}).resolve(stack, asked) == ([0.0, 2.0], 2.0)
    part, at = FunctionBarrier(lambda x: x[0] ** 3 + x[1] * x[2]), np.array([0.5, 2.0, -1.0])
    slopes = np.array([0.75, -1.0, 2.0])
    np.testing.assert_allclose(part.lie_derivative(at, np.eye(3)), [slopes], atol=1e-5)
    np.testing.assert_array_equal(part.lie_derivative(at, np.zeros((3, 2))), np.zeros((1, 2)))


@pytest.mark.parametrize("later", [0, 1, 2, 3, 4])
def test_a_function_cannot_write_into_what_it_is_differenced_at(later: int) -> None:
    """Neither at the state, nor above and below of each entry."""
    asked = 0

    def h(x: Values) -> float:
        nonlocal asked
        asked += 1
        if asked == later + 1:
            x[0] = 9.0
        return float(x[0])

    with pytest.raises(ValueError, match="read-only"):
        FunctionBarrier(h).h_and_grad(np.array([1.0, 2.0]))


NAMES = ("car_learned", "car_fix", "pendulum_learned", "point_learned")
GIVEN = {"car_learned": 4, "car_fix": 0, "pendulum_learned": 2, "point_learned": 2}


@cache
def recorded(name: str) -> tuple[PhysicsModel, Prediction]:
    """A model and its prediction, asked often enough for its equations to be recorded."""
    model = load_model(name)
    prediction = Prediction.of_model(model)
    state, action = (0.1,) * len(model.system.state_names), (0.1,) * len(model.system.action_names)
    for _ in range(300):
        prediction.next_state_floats(state, action, None, None)
        prediction.control_matrix_floats(state, action, None, None)
    assert model.scalar_step(model.period) is not None
    assert model.scalar_tangent() is not None
    return model, prediction


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(NAMES), st.integers(0, 2**32 - 1), st.sampled_from((0.01, 1.0, 30.0, 1e4)), st.booleans())
def test_the_same_bits_as_the_recorded_equations(name: str, seed: int, size: float, own: bool) -> None:
    model, prediction = recorded(name)
    draw = np.random.default_rng(seed)
    state = tuple((size * draw.normal(size=len(model.system.state_names))).tolist())
    latent = None if own else tuple(draw.normal(size=GIVEN[name]).tolist())
    motion = prediction.affine_motion(state, latent)
    assert motion is not None
    for _ in range(3):
        action = tuple((size * draw.normal(size=len(model.system.action_names))).tolist())
        assert motion.next_state(action) == prediction.next_state_floats(state, action, latent, None)
        assert motion.next_state(list(action)) == motion.next_state(action)
        assert motion.control_matrix() == prediction.control_matrix_floats(state, action, latent, None)


def test_only_of_models_whose_free_parameters_are_the_latent() -> None:
    learned = load_model("car_learned")
    fixed = learned.with_settings({path: Setting(0.1) for path in learned.latent_names[:1]})
    free = learned.with_settings({"base.wheelbase": Setting(0.3, free=True)})
    dragged = learned.with_effect(effect("car", "quadratic_drag"), {})
    state = (0.1, 0.2, 0.3, 0.4)
    for other in (fixed, free, dragged, load_model("car")):
        assert Prediction.of_model(other).affine_motion(state, tuple(other.latent.tolist())) is None
    assert Prediction(lambda x: (x, np.eye(4))).affine_motion(state, None) is None
    prediction = Prediction.of_model(learned)
    assert prediction.affine_motion(state, None) is not None
    assert prediction.affine_motion(state, (0.1,)) is None
    assert prediction.affine_motion((*state, 0.5), None) is None


def test_numbers_beyond_single_precision_are_no_motion_that_is_believed() -> None:
    """As before: networks that overflow predict infinity or NaN, and the filter brakes."""
    model, options = load_model("car_learned"), FilterSettings.for_robot("car")
    safe = SafetyFilter(
        Prediction.of_model(model), car_barriers(options, (0.08, 0.4, 0.12), [(2.0, 0.0, 0.3)]), options
    )
    with np.errstate(all="ignore"):
        verdict = safe.decide([0.0, 0.0, 0.0, 0.5], [0.5, 0.0], [1e39, 0.0, 0.0, 0.0])
    assert verdict.status.value == "fallback"
    assert "no finite number for any action" in verdict.reason
    assert isfinite(verdict.h_next)


def test_what_is_known_of_one_state_is_kept_for_it_alone() -> None:
    base = load_model("car_learned").base
    assert isinstance(base, LearnedBase)
    state, latent = (0.1, 0.2, 0.3, 0.4), (0.1, 0.1, 0.1, 0.1)
    first = base.known_at(state, latent)
    assert base.known_at(state, latent) is first
    assert base.known_of_one(*state, *latent) is first
    f, g = base.networks.increment_of_one(state, latent)
    assert first == [*f, *(slope for row in g for slope in row)]
    for other in (((0.1, 0.2, 0.3, 0.5), latent), (state, (0.1, 0.1, 0.1, 0.2))):
        assert base.known_at(*other) != first


@pytest.mark.parametrize("actions", [1, 3])
def test_the_formula(actions: int) -> None:
    """x + period (f + g a) / trained period, in double precision."""
    draw = np.random.default_rng(actions)
    x, f, g, a = (draw.normal(size=shape) for shape in (2, 2, (2, actions), actions))
    motion = AffineMotion(tuple(x.tolist()), [*f.tolist(), *g.ravel().tolist()], 0.1, 0.05)
    np.testing.assert_allclose(motion.next_state(a.tolist()), x + 2.0 * (f + g @ a), rtol=1e-14)
    np.testing.assert_allclose(motion.control_matrix(), 2.0 * g, rtol=1e-14)


def test_once_recorded_a_model_is_asked_by_its_recorded_equations_alone() -> None:
    model = load_model("car")
    prediction = Prediction.of_model(model)
    state, action, latent = (0.1, 0.2, 0.3, 0.4), (0.5, 0.1), (0.5, 0.5)
    for _ in range(200):
        before = (
            prediction.next_state_floats(state, action, latent, None),
            prediction.control_matrix_floats(state, action, latent, None),
        )

    def refused(*given: object, **named: object) -> object:
        raise AssertionError((given, named))

    vars(model).update(advance=refused, slopes=refused, straight=refused, scalar_tangent=refused)
    assert prediction.next_state_floats(state, action, latent, None) == pytest.approx(before[0], rel=1e-12)
    np.testing.assert_allclose(prediction.control_matrix_floats(state, action, latent, None), before[1], rtol=1e-9)
