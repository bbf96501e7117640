"""The cycle collector sleeps through the turns of a fleet, and finds cycles that should not be made."""

import gc
import weakref
from collections import deque
from collections.abc import Iterator

import pytest

from safedpa.bus.service.process import GROWTH, freeze_garbage_collector

pytestmark = pytest.mark.long


class Knot:
    """What refers to itself."""

    def __init__(self) -> None:
        self.itself = self


@pytest.fixture
def settled() -> Iterator[list[int]]:
    """Generations that were collected since it was settled, in a process that holds much already."""
    before, generations = gc.get_threshold(), list[int]()
    held = [[number] for number in range(20 * GROWTH)]

    def note(phase: str, reported: dict[str, int]) -> None:
        if phase == "start":
            generations.append(reported["generation"])

    freeze_garbage_collector()
    gc.callbacks.append(note)
    yield generations
    assert len(held) == 20 * GROWTH
    gc.callbacks.remove(note)
    gc.set_threshold(*before)
    gc.unfreeze()


def test_it_sleeps_while_windows_turn_over_and_batches_come_and_go(settled: list[int]) -> None:
    window: deque[list[float]] = deque(maxlen=20_000)
    for turn in range(200):
        batch = [[float(turn), float(robot)] for robot in range(2_000)]
        window.extend(batch[:500])
    assert len(window) == 20_000
    assert settled == []


def test_it_finds_cycles_before_they_are_many(settled: list[int]) -> None:
    first = Knot()
    gone = weakref.ref(first)
    del first
    retained = 0
    while gone() is not None and retained < 2 * GROWTH:
        Knot()
        retained += 1
    assert gone() is None
    assert settled


def test_cycles_that_were_held_for_a_while_are_found_as_well(settled: list[int]) -> None:
    """They are old when they are let go: most are gone before ten times as many were made."""
    window: deque[Knot] = deque(maxlen=GROWTH // 2)
    made: list[weakref.ref[Knot]] = []
    for number in range(10 * GROWTH):
        knot = Knot()
        if number % 1_000 == 0:
            made.append(weakref.ref(knot))
        window.append(knot)
    alive = sum(one() is not None for one in made)
    assert alive < len(made) // 2
    assert 2 in settled


def test_what_lives_already_is_not_looked_at_again(settled: list[int]) -> None:
    assert gc.get_freeze_count() > 10_000
    assert settled == []
