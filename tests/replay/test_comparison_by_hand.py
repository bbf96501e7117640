"""Which fields of two messages differ, and which of them in a last digit alone, by hand."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import pytest

from safedpa.bus import LatentMessage
from safedpa.replay.comparison import TOLERANCE, Difference, _near, differences

ONE = LatentMessage(
    epoch=3, tick=8, robot_time=0.4, publish_time=7.0, model="m", values=(0.5, 2.0), deviations=(0.1, 0.1)
)
ALL = frozenset(item.name for item in fields(ONE))


def told(other: LatentMessage, known: frozenset[str] = ALL, **more: float) -> list[Difference]:
    return list(differences("latent", ONE, other, known, **more))


def test_what_differs_is_told_with_its_place_and_both_values() -> None:
    assert told(replace(ONE)) == []
    assert told(replace(ONE, values=(0.5, 2.1))) == [
        Difference(3, 8, 0.4, "latent", "values", (0.5, 2.0), (0.5, 2.1), exact_only=False)
    ]
    assert [item.field for item in told(replace(ONE, values=(0.6, 2.0), model="n"))] == ["model", "values"]


def test_when_it_was_sent_and_what_the_recording_does_not_know_is_not_compared() -> None:
    assert told(replace(ONE, publish_time=8.0)) == []
    assert told(replace(ONE, values=(9.0, 9.0)), ALL - {"values"}) == []
    assert told(replace(ONE, publish_time=8.0, model="n"), ALL - {"values"})[0].field == "model"


@pytest.mark.parametrize(
    ("one", "other", "near"),
    [
        (1.0, 1.0 + 0.9e-6, True), (1.0, 1.0 + 1.1e-6, False), (1000.0, 1000.0009, True), (1000.0, 1000.0011, False),
        (0.0, 0.9e-6, True), (0.0, 1.1e-6, False), (1e-9, -1e-9, True),
        ((1.0, 2.0), (1.0, 2.0 + 1e-9), True), ((1.0, 2.0), (1.1, 2.0), False), ((1.0,), (1.0, 2.0), False),
        (((1.0,), (2.0,)), ((1.0,), (2.0 + 1e-9,)), True), ((), (), True),
        ("at 0.5 m", "at 0.5000000001 m", True), ("at 0.5 m", "at 0.6 m", False), ("at 0.5 m", "by 0.5 m", False),
        ("1e-3 of 2", "1.0e-3 of 2", True), ("-2", "2", False), ("", "x", False),
        (1, 2, False), (True, False, False), (3, 3, True), ("1", 1.0, False), (1.0, (1.0,), False),
        ((1.0,), 1.0, False), (1, 1.0 + 1e-9, False), ("a", 1, False),
    ],
)  # fmt: skip
def test_near_is_a_millionth_of_the_number_or_of_one(one: Any, other: Any, near: bool) -> None:
    """Also of numbers in a sentence; whole numbers, words and counts are the same or not."""
    assert TOLERANCE == 1e-6
    assert _near(one, other, TOLERANCE) is near


def test_another_last_digit_is_marked_and_without_a_tolerance_it_is_a_difference() -> None:
    other = replace(ONE, values=(0.5 + 1e-9, 2.0))
    assert [item.exact_only for item in told(other)] == [True]
    assert [item.exact_only for item in told(other, tolerance=0.0)] == [False]
    assert [item.exact_only for item in told(replace(ONE, values=(0.51, 2.0)), tolerance=0.02)] == [True]
