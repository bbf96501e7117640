"""The least h along a path, between its states too."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from safedpa.safety.swept import chord_point, least_along

Curve = Callable[[float], float]
UNIT = [np.array([0.0]), np.array([1.0])]


def least(curve: Curve, path: list[np.ndarray], always: int = 0) -> tuple[float, tuple[int, float], int]:
    """Least value, its place, and how often h was asked."""
    asked = []

    def h(x: np.ndarray) -> np.ndarray:
        asked.append(float(x[0]))
        return np.array([curve(float(x[0]))])

    found = least_along(h, path, always)
    assert found.values[0] == pytest.approx(curve(float(chord_point(path, found.places[0])[0])), abs=1e-15)
    return float(found.values[0]), found.places[0], len(asked)


@pytest.mark.parametrize("radius", [0.02, 0.1, 1.0])
def test_a_dip_is_found_wherever_it_lies(radius: float) -> None:
    for place in np.linspace(0.01, 0.99, 99):
        value, (k, share), asked = least(lambda x, at=place: float(np.hypot(x - at, 0.3 * radius)) - radius, UNIT)
        assert value == pytest.approx(-0.7 * radius, abs=1e-9)
        assert k == 0
        assert share == pytest.approx(place, abs=1e-4)
        assert asked <= 60


def test_of_two_dips_the_deeper_counts() -> None:
    for deeper in (0.2, 0.8):
        value, (_, share), _ = least(
            lambda x, at=deeper: min(abs(x - 0.2) - 0.05, abs(x - 0.8) - 0.05) - 0.01 * (abs(x - at) < 0.1), UNIT
        )
        assert value == pytest.approx(-0.06, abs=1e-7)
        assert share == pytest.approx(deeper, abs=1e-6)


def test_a_valley_that_begins_beside_an_end_is_seen() -> None:
    for place in (0.001, 0.999):
        value, _, _ = least(lambda x, at=place: (x - at) ** 2, UNIT)
        assert value == pytest.approx(0.0, abs=1e-12)


def test_what_only_falls_or_only_rises_is_least_at_its_end() -> None:
    assert least(lambda x: 1.0 - x, UNIT)[:2] == (0.0, (1, 0.0))
    assert least(lambda x: 1.0 + x, UNIT)[:2] == (1.0, (0, 0.0))
    assert least(lambda x: 1.0, UNIT)[:2] == (1.0, (0, 0.0)), "of equal places the first"


def test_a_path_at_rest_is_asked_at_its_states_alone() -> None:
    value, place, asked = least(lambda x: 2.0 + x, [np.array([0.5])] * 3)
    assert (value, place, asked) == (2.5, (0, 0.0), 3)
    assert least(lambda x: 2.0 + x, [np.array([0.5])]) == (2.5, (0, 0.0), 1)


def test_of_a_long_path_only_chords_that_may_hold_less_are_looked_into() -> None:
    path = [np.array([0.1 * tick]) for tick in range(41)]
    value, (k, share), asked = least(lambda x: abs(x - 2.03) + 1.0, path)
    assert value == pytest.approx(1.0, abs=1e-8)
    assert (k, share) == (20, pytest.approx(0.3, abs=1e-6))
    assert asked <= 100


def test_first_chords_are_looked_into_in_any_case() -> None:
    """A dip that none of a long path's neighbours suggests."""
    path = [np.array([0.1 * tick]) for tick in range(41)]

    def dip(x: float) -> float:
        return 1.0 + x - 1.5 * max(0.0, 1.0 - abs(x - 0.03) / 0.02)

    assert least(dip, path, always=1)[0] == pytest.approx(-0.47, abs=1e-3)


def test_each_value_has_a_place_of_its_own() -> None:
    path = [np.array([0.0]), np.array([1.0]), np.array([2.0])]
    found = least_along(lambda x: np.array([abs(x[0] - 0.4), 3.0 - x[0], abs(x[0] - 1.7) - 5.0]), path)
    np.testing.assert_allclose(found.values, [0.0, 1.0, -5.0], atol=1e-8)
    assert [k for k, _ in found.places] == [0, 2, 1]
    np.testing.assert_allclose([share for _, share in found.places], [0.4, 0.0, 0.7], atol=1e-7)
    np.testing.assert_array_equal(found.size, [1.6, 3.0, 4.7])
    assert least_along(lambda x: np.array([0.0]), path).size[0] == 1.0, "never 0: it is divided by"


def test_a_place_is_a_state_that_nobody_can_write_into() -> None:
    point = chord_point(UNIT, (0, 0.25))
    np.testing.assert_array_equal(point, [0.25])
    assert chord_point(UNIT, (1, 0.0)) is UNIT[1]
    with pytest.raises(ValueError, match="read-only"):
        point[0] = 1.0
