"""Commands that arrive late: what the car feels, and when."""

from __future__ import annotations

from math import inf, nan

import pytest

from safedpa.errors import InputError
from safedpa_sim.robots.core import LateCommands


def felt(late: LateCommands, *commands: tuple[float, float]) -> list[tuple[float, float, float]]:
    return [(drive, steer, round(seconds, 9)) for each in commands for drive, steer, seconds in late.felt(each, 0.05)]


def test_without_delay_a_command_acts_for_its_period() -> None:
    assert felt(LateCommands(0.0, 0.0), (1.0, 0.1), (2.0, 0.2)) == [(1.0, 0.1, 0.05), (2.0, 0.2, 0.05)]


def test_whole_periods_late() -> None:
    found = felt(LateCommands(0.1, 0.1), (1.0, 0.1), (2.0, 0.2), (0.5, 0.3), (0.0, 0.0))
    assert found == [(0.0, 0.0, 0.05), (0.0, 0.0, 0.05), (1.0, 0.1, 0.05), (2.0, 0.2, 0.05)]


def test_a_part_of_a_period_late() -> None:
    found = felt(LateCommands(0.02, 0.02), (1.0, 0.1), (2.0, 0.2))
    assert found == [(0.0, 0.0, 0.02), (1.0, 0.1, 0.03), (1.0, 0.1, 0.02), (2.0, 0.2, 0.03)]


def test_each_channel_by_its_own_delay() -> None:
    found = felt(LateCommands(0.01, 0.05), (1.0, 0.1), (2.0, 0.2))
    assert found == [(0.0, 0.0, 0.01), (1.0, 0.0, 0.04), (1.0, 0.1, 0.01), (2.0, 0.1, 0.04)]


def test_periods_add_up_for_a_long_time() -> None:
    late = LateCommands(0.13, 0.07)
    for tick in range(2000):
        parts = list(late.felt((float(tick), -float(tick)), 0.05))
        assert sum(seconds for _, _, seconds in parts) == pytest.approx(0.05)
    assert parts[-1][0] == 1997.0
    assert parts[-1][1] == -1998.0


@pytest.mark.parametrize("seconds", [-0.1, nan, inf])
def test_a_delay_is_a_number_of_seconds(seconds: float) -> None:
    with pytest.raises(InputError, match=r"steer_seconds: got .*, wanted a finite number of seconds, 0 or more"):
        LateCommands(0.0, seconds)
