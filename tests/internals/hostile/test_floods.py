"""The account of a flood."""

from safedpa_lab.benchmarks.hostile.floods import _longest


def test_the_longest_stretch_of_braking_is_counted_in_periods() -> None:
    assert _longest([]) == 0.0
    assert _longest([1.0]) == 0.05
    assert _longest([1.0, 1.05, 1.10, 2.0, 2.05]) == 0.15
