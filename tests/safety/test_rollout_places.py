"""Where on its way a rollout barrier takes its least h: between ticks, past the start, beyond the horizon."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.safety.test_rollout_barrier import affine, brake, differences, room

from safedpa.safety import AbstractBarrier, RolloutBarrier

Values = NDArray[np.float64]


@pytest.mark.parametrize("disc", [0, 1, 2])
def test_the_gradient_of_one_alone_is_that_of_its_values(disc: int) -> None:
    """With no other that is taken later on the way, with the chord to the start and without it."""
    random, agreed = np.random.default_rng(disc), 0
    whole = RolloutBarrier(affine, brake, lambda x: room(x)[disc], 40)
    for _ in range(20):
        x = np.r_[random.uniform((0.0, -1.5), (3.0, 2.0)), random.uniform(-1.2, 1.2, 2)]
        barriers: tuple[AbstractBarrier, ...] = (whole, whole.since(x - 0.02 * random.normal(size=4)))
        for barrier in barriers:
            gradient = barrier.evaluate(x)[1]
            agreed += np.abs(gradient - differences(barrier, x)).max() < 1e-6
            for entry in range(4):
                along = barrier.along(x, 0.05 * np.eye(4)[:, [entry]])
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
    assert barrier.values(state) == pytest.approx([0.99])
    assert barrier.since(np.array([-1.0, -1.0])).values(state) == pytest.approx([-0.01], abs=1e-6)


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
    assert barrier.values(state) == pytest.approx([1.0 - (speed + speed**2 / brakes) / 2.0])
    change = 1000.0 * ticks * brakes  # a thousandth of what the actions change is looked at
    (slope,) = barrier.along(state, np.array([[0.0], [change]]))[0]
    assert slope / change == pytest.approx(-(0.5 + speed / brakes), rel=0.05)
