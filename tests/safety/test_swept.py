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


def test_a_valley_that_begins_next_to_an_end_is_seen() -> None:
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
    assert least(lambda x: 2.0 + x, [np.array([0.5]) for _ in range(3)]) == (2.5, (0, 0.0), 3)


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
    assert least_along(lambda x: np.array([0.25]), path).size[0] == 0.25


def test_a_position_is_a_read_only_state() -> None:
    point = chord_point(UNIT, (0, 0.25))
    np.testing.assert_array_equal(point, [0.25])
    assert chord_point(UNIT, (1, 0.0)) is UNIT[1]
    with pytest.raises(ValueError, match="read-only"):
        point[0] = 1.0


def _quartic(x: float, at: float) -> float:
    return (x - at) * (x - at) * (1.0 + 2.0 * x * x) - 0.1 * x


def _bent(x: float, at: float) -> float:
    return 0.3 * (x - at) if x > at else 1.7 * (at - x)


def _sunk(x: float, at: float) -> float:
    return -0.04 / (0.02 + (x - at) * (x - at)) + 0.3 * x


def _waved(x: float, at: float) -> float:
    y = 6.0 * (x - at)
    return y * y * y * y - 3.0 * y * y + 0.5 * y


LONG = [np.array([0.04 * tick - 0.002 * tick * (tick % 3)]) for tick in range(27)]


@pytest.mark.parametrize(
    ("curve", "path", "asked", "places"),
    [
        (_quartic, UNIT, 955, 19.567974226122608),
        (_bent, UNIT, 1689, 18.50000001518692),
        (_sunk, UNIT, 725, 18.450488867471798),
        (_waved, UNIT, 1130, 13.306592474441306),
        (_quartic, LONG, 2520, 508.64570931022405),
        (_bent, LONG, 2718, 475.8501748978265),
        (_sunk, LONG, 2193, 481.9661938540069),
        (_waved, LONG, 2629, 351.3391348282158),
    ],
)
def test_the_search_goes_the_way_that_was_recorded(
    curve: Callable[[float, float], float], path: list[np.ndarray], asked: int, places: float
) -> None:
    """How often h is asked, and where the least values are, over 37 curves: whatever changes the search changes this.

    Curves of products and quotients alone, so that every machine has the same digits.
    """
    found = [least(lambda x, at=at: curve(x, at), path) for at in np.linspace(-0.06, 1.06, 37).tolist()]
    assert sum(count for *_, count in found) == asked
    assert sum(k + share for _, (k, share), _ in found) == pytest.approx(places, abs=1e-12)


@pytest.mark.parametrize(("states", "asked"), [(5, 585), (6, 717), (27, 920)])
def test_of_several_values_each_is_searched_where_it_may_be_less(states: int, asked: int) -> None:
    """Up to four chords all are looked into, of more those where one of the values may be less."""
    counted = []
    for at in np.linspace(0.0, 1.0, 9).tolist():

        def h(x: np.ndarray, at: float = at) -> np.ndarray:
            counted.append(at)
            return np.array([_quartic(float(x[0]), at), _bent(float(x[0]), 1.0 - at), 3.0])

        least_along(h, [np.array([tick / (states - 1)]) for tick in range(states)])
    assert len(counted) == asked
