"""A clock that fails must not cost the robot its action."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from safedpa.safety.finite_clock import FiniteClock


def broken() -> float:
    raise OSError("no clock")


@pytest.mark.parametrize("now", [0.0, 12.5, -3.0, 1e15, -1e15])
def test_a_finite_time_is_passed_on_unchanged(now: float) -> None:
    assert FiniteClock(lambda: now)() == now


@pytest.mark.parametrize("now", [1.01e15, -1.01e15, 1e300, -1e300, math.inf, -math.inf, math.nan, "noon", None])
def test_what_can_be_no_time_is_0(now: object) -> None:
    assert FiniteClock(lambda: now)() == 0.0


@pytest.mark.parametrize("clock", [broken, None, lambda _argument: 1.0])
def test_a_clock_that_raises_tells_0(clock: Callable[[], float]) -> None:
    assert FiniteClock(clock)() == 0.0
