"""The sequential test keeps its promise however seconds depend on each other, and is quick when it matters."""

from math import exp, log

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safedpa.live.model_monitor import ALPHA, BEYOND, EDetector

INSIDE, OUTSIDE, FAR = 0.5, 1.5, BEYOND + 1.0


def value_after(ratios: list[float]) -> float:
    evidence = EDetector()
    for second, ratio in enumerate(ratios):
        evidence.add(ratio, 20 * second)
    return exp(evidence.value)


@given(
    beyond=st.floats(0.0, 0.01),
    outside=st.floats(0.0, 0.04),
    past=st.lists(st.sampled_from([INSIDE, OUTSIDE, FAR]), max_size=3),
)
def test_the_mean_grows_by_at_most_one_a_second_under_every_null(beyond: float, outside: float, past: list[float]):
    """M[n] - n is a supermartingale: from that follows P(raised within n seconds) <= n alpha, by Doob.

    Two seconds far outside come first, since a mean below one is reported as one.
    """
    past = [FAR, FAR, *past]
    outcomes = ((INSIDE, 1 - beyond - outside), (OUTSIDE, outside), (FAR, beyond))
    mean = sum(probability * value_after([*past, ratio]) for ratio, probability in outcomes)
    assert mean <= value_after(past) + 1.0 + 1e-6


def test_in_the_worst_null_hours_pass_without_a_finding() -> None:
    random = np.random.default_rng(5)
    hours, raised = 20, 0
    for _ in range(hours):
        evidence = EDetector()
        for draw in random.random(3600):
            evidence.add(FAR if draw < 0.01 else OUTSIDE if draw < 0.05 else INSIDE, 0)
            if evidence.raised:
                raised += 1
                break
    assert hours * 3600 * ALPHA < 0.1  # the promise
    assert raised <= 1


def test_a_fault_of_twice_the_band_is_raised_within_five_seconds() -> None:
    assert log(value_after([INSIDE] * 600 + [FAR] * 3)) < -log(ALPHA)
    assert log(value_after([INSIDE] * 600 + [FAR] * 5)) >= -log(ALPHA)


def test_it_takes_a_minute_of_good_seconds_to_forget_and_then_it_is_gone() -> None:
    evidence = EDetector()
    for second in range(60):
        evidence.add(FAR, second)
    for second in range(15):
        evidence.add(INSIDE, second)
    assert evidence.raised
    for second in range(60):
        evidence.add(INSIDE, second)
    assert evidence.value == pytest.approx(0.0, abs=1.0)
    assert evidence.since is None


def test_since_is_the_first_bad_second_of_the_run() -> None:
    evidence = EDetector()
    for second, ratio in enumerate([INSIDE, OUTSIDE, INSIDE, INSIDE, INSIDE, FAR, FAR]):
        evidence.add(ratio, second)
    assert evidence.since == 5
