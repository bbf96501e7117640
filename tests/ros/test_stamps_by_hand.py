"""A time of ROS is told in nanoseconds."""

from __future__ import annotations

from typing import Any

import pytest

from safedpa.ros.decoding import Decoder


@pytest.mark.parametrize(
    ("seconds", "nanoseconds", "told"),
    [(0, 0, 0), (0, 7, 7), (5, 6, 5_000_000_006), (1_764_108_000, 999_999_999, 1_764_108_000_999_999_999)],
)
def test_a_stamp_is_its_seconds_and_nanoseconds_in_one_whole_number(seconds: int, nanoseconds: int, told: int) -> None:
    """No digit is lost, as one would be in a float."""
    found: Any = Decoder._value("time", ["before", seconds, nanoseconds], 1)
    assert found == told
    assert isinstance(found, int)
    assert Decoder._value("time", [None, None], 0) is None
