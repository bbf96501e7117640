"""Barriers that are equations, next to the equation run on plain numbers, and the slope of every operation."""

import pickle
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.safety.dual_numbers import DUALS, Dual, dual

from safedpa.equations import Given, NotRecordableError
from safedpa.equations.batch_rows import BatchRows
from safedpa.equations.rows import RowGroup, RowTape
from safedpa.equations.scalar_rows import scalar_rows
from safedpa.errors import InputError
from safedpa.operations import FLOATS, Operations
from safedpa.robots.car.barriers.body import TrailerEnvelope
from safedpa.robots.car.barriers.obstacles import ObstacleBarrier, braking_of, car_barriers
from safedpa.safety import FilterSettings, FunctionBarrier
from safedpa.safety.barriers.base import AbstractBarrier, Barriers
from safedpa.safety.barriers.equation import AbstractEquationBarrier
from safedpa.safety.barriers.stack import BarrierSetCache, CompiledBarrierSet, make_barrier_set
from safedpa.safety.barriers.stopping import Braking
from safedpa.safety.batch.barriers import CompiledBatchBarriers, SequentialBarriers, batch_barriers

FOOTPRINT = (0.08, 0.40, 0.12)
FIELD = (-4.0, 4.0, -4.0, 4.0)
numbers = st.floats(-6.0, 6.0)
states = st.tuples(
    numbers, numbers, st.floats(-7.0, 7.0), st.one_of(st.floats(-3.0, 3.0), st.sampled_from((0.0, -0.0)))
)
obstacles = st.lists(st.tuples(numbers, numbers, st.floats(0.0, 1.0)), max_size=12)
loads = st.none() | st.floats(0.0, 0.7)


def by_hand(parts: Sequence[Any], state: Sequence[Any], operations: Operations) -> list[Any]:
    """The equations as they stand, item by item."""
    found: list[Any] = []
    for part in parts:
        for item in part.each:
            found += part.equation(Given(state, part.shared, item, part.form), operations)
    return found


def slopes_by_hand(parts: Sequence[Any], state: Sequence[float]) -> np.ndarray:
    """By numbers that carry a slope."""
    columns = []
    for index in range(len(state)):
        nudged = [Dual(value, float(index == entry)) for entry, value in enumerate(state)]
        columns.append([dual(h).slope for h in by_hand(parts, nudged, DUALS)])
    return np.array(columns).T


def scene_of(scene: list[tuple[float, float, float]], walls: bool, way: float | None, pose: Sequence[float]):
    towed = (
        None if way is None else TrailerEnvelope(0.1, 0.5, 0.2, way, (pose[0] + 0.03, pose[1] - 0.02, pose[2] + 0.05))
    )
    return car_barriers(FilterSettings.for_robot("car"), FOOTPRINT, scene, FIELD if walls else None, towed)


@settings(max_examples=200, deadline=None)
@given(scene=obstacles, state=states, walls=st.booleans(), on_it=st.booleans(), way=loads)
def test_values_and_slopes_are_those_of_the_equation_itself(scene, state, walls, on_it, way):
    if on_it:  # an obstacle's centre on the body itself, where there is no direction
        scene = [*scene, (*state[:2], 0.3)]
    parts = scene_of(scene, walls, way, state)
    stack = make_barrier_set(parts)
    assert isinstance(stack, CompiledBarrierSet)
    assert stack.h_floats(state) == pytest.approx(by_hand(parts, state, FLOATS), rel=0.0, abs=1e-14)
    gradient, rows = stack.grad_h(np.array(state)), range(len(stack.names))
    np.testing.assert_allclose(gradient, slopes_by_hand(parts, state), rtol=0.0, atol=1e-12)
    assert stack.h_floats(state) == stack.h(np.array(state)).tolist()
    np.testing.assert_array_equal(stack.grad_h_floats(state, rows[::-1]), gradient[::-1])
    np.testing.assert_allclose(stack.sequential.grad_h(np.array(state)), gradient, rtol=0.0, atol=1e-14)
    grad_bound = stack.grad_bound(state)
    assert grad_bound is not None
    assert (abs(gradient) <= np.array(grad_bound) + 1e-12).all()


