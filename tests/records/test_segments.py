"""Clocks that are set, that two publishers mix, and rows that are late: where a log is cut and what is sorted."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.records.segments import judge_clock, late_rows

T = 0.05 * np.arange(200)


@settings(max_examples=100, deadline=None)
@given(
    back=st.floats(0.12, 4000.0), row=st.integers(20, 180), jitter=st.floats(0.0, 0.2), seed=st.integers(0, 1000),
    start=st.sampled_from([0.0, 1.7e9]),
)  # fmt: skip
def test_a_clock_that_is_set_back_cuts_there_and_nowhere_else(back, row, jitter, seed, start) -> None:
    noise = 0.05 * jitter * np.random.default_rng(seed).uniform(-0.5, 0.5, len(T))
    clock = judge_clock(start + T + noise - back * (np.arange(len(T)) >= row))
    assert clock.cuts.tolist() == [row]
    assert not clock.wrong.any()


@settings(max_examples=100, deadline=None)
@given(delay=st.integers(1, 9), length=st.integers(1, 5), row=st.integers(20, 150))
def test_rows_that_come_late_are_no_cut(delay: int, length: int, row: int) -> None:
    if 0.05 * (delay + length - 1) > 0.5:
        delay = 10 - length
    order = [*range(row), *range(row + length, row + length + delay), *range(row, row + length)]
    order += range(row + length + delay, len(T))
    clock = judge_clock(T[order])
    late, largest = late_rows(T[order], clock.segment)
    assert not len(clock.cuts)
    assert late.sum() == length
    assert largest == pytest.approx(0.05 * (delay + length - 1))


@pytest.mark.parametrize("other", [0.0, 3.0e7, -1.7e9])
@pytest.mark.parametrize("share", [2, 3, 20])
def test_times_of_another_clock_are_wrong(other: float, share: int) -> None:
    strange = np.arange(len(T)) % share == 1
    times = np.where(strange, other if other == 0.0 else T + other, T + 1.7e9)
    clock = judge_clock(times, 1.7e9 + T, np.where(strange, 1.0, 2.0))
    assert np.array_equal(clock.wrong, strange)
    assert not len(clock.cuts)


def test_episodes_are_segments_and_a_pause_is_none() -> None:
    clock = judge_clock(np.concatenate([T[:50], T[:80], T[:30], T[60:100]]))
    assert clock.cuts.tolist() == [50, 130]
    assert not clock.wrong.any()


def test_two_rates_and_slow_rows_are_one_segment() -> None:
    for times in (np.concatenate([T, T[-1] + np.arange(1.0, 60.0)]), 10.0 * T, np.full(20, 3.0), T[:1], T[:0]):
        clock = judge_clock(times)
        assert not len(clock.cuts)
        assert not clock.wrong.any()


def test_a_clock_that_is_set_forward_is_cut_if_another_clock_shows_it() -> None:
    times = T + 30.0 * (np.arange(len(T)) >= 70)
    assert judge_clock(times, T).cuts.tolist() == [70]
    assert not len(judge_clock(times, times).cuts)
