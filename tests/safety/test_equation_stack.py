"""Barriers that are equations: recorded, in one go, for many at once, beside the equation run on plain numbers."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.safety.dual_numbers import DUALS, Dual, dual

from safedpa.equations import Given, NotStraightError
from safedpa.errors import InputError
from safedpa.operations import FLOATS, Operations
from safedpa.robots.car import written_barriers
from safedpa.robots.car.barriers import ObstacleBarrier, braking_of, car_barriers
from safedpa.robots.car.towed_reach import TowedReach
from safedpa.robots.car.write_barriers import text
from safedpa.safety import FilterSettings, FunctionBarrier
from safedpa.safety.barrier import AbstractBarrier, Barriers
from safedpa.safety.braking import Braking
from safedpa.safety.equation_barrier import AbstractEquationBarrier
from safedpa.safety.many_barriers import ManyEquations, OneByOne, many_barriers
from safedpa.safety.stacks import EquationStack, Stacks, stacked

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
            found += part.h(Given(state, part.shared, item, part.form), operations)
    return found


def slopes_by_hand(parts: Sequence[Any], state: Sequence[float]) -> np.ndarray:
    """By numbers that carry a slope."""
    columns = []
    for index in range(len(state)):
        nudged = [Dual(value, float(index == entry)) for entry, value in enumerate(state)]
        columns.append([dual(h).slope for h in by_hand(parts, nudged, DUALS)])
    return np.array(columns).T


def scene_of(
    scene: list[tuple[float, float, float]], walls: bool, way: float | None, pose: Sequence[float]
) -> list[Any]:
    towed = None if way is None else TowedReach(0.1, 0.5, 0.2, way, (pose[0] + 0.03, pose[1] - 0.02, pose[2] + 0.05))
    return car_barriers(FilterSettings(), FOOTPRINT, scene, FIELD if walls else None, towed)


@settings(max_examples=200, deadline=None)
@given(scene=obstacles, state=states, walls=st.booleans(), on_it=st.booleans(), way=loads)
def test_values_and_slopes_are_those_of_the_equation_itself(
    scene: list[tuple[float, float, float]], state: tuple[float, ...], walls: bool, on_it: bool, way: float | None
) -> None:
    if on_it:  # an obstacle's centre on the body itself, where there is no direction
        scene = [*scene, (*state[:2], 0.3)]
    parts = scene_of(scene, walls, way, state)
    stack = stacked(parts)
    assert isinstance(stack, EquationStack)
    assert stack.heights(state) == pytest.approx(by_hand(parts, state, FLOATS), rel=0.0, abs=1e-14)
    gradient, rows = stack.gradient(np.array(state)), range(len(stack.names))
    np.testing.assert_allclose(gradient, slopes_by_hand(parts, state), rtol=0.0, atol=1e-12)
    assert stack.heights(state) == stack.values(np.array(state)).tolist()
    np.testing.assert_array_equal(stack.slopes(state, rows[::-1]), gradient[::-1])
    np.testing.assert_allclose(stack.one_by_one.gradient(np.array(state)), gradient, rtol=0.0, atol=1e-14)
    steepest = stack.steepest(state)
    assert steepest is not None
    assert (abs(gradient) <= np.array(steepest) + 1e-12).all()


@settings(max_examples=50, deadline=None)
@given(scene=obstacles, drive=st.lists(states, min_size=1, max_size=4), walls=st.booleans(), way=loads)
def test_many_robots_at_once_have_what_each_has_alone(
    scene: list[tuple[float, float, float]], drive: list[tuple[float, ...]], walls: bool, way: float | None
) -> None:
    parts = [scene_of(scene, walls, way, state) for state in drive]
    many, reference = many_barriers(parts, 4), OneByOne(parts)
    assert isinstance(many, ManyEquations)
    assert many.kinds == reference.kinds
    state, widths = np.array(drive), np.array([2.0, 1.0])
    g = np.random.default_rng(0).normal(size=(len(drive), 4, 2))
    np.testing.assert_allclose(many.values(state), reference.values(state), rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(many.along(state, g, widths), reference.along(state, g, widths), rtol=0.0, atol=1e-11)
    last = np.array([len(drive) - 1])
    np.testing.assert_array_equal(many.only(last).values(state[last]), many.values(state)[last])
    assert many.only(last).one(0) == parts[-1]


def test_a_longer_state_has_no_slope_over_what_is_not_read() -> None:
    parts = car_barriers(FilterSettings(), FOOTPRINT, [(1.0, 1.0, 0.2)], FIELD)
    state, stack = [0.1, 0.2, 0.3, 0.4], stacked(parts)
    assert stack.heights([*state, 9.0]) == stack.heights(state)
    np.testing.assert_array_equal(stack.gradient(np.array([*state, 9.0]))[:, :4], stack.gradient(np.array(state)))
    assert not stack.gradient(np.array([*state, 9.0]))[:, 4].any()


@pytest.mark.parametrize("which", [slice(0, 1), slice(None, None, -1), slice(1, 3)])
def test_any_equations_in_any_order_make_a_stack(which: slice) -> None:
    parts = car_barriers(FilterSettings(), FOOTPRINT, [(1.0, 1.0, 0.2), (2.0, 0.3, 0.1)], FIELD)[which]
    state = (0.1, 0.2, 0.3, 0.4)
    assert isinstance(stacked(parts), EquationStack)
    assert stacked(parts).heights(state) == pytest.approx(by_hand(parts, state, FLOATS), abs=1e-15)


def test_together_with_a_users_function_all_barriers_are_asked_one_by_one() -> None:
    parts = car_barriers(FilterSettings(), FOOTPRINT, [(1.0, 1.0, 0.2)], FIELD)
    assert isinstance(stacked([*parts, FunctionBarrier(lambda x: 1.0)]), Barriers)
    assert isinstance(stacked([]), Barriers)
    assert isinstance(many_barriers([[FunctionBarrier(lambda x: 1.0)]], 4), OneByOne)


def test_bodies_that_differ_keep_their_own_numbers() -> None:
    _, field, speed = car_barriers(FilterSettings(), FOOTPRINT, [(1.0, 1.0, 0.2)], FIELD)
    state = (0.1, 0.2, 0.3, 0.9)
    for body, braking in (((0.08, 0.5, 0.12), braking_of(FilterSettings())), (FOOTPRINT, Braking(1.0, 2.5))):
        other = ObstacleBarrier([(1.0, 1.0, 0.2)], body, braking)
        parts = [other, field, speed]
        assert stacked(parts).heights(state) == pytest.approx(by_hand(parts, state, FLOATS), abs=1e-15)


def test_the_last_stack_is_kept_for_the_same_objects_and_for_no_others() -> None:
    stacks, settings = Stacks(), FilterSettings()
    parts: list[AbstractBarrier] = car_barriers(settings, FOOTPRINT, [(1.0, 1.0, 0.2)], FIELD)
    first = stacks.of(parts, 4)
    assert stacks.of(tuple(parts), 4) is first
    assert stacks.of(first, 4) is first
    parts[0] = ObstacleBarrier([(0.5, 0.0, 0.2)], FOOTPRINT, braking_of(settings), settings.barrier("clearance"))
    assert stacks.of(parts, 4) is not first
    assert stacks.of(parts, 4).parts == tuple(parts)
    assert stacks.of(parts[:2], 4).parts == tuple(parts[:2])
    assert stacks.of((), 4).names == ()


def test_a_stack_travels_to_another_process() -> None:
    stack = stacked(car_barriers(FilterSettings(), FOOTPRINT, [(1.0, 1.0, 0.2)]))
    state = (0.1, 0.2, 0.3, 0.4)
    expected = stack.heights(state)
    assert pickle.loads(pickle.dumps(stack)).heights(state) == expected


def test_what_was_written_ahead_of_time_is_what_recording_gives_today() -> None:
    source = Path(written_barriers.__file__).with_name("written_barriers.py")
    assert source.read_text(encoding="utf-8") == text(), "run python -m safedpa.robots.car.write_barriers"


@pytest.mark.parametrize("way", [None, 0.3])
@pytest.mark.parametrize("walls", [False, True])
def test_no_service_records_the_cars_barriers(walls: bool, way: float | None) -> None:
    plain = stacked(scene_of([(1.0, 1.0, 0.2)], walls, way, (0.0, 0.0, 0.0))).plain(4)
    assert type(plain).__module__ == written_barriers.__name__


class Branching(AbstractEquationBarrier):
    """An equation that asks for a number while it is recorded."""

    kind, names, numbers, each = "branching", ("h",), 0, ((),)

    @staticmethod
    def h(given: Given, operations: Operations) -> Sequence[Any]:
        return (given.state[0] if given.state[0] > 0.0 else 0.0,)


def test_an_equation_that_branches_on_a_number_cannot_be_recorded() -> None:
    with pytest.raises(NotStraightError, match="branch"):
        Branching().values(np.zeros(2))


def test_a_barrier_travels_without_the_functions_that_were_made_of_it() -> None:
    parts = car_barriers(FilterSettings(), FOOTPRINT, [(1.0, 0.5, 0.3)], FIELD)
    here = np.array([0.3, -0.2, 0.4, 1.1])
    for part in parts:
        before = part.values(here)
        other = pickle.loads(pickle.dumps(part))
        assert other.values(here).tobytes() == before.tobytes()
        assert (other.names, other.kind, other.reads) == (part.names, part.kind, part.reads)


def test_the_same_parts_are_refused_again_for_a_state_of_another_size() -> None:
    parts, stacks = car_barriers(FilterSettings(), FOOTPRINT, [(1.0, 0.5, 0.3)], FIELD), Stacks()
    for scene in (parts, stacks.of(parts, 4)):
        assert stacks.of(scene, 4).names
        with pytest.raises(InputError, match="got a state of 5 entries"):
            stacks.of(scene, 5)
