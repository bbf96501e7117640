"""What is remembered of barriers is what they say, for the state that is asked about and no other."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields

import numpy as np

from safedpa.dynamics import load_model
from safedpa.robots.car.barriers import car_barriers
from safedpa.safety import FilterSettings, SafetyFilter, Verdict
from safedpa.safety.barrier import Barriers, RememberingStack
from safedpa.safety.remembered import Remembered
from safedpa.safety.stacks import stacked

FOOTPRINT = (0.08, 0.40, 0.12)
PARTS = car_barriers(FilterSettings(), FOOTPRINT, [(1.0, 1.0, 0.2)], (-4.0, 4.0, -4.0, 4.0))


class Counting:
    """Barriers whose h is the state itself."""

    def __init__(self) -> None:
        self.asked: list[tuple[float, ...]] = []

    def heights(self, state: Sequence[float]) -> list[float]:
        self.asked.append(tuple(state))
        return list(state)


def test_eight_states_are_remembered_and_the_oldest_is_forgotten() -> None:
    counting = Counting()
    known = Remembered(counting)
    states = [(float(index), 0.0) for index in range(8)]
    for state in (*states, *states):
        assert known.heights(state) == list(state)
        assert known.heights(list(state)) is known.heights(state)
    assert counting.asked == states
    known.heights((8.0, 0.0))
    known.heights(states[1])
    assert len(counting.asked) == 9
    known.heights(states[0])
    assert len(counting.asked) == 10


def test_states_that_begin_alike_are_distinguished() -> None:
    counting = Counting()
    known = Remembered(counting)
    for state in ((1.0, 0.0), (1.0, 2.0), (0.0, 2.0), (3.0,), (1.0, 2.0)):
        assert known.heights(state) == list(state)
    assert len(counting.asked) == 4


def test_the_oldest_goes_first_however_often_all_were_forgotten() -> None:
    counting = Counting()
    known = Remembered(counting)
    for index in range(30):
        known.heights((float(index), 0.0))
        newest = range(max(index - 7, 0), index + 1)
        before = len(counting.asked)
        assert all(known.heights((float(each), 0.0)) == [float(each), 0.0] for each in newest)
        assert len(counting.asked) == before == index + 1


def test_threads_that_share_barriers_never_get_the_h_of_another_state() -> None:
    """One state in the place of another has that other's h nowhere in between, however threads take turns."""
    known, wrong = Remembered(Counting()), list[tuple[float, ...]]()

    def asks(seed: int) -> None:
        random = np.random.default_rng(seed)
        for value in random.integers(0, 12, 20_000).tolist():
            state = (float(value), float(seed % 2))
            if known.heights(state) != list(state):
                wrong.append(state)

    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as threads:
            list(threads.map(asks, range(4)))
    finally:
        sys.setswitchinterval(before)
    assert wrong == []


def test_the_shortest_way_gives_what_the_stack_gives() -> None:
    stack = stacked(PARTS)
    assert stack.plain(4) is stack.plain(4)
    reference = Barriers(PARTS)
    assert reference.plain(4) is reference
    for state in ((0.1, 0.2, 0.3, 0.4), (0.1, 0.2, 0.3, 0.4, 9.0)):
        for one in (stack, RememberingStack(stack)):
            plain = one.plain(len(state))
            assert plain.heights(state) == stack.heights(state) == one.heights(state)
            rows = range(len(stack.names))
            assert list(map(tuple, plain.slopes(state, rows))) == list(map(tuple, stack.slopes(state, rows)))
            assert plain.steepest(state) == stack.steepest(state)
        np.testing.assert_allclose(stack.heights(state), reference.heights(state), rtol=0.0, atol=1e-12)


def test_distances_as_large_and_as_small_as_floats_can_be() -> None:
    """There their squares are infinite or nothing."""
    stack = stacked(car_barriers(FilterSettings(), FOOTPRINT, [(0.0, 0.0, 0.0)]))
    for state in ((1e200, 0.0, 0.0, 0.0), (-1e200, 1e180, 0.3, 0.0), (0.0, 1e-200, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)):
        reference = stack.one_by_one.heights(state)
        np.testing.assert_allclose(stack.heights(state), reference, rtol=1e-12)
        np.testing.assert_allclose(stack.slopes(state, [0]), stack.one_by_one.slopes(state, [0]), atol=1e-12)


def test_a_verdict_has_all_its_fields() -> None:
    safe = SafetyFilter.for_model(load_model("car"), FilterSettings(), PARTS)
    for verdict in (safe.decide([0.0, 0.0, 0.0, 0.5], [0.5, 0.0], [0.5, 0.5]), safe.decide(None, None, None)):
        assert list(vars(verdict)) == [field.name for field in fields(Verdict)]
        assert Verdict(**vars(verdict)).as_dict() == verdict.as_dict()
