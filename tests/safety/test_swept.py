"""The least h along a path, between its states too, and where a rollout barrier takes it."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.safety.test_rollout_barrier import affine, brake, differences, room

from safedpa.safety import AbstractBarrier, RolloutBarrier
from safedpa.safety.barriers.path_minimum import chord_point, minimum_along

Curve = Callable[[float], float]
UNIT = [np.array([0.0]), np.array([1.0])]


def least(curve: Curve, path: list[np.ndarray], always: int = 0) -> tuple[float, tuple[int, float], int]:
    """Least value, its place, and how often h was asked."""
    asked = []

    def h(x: np.ndarray) -> np.ndarray:
        asked.append(float(x[0]))
        return np.array([curve(float(x[0]))])

    found = minimum_along(h, path, always)
    assert found.values[0] == pytest.approx(curve(float(chord_point(path, found.points[0])[0])), abs=1e-15)
    return float(found.values[0]), found.points[0], len(asked)


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


def test_what_only_falls_or_rises_is_least_at_its_end_and_a_valley_next_to_it_is_seen() -> None:
    for place in (0.001, 0.999):
        value, _, _ = least(lambda x, at=place: (x - at) ** 2, UNIT)
        assert value == pytest.approx(0.0, abs=1e-12)
    assert least(lambda x: 1.0 - x, UNIT)[:2] == (0.0, (1, 0.0))
    assert least(lambda x: 1.0 + x, UNIT)[:2] == (1.0, (0, 0.0))
    assert least(lambda x: 1.0, UNIT)[:2] == (1.0, (0, 0.0)), "of equal places the first"


def test_a_path_at_rest_is_asked_at_its_states_alone() -> None:
    value, place, asked = least(lambda x: 2.0 + x, [np.array([0.5])] * 3)
    assert (value, place, asked) == (2.5, (0, 0.0), 3)
    assert least(lambda x: 2.0 + x, [np.array([0.5])]) == (2.5, (0, 0.0), 1)
    assert least(lambda x: 2.0 + x, [np.array([0.5]) for _ in range(3)]) == (2.5, (0, 0.0), 3)


def test_of_a_long_path_the_first_chords_and_those_that_may_hold_less_are_looked_into() -> None:
    path = [np.array([0.1 * tick]) for tick in range(41)]
    value, (k, share), asked = least(lambda x: abs(x - 2.03) + 1.0, path)
    assert value == pytest.approx(1.0, abs=1e-8)
    assert (k, share) == (20, pytest.approx(0.3, abs=1e-6))
    assert asked <= 100
    # A dip that none of a long path's neighbours suggests.
    path = [np.array([0.1 * tick]) for tick in range(41)]

    def dip(x: float) -> float:
        return 1.0 + x - 1.5 * max(0.0, 1.0 - abs(x - 0.03) / 0.02)

    assert least(dip, path, always=1)[0] == pytest.approx(-0.47, abs=1e-3)


def test_each_value_has_a_place_of_its_own() -> None:
    path = [np.array([0.0]), np.array([1.0]), np.array([2.0])]
    found = minimum_along(lambda x: np.array([abs(x[0] - 0.4), 3.0 - x[0], abs(x[0] - 1.7) - 5.0]), path)
    np.testing.assert_allclose(found.values, [0.0, 1.0, -5.0], atol=1e-8)
    assert [k for k, _ in found.points] == [0, 2, 1]
    np.testing.assert_allclose([share for _, share in found.points], [0.4, 0.0, 0.7], atol=1e-7)
    np.testing.assert_array_equal(found.size, [1.6, 3.0, 4.7])
    assert minimum_along(lambda x: np.array([0.0]), path).size[0] == 1.0, "never 0: it is divided by"
    assert minimum_along(lambda x: np.array([0.25]), path).size[0] == 0.25


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
        (_quartic, UNIT, 955, 19.567974226122608), (_bent, UNIT, 1689, 18.50000001518692),
        (_sunk, UNIT, 725, 18.450488867471798), (_waved, UNIT, 1130, 13.306592474441306),
        (_quartic, LONG, 2520, 508.64570931022405), (_bent, LONG, 2718, 475.8501748978265),
        (_sunk, LONG, 2193, 481.9661938540069), (_waved, LONG, 2629, 351.3391348282158),
    ],
)  # fmt: skip
def test_the_search_goes_the_way_that_was_recorded(curve, path, asked, places):
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

        minimum_along(h, [np.array([tick / (states - 1)]) for tick in range(states)])
    assert len(counted) == asked


Values = NDArray[np.float64]


@pytest.mark.long
@pytest.mark.parametrize("disc", [0, 1, 2])
def test_the_gradient_of_one_alone_is_that_of_its_values(disc: int) -> None:
    """With no other that is taken later on the way, with the chord to the start and without it."""
    random, agreed = np.random.default_rng(disc), 0
    whole = RolloutBarrier(affine, brake, lambda x: room(x)[disc], 40)
    for _ in range(20):
        x = np.r_[random.uniform((0.0, -1.5), (3.0, 2.0)), random.uniform(-1.2, 1.2, 2)]
        barriers: tuple[AbstractBarrier, ...] = (whole, whole.starting_at(x - 0.02 * random.normal(size=4)))
        for barrier in barriers:
            gradient = barrier.h_and_grad(x)[1]
            agreed += np.abs(gradient - differences(barrier, x)).max() < 1e-6
            for entry in range(4):
                along = barrier.lie_derivative(x, 0.05 * np.eye(4)[:, [entry]])
                assert np.abs(along[:, 0] - 0.05 * gradient[:, entry]).max() < 1e-3
    assert agreed >= 36, "all but where the backup's limits make a kink"


def drifting(height: float, horizon: int, thin: bool = False) -> RolloutBarrier:
    """Of a robot that moves by its second entry with every tick, whatever is done."""

    def step(x: Values, a: Values) -> Values:
        return np.array([x[0] + a[0], x[1] + 1.0])

    if thin:  # a wall across the first entry, on which nothing that comes afterwards depends
        return RolloutBarrier(step, (0.0,), lambda x: abs(x[0]) - 0.01, horizon)
    return RolloutBarrier(step, (0.0,), lambda x: [height - x[1], height + x[1]], horizon, ("falls", "rises"))


def test_what_is_thin_is_seen_on_the_chord_to_the_start_though_nothing_changes_afterwards() -> None:
    barrier = drifting(0.0, 30, thin=True)
    state = np.array([1.0, 0.0])
    assert barrier.h(state) == pytest.approx([0.99])
    assert barrier.starting_at(np.array([-1.0, -1.0])).h(state) == pytest.approx([-0.01], abs=1e-6)


@pytest.mark.parametrize("horizon", [1, 3, 7])
def test_what_is_beyond_the_horizon_is_looked_at_over_another_one(horizon: int) -> None:
    """h = 10 - t falls by as much again, 10 + t does not."""
    found = drifting(10.0, horizon).fall_beyond(np.zeros(2))
    np.testing.assert_allclose(found, [horizon, 0.0])


def test_nothing_falls_beyond_rest() -> None:
    barrier = RolloutBarrier(lambda x, a: 0.5 * x if abs(x[0]) > 0.1 else x, (0.0,), lambda x: 1.0 - x[0] ** 2, 30)
    assert len(barrier.path(np.array([0.9]))) < 10
    np.testing.assert_array_equal(barrier.fall_beyond(np.array([0.9])), [0.0])


@pytest.mark.parametrize("ticks", [1, 2])
def test_a_nearby_state_that_rests_some_ticks_earlier_is_looked_at_where_it_rests(ticks: int) -> None:
    """A robot that brakes for twenty ticks; a tenth slower it brakes for eighteen, and its way ends there.

    Braking by b a tick from v it comes (v + v^2 / b) / 2 far, which changes by 1/2 + v / b with v.
    """
    brakes, speed = 5e-5, 1e-3

    def step(x: Values, a: Values) -> Values:
        return np.array([x[0] + x[1], max(x[1] - brakes, 0.0) if x[1] > 0.5 * brakes else 0.0])

    barrier = RolloutBarrier(step, (0.0,), lambda x: 1.0 - x[0], 300)
    state = np.array([0.0, speed])
    assert len(barrier.path(state)) == 22, "and one tick at rest"
    assert barrier.h(state) == pytest.approx([1.0 - (speed + speed**2 / brakes) / 2.0])
    change = 1000.0 * ticks * brakes  # a thousandth of what the actions change is looked at
    (slope,) = barrier.lie_derivative(state, np.array([[0.0], [change]]))[0]
    assert slope / change == pytest.approx(-(0.5 + speed / brakes), rel=0.05)
