"""The car's barriers in one go beside the same barriers one by one, which are the reference."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.safety import Braking, FilterSettings, FunctionBarrier, ObstacleBarrier, SpeedBarrier, car_barriers
from safedpa.safety.barrier import AbstractBarrier, Barriers
from safedpa.safety.car_stack import CarStack, Stacks, stacked

FOOTPRINT = (0.08, 0.40, 0.12)
FIELD = (-4.0, 4.0, -4.0, 4.0)
numbers = st.floats(-6.0, 6.0)
states = st.tuples(
    numbers, numbers, st.floats(-7.0, 7.0), st.one_of(st.floats(-3.0, 3.0), st.sampled_from((0.0, -0.0)))
)
obstacles = st.lists(st.tuples(numbers, numbers, st.floats(0.0, 1.0)), max_size=12)


@settings(max_examples=200, deadline=None)
@given(scene=obstacles, drive=st.lists(states, min_size=1, max_size=4), walls=st.booleans(), on_it=st.booleans())
def test_values_and_slopes_are_those_of_the_parts(
    scene: list[tuple[float, float, float]], drive: list[tuple[float, ...]], walls: bool, on_it: bool
) -> None:
    if on_it:  # an obstacle's centre on the body itself, where there is no direction
        scene = [*scene, (*drive[0][:2], 0.3)]
    stack = stacked(car_barriers(FilterSettings(), FOOTPRINT, scene, FIELD if walls else None))
    assert isinstance(stack, CarStack)
    for values in (*drive, drive[0]):
        state = np.array(values)
        h = stack.values(state)
        np.testing.assert_allclose(h, stack.one_by_one.values(state), rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(stack.gradient(state), stack.one_by_one.gradient(state), rtol=0.0, atol=1e-12)
        gradient, rows = stack.gradient(state), range(len(stack.names))
        assert stack.heights(values) == h.tolist()
        np.testing.assert_array_equal(stack.slopes(values, rows[::-1]), gradient[::-1])
        steepest = stack.steepest(values)
        assert steepest is not None
        assert (abs(gradient) <= np.array(steepest) + 1e-12).all()


def test_a_state_with_more_entries_and_other_barriers_take_the_road_of_the_parts() -> None:
    parts = car_barriers(FilterSettings(), FOOTPRINT, [(1.0, 1.0, 0.2)], FIELD)
    longer = np.array([0.1, 0.2, 0.3, 0.4, 9.0])
    np.testing.assert_array_equal(stacked(parts).values(longer), Barriers(parts).values(longer))
    np.testing.assert_array_equal(stacked(parts).gradient(longer), Barriers(parts).gradient(longer))
    assert stacked(parts).heights(longer.tolist()) == Barriers(parts).values(longer).tolist()
    assert stacked(parts).slopes(longer.tolist(), [1]) == [Barriers(parts).gradient(longer)[1].tolist()]
    assert stacked(parts).steepest(longer.tolist()) is None
    for other in (
        parts[:1],
        [*parts, FunctionBarrier(lambda x: 1.0)],
        parts[::-1],
        [*parts[:2], SpeedBarrier(0, 1, 2)],
    ):
        assert isinstance(stacked(other), Barriers)


def test_bodies_that_differ_are_no_car_stack() -> None:
    obstacle, field, speed = car_barriers(FilterSettings(), FOOTPRINT, [(1.0, 1.0, 0.2)], FIELD)
    longer = ObstacleBarrier([(1.0, 1.0, 0.2)], (0.08, 0.5, 0.12), FilterSettings().braking)
    weaker = ObstacleBarrier([(1.0, 1.0, 0.2)], FOOTPRINT, Braking(1.0, 2.5))
    for other in (longer, weaker):
        assert isinstance(stacked([other, field, speed]), Barriers)
    assert isinstance(stacked([obstacle, field, speed]), CarStack)


def test_the_last_stack_is_kept_for_the_same_objects_and_for_no_others() -> None:
    stacks, settings = Stacks(), FilterSettings()
    parts: list[AbstractBarrier] = car_barriers(settings, FOOTPRINT, [(1.0, 1.0, 0.2)], FIELD)
    first = stacks.of(parts, 4)
    assert stacks.of(tuple(parts), 4) is first
    assert stacks.of(first, 4) is first
    parts[0] = ObstacleBarrier([(0.5, 0.0, 0.2)], FOOTPRINT, settings.braking, settings.clearance)
    assert stacks.of(parts, 4) is not first
    assert stacks.of(parts, 4).parts == tuple(parts)
    assert stacks.of(parts[:2], 4).parts == tuple(parts[:2])
    assert stacks.of((), 4).names == ()


def test_arrays_of_obstacles_cannot_be_written_to() -> None:
    barrier = ObstacleBarrier(np.array([[1.0, 1.0, 0.2]]), FOOTPRINT, FilterSettings().braking)
    for array in (barrier.centres, barrier.reach):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0.0
