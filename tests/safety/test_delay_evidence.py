"""What counts as evidence of a delay that nobody told of, and where a robot stood, which is none."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa.safety.found_delay import FoundDelay, Passed
from safedpa.safety.prediction import Prediction

FAR = 1e6
"""m; a billionth of it is a millimetre."""
SHORT = 1e-18
"""s; over periods of it nothing is forgotten."""


def moved(state: Any, action: Any) -> Any:
    """A point that an action moves by itself. Refuses what is not finite, as a function of a user's may."""
    if not np.isfinite([*state, *action]).all():
        raise InputError("not finite")
    return np.array([entry + action[0] for entry in state])


def delay(period: float = 0.05, width: float = 1e-6) -> FoundDelay:
    return FoundDelay(Prediction(lambda state: (state, np.ones((len(state), 1))), moved), [width], period)


def stayed(place: float, away: float, late: int = 3) -> Passed:
    """A period in which the point stayed, as the command of ``late`` periods before alone says: the others move it."""
    return Passed((place,), (place,), tuple(((0.0 if n == late else away,), None) for n in range(5)))


@pytest.mark.parametrize(
    ("before", "now", "speeds", "stood"),
    [
        ((9.0, 0.0), (9.0, 0.0), (1,), True),
        ((9.0, 0.1), (9.0, -0.1), (1,), True),
        ((9.0, -0.09), (9.0, 0.09), (1,), True),
        ((9.0, 0.11), (9.0, 0.0), (1,), False),
        ((9.0, 0.0), (9.0, -0.11), (1,), False),
        ((9.0, 0.5), (9.0, 0.5), (1,), False),
        ((9.0, 0.05, 0.0), (9.0, 0.05, 0.0), (1, 2), True),
        ((9.0, 0.05, 0.0), (9.0, 0.05, 0.2), (1, 2), False),
        ((9.0, 0.2, 0.0), (9.0, 0.05, 0.0), (1, 2), False),
        ((9.0, 0.0), (9.0, 0.0), (), False),
        ((9.0, 0.0), (9.0, 0.0, 0.0), (1,), False),
        ((9.0, 0.0, 0.0), (9.0, 0.0), (1,), False),
        ((9.0, 0.0), (9.0, 0.0), (2,), False),
        ((9.0, 0.0), (9.0, 0.0), (1, 2), False),
    ],
)
def test_a_robot_below_a_tenth_of_a_metre_per_second_at_both_ends_was_stationary(
    before: tuple[float, ...], now: tuple[float, ...], speeds: tuple[int, ...], stood: bool
) -> None:
    """Of what has no speeds, or is no state, that is not known."""
    assert Passed(before, now, ()).stood(speeds) is stood


def test_six_periods_that_count_are_enough_where_one_delay_alone_explains_them() -> None:
    found, told = delay(SHORT), list[int]()
    for _ in range(8):
        found.observe(stayed(0.0, 1.0), None)
        told.append(found.periods)
    assert told == [0, 0, 0, 0, 0, 3, 3, 3]


@pytest.mark.parametrize(("away", "tells"), [(1.0, False), (-1.0, False), (1.0 + 1e-9, True), (-1.0 - 1e-9, True)])
def test_commands_have_to_differ_by_more_than_a_hundredth_of_their_range(away: float, tells: bool) -> None:
    found = delay(width=100.0)
    for _ in range(20):
        found.observe(stayed(0.0, away), None)
    assert found.periods == (3 if tells else 0)


@pytest.mark.parametrize(("place", "periods"), [(0.0, 3), (FAR, 0), (-FAR, 0)])
def test_an_error_of_a_billionth_of_the_state_is_no_evidence(place: float, periods: int) -> None:
    """Far from the origin the numbers say no more; at the origin the same error refutes all delays but one."""
    found = delay()
    for _ in range(200):
        found.observe(stayed(place, 1.05e-9 * FAR), None)
    assert found.periods == periods


@pytest.mark.parametrize("broken", [np.nan, np.inf, -np.inf])
def test_a_model_that_refuses_numbers_is_not_asked_about_what_is_not_finite(broken: float) -> None:
    found = delay()
    period = stayed(0.0, 1.0)._replace(before=(0.0, 0.0), now=(0.0, 0.0))
    for _ in range(5):
        found.observe(period, None)
    for place in range(2):
        bad = tuple(broken if index == place else 0.0 for index in range(2))
        found.observe(period._replace(before=bad), None)
        found.observe(period._replace(now=bad), None)
    assert found.periods == 0, "five periods count, and the broken ones do not"
    for _ in range(2):
        found.observe(period, None)
    assert found.periods == 3