@settings(max_examples=50, deadline=None)
@given(scene=obstacles, drive=st.lists(states, min_size=1, max_size=4), walls=st.booleans(), way=loads)
def test_many_robots_at_once_have_what_each_has_alone(scene, drive, walls, way):
    parts = [scene_of(scene, walls, way, state) for state in drive]
    many, reference = batch_barriers(parts, 4), SequentialBarriers(parts)
    assert isinstance(many, CompiledBatchBarriers)
    assert many.kinds == reference.kinds
    state, widths = np.array(drive), np.array([2.0, 1.0])
    g = np.random.default_rng(0).normal(size=(len(drive), 4, 2))
    np.testing.assert_allclose(many.h(state), reference.h(state), rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(
        many.lie_derivative(state, g, widths), reference.lie_derivative(state, g, widths), rtol=0.0, atol=1e-11
    )
    last = np.array([len(drive) - 1])
    np.testing.assert_array_equal(many.only(last).h(state[last]), many.h(state)[last])
    assert many.only(last).one(0) == parts[-1]


def test_a_longer_state_has_no_slope_over_what_is_not_read() -> None:
    parts = car_barriers(FilterSettings.for_robot("car"), FOOTPRINT, [(1.0, 1.0, 0.2)], FIELD)
    state, stack = [0.1, 0.2, 0.3, 0.4], make_barrier_set(parts)
    assert stack.h_floats([*state, 9.0]) == stack.h_floats(state)
    np.testing.assert_array_equal(stack.grad_h(np.array([*state, 9.0]))[:, :4], stack.grad_h(np.array(state)))
    assert not stack.grad_h(np.array([*state, 9.0]))[:, 4].any()


@pytest.mark.parametrize("which", [slice(0, 1), slice(None, None, -1), slice(1, 3)])
def test_any_equations_in_any_order_make_a_stack(which: slice) -> None:
    parts = car_barriers(FilterSettings.for_robot("car"), FOOTPRINT, [(1.0, 1.0, 0.2), (2.0, 0.3, 0.1)], FIELD)[which]
    state = (0.1, 0.2, 0.3, 0.4)
    assert isinstance(make_barrier_set(parts), CompiledBarrierSet)
    assert make_barrier_set(parts).h_floats(state) == pytest.approx(by_hand(parts, state, FLOATS), abs=1e-15)


def test_together_with_a_users_function_all_barriers_are_asked_one_by_one() -> None:
    parts = car_barriers(FilterSettings.for_robot("car"), FOOTPRINT, [(1.0, 1.0, 0.2)], FIELD)
    assert isinstance(make_barrier_set([*parts, FunctionBarrier(lambda x: 1.0)]), Barriers)
    assert isinstance(make_barrier_set([]), Barriers)
    assert isinstance(batch_barriers([[FunctionBarrier(lambda x: 1.0)]], 4), SequentialBarriers)


def test_bodies_that_differ_keep_their_own_numbers() -> None:
    _, field, speed = car_barriers(FilterSettings.for_robot("car"), FOOTPRINT, [(1.0, 1.0, 0.2)], FIELD)
    state = (0.1, 0.2, 0.3, 0.9)
    for body, braking in (
        ((0.08, 0.5, 0.12), braking_of(FilterSettings.for_robot("car"))),
        (FOOTPRINT, Braking(1.0, 2.5)),
    ):
        other = ObstacleBarrier([(1.0, 1.0, 0.2)], body, braking)
        parts = [other, field, speed]
        assert make_barrier_set(parts).h_floats(state) == pytest.approx(by_hand(parts, state, FLOATS), abs=1e-15)


def test_the_last_stack_is_kept_for_the_same_objects_and_for_no_others() -> None:
    stacks, settings = BarrierSetCache(), FilterSettings.for_robot("car")
    parts: list[AbstractBarrier] = car_barriers(settings, FOOTPRINT, [(1.0, 1.0, 0.2)], FIELD)
    first = stacks.get(parts, 4)
    assert stacks.get(tuple(parts), 4) is first
    assert stacks.get(first, 4) is first
    parts[0] = ObstacleBarrier([(0.5, 0.0, 0.2)], FOOTPRINT, braking_of(settings), settings.barrier("clearance"))
    assert stacks.get(parts, 4) is not first
    assert stacks.get(parts, 4).parts == tuple(parts)
    assert stacks.get(parts[:2], 4).parts == tuple(parts[:2])
    assert stacks.get((), 4).names == ()


def test_a_stack_and_a_barrier_travel_to_another_process_without_the_functions_made_of_them() -> None:
    stack = make_barrier_set(car_barriers(FilterSettings.for_robot("car"), FOOTPRINT, [(1.0, 1.0, 0.2)]))
    state = (0.1, 0.2, 0.3, 0.4)
    expected = stack.h_floats(state)
    assert pickle.loads(pickle.dumps(stack)).h_floats(state) == expected
    parts = car_barriers(FilterSettings.for_robot("car"), FOOTPRINT, [(1.0, 0.5, 0.3)], FIELD)
    here = np.array([0.3, -0.2, 0.4, 1.1])
    for part in parts:
        before = part.h(here)
        other = pickle.loads(pickle.dumps(part))
        assert other.h(here).tobytes() == before.tobytes()
        assert (other.names, other.kind, other.reads) == (part.names, part.kind, part.reads)


def test_an_equation_that_branches_on_a_number_is_rejected() -> None:
    with pytest.raises(NotRecordableError, match="branch"):
        Branching().h(np.zeros(2))


class Branching(AbstractEquationBarrier):
    """An equation that asks for a number while it is recorded."""

    kind, names, numbers, each = "branching", ("h",), 0, ((),)

    @staticmethod
    def equation(given: Given, operations: Operations) -> Sequence[Any]:
        return (given.state[0] if given.state[0] > 0.0 else 0.0,)


def test_the_same_parts_are_refused_again_for_a_state_of_another_size() -> None:
    parts, stacks = (
        car_barriers(FilterSettings.for_robot("car"), FOOTPRINT, [(1.0, 0.5, 0.3)], FIELD),
        BarrierSetCache(),
    )
    for scene in (parts, stacks.get(parts, 4)):
        assert stacks.get(scene, 4).names
        with pytest.raises(InputError, match="got a state of 5 entries"):
            stacks.get(scene, 5)


POINTS = [(0.3, -0.7), (-0.4, 0.9), (1.2, 1.2), (0.0, 0.5), (0.5, 0.0), (-1.0, 1.0), (0.0, 0.0), (2.0, -3.0)]
FORMS: dict[str, Callable[[Any, Any, Any, Operations], Any]] = {
    "sum": lambda x, y, e, o: x + y + e,
    "difference": lambda x, y, e, o: e - x - y,
    "product": lambda x, y, e, o: x * y * e,
    "quotient": lambda x, y, e, o: (x + e) / (y * y + 1.0),
    "under a constant": lambda x, y, e, o: 2.0 / (x * x + e * e) - y,
    "square": lambda x, y, e, o: x**2 * e + (+y) ** 2.0,
    "sign of both": lambda x, y, e, o: -x * e - (-y),
    "sin": lambda x, y, e, o: o.sin(x * e + y),
    "cos": lambda x, y, e, o: o.cos(x * e) * o.sin(x * e) + y,
    "tan": lambda x, y, e, o: o.tan(0.3 * x) * e + o.tan(0.1 * y),
    "atan": lambda x, y, e, o: o.atan(x * y + e),
    "tanh": lambda x, y, e, o: o.tanh(x - e * y),
    "exp": lambda x, y, e, o: o.exp(0.5 * x + e * y),
    "sqrt": lambda x, y, e, o: o.sqrt(x * x + y * y + e * e),
    "absolute": lambda x, y, e, o: o.absolute(x - e) + o.absolute(y + 0.1),
    "sign": lambda x, y, e, o: o.sign(x + 0.01) * y + e,
    "minimum": lambda x, y, e, o: o.minimum(x, y) * e + o.minimum(e, x),
    "maximum": lambda x, y, e, o: o.maximum(x, y) * e + o.maximum(y, e),
    "clip": lambda x, y, e, o: o.clip(x, y - 3.0, e) + o.clip(e, x, 5.0),
    "where": lambda x, y, e, o: o.where(x < y, x * e, o.where(y >= 0.5, y, -y)) + o.where(x != y, y, x),
    "hypot": lambda x, y, e, o: o.hypot(x, y) + o.hypot(x - e, 2.0 * y),
    "of the state alone": lambda x, y, e, o: o.sin(x) * y,
    "of neither": lambda x, y, e, o: e + 0.0 * e,
}
EACH = (0.5, 1.5)


def recorded(form: Callable[[Any, Any, Any, Operations], Any]) -> RowTape:
    def equation(given: Given, operations: Operations) -> Sequence[Any]:
        x, y = given.state
        return form(x, y, given.each[0], operations), form(y, x, given.shared[0] * given.each[0], operations)

    return RowTape(2, [RowGroup(equation, 1, 1)])


def by_dual_numbers(form: Callable[..., Any], point: Sequence[float], shared: float) -> tuple[Any, Any]:
    h, slopes = [], []
    for each in EACH:
        for turned, number in ((False, each), (True, shared * each)):
            found = []
            for nudged in range(2):
                x, y = (Dual(value, float(index == nudged)) for index, value in enumerate(point))
                found.append(dual(form(y, x, number, DUALS) if turned else form(x, y, number, DUALS)))
            h.append(found[0].value)
            slopes.append([entry.slope for entry in found])
    return np.array(h), np.array(slopes)


@pytest.mark.parametrize("name", FORMS)
def test_values_and_slopes_are_those_of_dual_numbers(name: str) -> None:
    tape, shared = recorded(FORMS[name]), 0.7
    rows = scalar_rows(tape)(((shared,),), (tuple((each,) for each in EACH),))
    many, robots = BatchRows(tape), len(POINTS)
    columns = [[np.full((robots, 1), shared)]], [[np.tile(EACH, (robots, 1))]]
    values, slopes = many.h(np.array(POINTS), *columns), many.grad_h(np.array(POINTS), *columns)
    for index, point in enumerate(POINTS):
        h, expected = by_dual_numbers(FORMS[name], point, shared)
        assert rows.h_floats(point) == pytest.approx(h, abs=1e-14)
        np.testing.assert_allclose(rows.grad_h_floats(point, range(4)), expected, rtol=1e-13, atol=1e-14)
        np.testing.assert_allclose(rows.grad_h_floats(point, [3, 1]), expected[[3, 1]], rtol=1e-13, atol=1e-14)
        np.testing.assert_allclose(values[index], h, rtol=0.0, atol=1e-14)
        np.testing.assert_allclose(slopes[index], expected, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("form", [lambda x, y, e, o: x**3, lambda x, y, e, o: x**y])
def test_a_power_without_a_rule_is_refused_and_never_level(form: Callable[..., Any]) -> None:
    with pytest.raises(KeyError, match="exponent"):
        scalar_rows(recorded(form))


def test_pythons_own_absolute_value_has_a_slope_as_well() -> None:
    rows = scalar_rows(recorded(lambda x, y, e, o: abs(x)))(((1.0,),), (((1.0,),),))
    assert rows.grad_h_floats((-2.0, 3.0), range(2)) == [(-1.0, 0.0), (0.0, 1.0)]
    assert rows.grad_h_floats((0.0, 0.0), range(2)) == [(0.0, 0.0), (0.0, 0.0)]


def test_groups_with_the_same_body_share_what_they_compute() -> None:
    def reach(given: Given, operations: Operations) -> Sequence[Any]:
        return (operations.sin(given.state[0]) * given.shared[0] - given.each[0],)

    alone = RowTape(1, [RowGroup(reach, 1, 1)])
    both = RowTape(1, [RowGroup(reach, 1, 1), RowGroup(reach, 1, 1, body=0)])
    apart = RowTape(1, [RowGroup(reach, 1, 1), RowGroup(reach, 1, 1)])
    assert len(both.of("state", [name for names in both.results for name in names])) == 2
    assert len(apart.of("state", [name for names in apart.results for name in names])) == 3
    assert alone.grad_bound is None
    rows = scalar_rows(both)(((2.0,), ()), (((1.0,),), ((3.0,), (4.0,))))
    assert rows.h_floats([0.0]) == [-1.0, -3.0, -4.0]
    assert rows.grad_bound([0.0]) is None
