"""Which fields of two messages differ, and which of them only in a last digit."""

from dataclasses import fields, replace

import pytest
from tests.messages import latent_of, stamp

from safedpa.bus import LatentMessage
from safedpa.replay.replay import Difference, differences

ONE = latent_of(0.5, 2.0, **stamp(8, epoch=3))
ALL = frozenset(item.name for item in fields(ONE))


def found(other: LatentMessage, known: frozenset[str] = ALL, **more: float) -> list[Difference]:
    return list(differences("latent", ONE, other, known, **more))


def test_a_difference_has_its_tick_and_both_values() -> None:
    assert found(replace(ONE)) == []
    assert found(replace(ONE, values=(0.5, 2.1))) == [
        Difference(3, 8, 0.4, "latent", "values", (0.5, 2.0), (0.5, 2.1), exact_only=False)
    ]


def test_the_time_of_sending_and_fields_that_were_not_recorded_are_not_compared() -> None:
    other = replace(ONE, publish_time=8.0, model="n", values=(0.6, 2.0), deviations=(0.1, 0.1 + 1e-9))
    assert {item.field: item.exact_only for item in found(other)} == {
        "model": False, "values": False, "deviations": True,
    }  # fmt: skip
    for left_out in ALL:
        names = {item.field for item in found(other, ALL - {left_out})}
        assert names == {"model", "values", "deviations"} - {left_out}


@pytest.mark.parametrize(
    ("one", "other", "near"),
    [
        (1.0, 1.0 + 0.9e-6, True), (1.0, 1.0 + 1.1e-6, False), (1000.0, 1000.0009, True), (1000.0, 1000.0011, False),
        (0.0, 0.9e-6, True), (0.0, 1.1e-6, False), (1e-9, -1e-9, True),
        ((1.0, 2.0), (1.0, 2.0 + 1e-9), True), ((1.0, 2.0), (1.1, 2.0), False), ((1.0,), (1.0, 2.0), False),
        (((1.0,), (2.0,)), ((1.0,), (2.0 + 1e-9,)), True),
        ("at 0.5 m", "at 0.5000000001 m", True), ("at 0.5 m", "at 0.6 m", False), ("at 0.5 m", "by 0.5 m", False),
        ("1e-3 of 2", "1.0e-3 of 2", True), ("-2", "2", False), ("", "x", False),
        (1, 2, False), (True, False, False), ("1", 1.0, False), (1.0, (1.0,), False),
        ((1.0,), 1.0, False), (1, 1.0 + 1e-9, False), ("a", 1, False),
    ],
)  # fmt: skip
def test_floats_and_numbers_in_sentences_may_differ_by_a_millionth_of_the_number_or_of_one(one, other, near):
    """Whole numbers, words and counts are equal or not."""
    (item,) = differences("latent", replace(ONE, values=one), replace(ONE, values=other), ALL)
    assert item.exact_only is near


def test_the_tolerance_can_be_chosen() -> None:
    other = replace(ONE, values=(0.5 + 1e-9, 2.0))
    assert [item.exact_only for item in found(other, tolerance=0.0)] == [False]
    assert [item.exact_only for item in found(replace(ONE, values=(0.51, 2.0)), tolerance=0.02)] == [True]
