"""No state within the speed limits has a steeper barrier than the theory's formula says."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from safedpa.errors import InputError
from safedpa.networks import frame_of
from safedpa.robots.car.barriers import braking_of, car_barriers
from safedpa.robots.car.theory_gradient import largest_gradients
from safedpa.safety import FilterSettings
from safedpa.safety.theory_bound import scaled_gradient

SCALE = np.array([0.03, 0.01, 0.02, 0.1])


@given(some.integers(0, 2**32 - 1), some.floats(0.05, 1.0), some.floats(0.05, 1.0))
@settings(max_examples=60, deadline=None)
def test_sampled_gradients_stay_below_the_largest(seed: int, rear: float, front: float) -> None:
    """Also where the gradient belongs to the state after the step, and the frame to the one before."""
    random = np.random.default_rng(seed)
    chosen, footprint = FilterSettings(), (rear, front, 0.2)
    limits = largest_gradients(chosen, footprint, SCALE)
    obstacles = np.column_stack([random.uniform(-3, 3, (20, 2)), random.uniform(0.1, 0.4, 20)])
    for _ in range(20):
        before, after = random.uniform(
            (-3, -3, -np.pi, chosen.barrier("speed_low")), (3, 3, np.pi, chosen.barrier("speed_high")), (2, 4)
        )
        for part in car_barriers(chosen, footprint, obstacles, (-4, 4, -4, 4)):
            p = scaled_gradient(part.evaluate(after)[1], before, frame_of("car"), SCALE)
            assert np.abs(p).sum(axis=1).max() <= limits[part.kind] * (1 + 1e-9)


def test_the_formula_is_not_far_above_what_occurs() -> None:
    random = np.random.default_rng(1)
    chosen, footprint = FilterSettings(), (0.08, 0.4, 0.12)
    limits = largest_gradients(chosen, footprint, SCALE)
    largest = dict.fromkeys(limits, 0.0)
    for _ in range(3000):
        state = random.uniform((-3, -3, -np.pi, 1.5), (3, 3, np.pi, chosen.barrier("speed_high")))
        for part in car_barriers(chosen, footprint, [(2.0, 0.0, 0.3)], (-4, 4, -4, 4)):
            p = scaled_gradient(part.evaluate(state)[1], state, frame_of("car"), SCALE)
            largest[part.kind] = max(largest[part.kind], float(np.abs(p).sum(axis=1).max()))
    assert all(largest[kind] > 0.85 * limits[kind] for kind in limits)


def test_the_arm_is_the_longer_end_of_what_is_swept() -> None:
    """Behind it reaches as far as the stopping distance of the way back, in front as that of the way forth."""
    for chosen, footprint in (
        (FilterSettings().with_barriers(speed_low=-2.0, speed_high=0.2), (0.5, 0.1, 0.2)),
        (FilterSettings().with_barriers(speed_low=0.1), (0.1, 0.6, 0.2)),
        (FilterSettings().with_barriers(speed_low=0.1, speed_high=0.2), (0.6, 0.1, 0.2)),
        (FilterSettings().with_barriers(speed_low=-2.0, speed_high=-0.1), (0.1, 0.9, 0.2)),
    ):
        rear, front, _ = footprint
        stop = braking_of(chosen).distance
        slowest, fastest = chosen.barrier("speed_low"), chosen.barrier("speed_high")
        arm = max(rear - min(stop(slowest), 0.0), front + max(stop(fastest), 0.0))
        slope = max((stop(at + 1e-6) - stop(at - 1e-6)) / 2e-6 for at in (slowest, fastest))
        body = np.hypot(0.03, 0.01) + np.hypot(arm * 0.02, slope * 0.1)
        found = largest_gradients(chosen, footprint, SCALE)
        assert found == {"obstacle": pytest.approx(body), "field": pytest.approx(body), "speed": 0.1}


def test_a_wrong_footprint_is_refused() -> None:
    with pytest.raises(InputError, match="footprint"):
        largest_gradients(FilterSettings(), (0.1, np.nan, 0.1), SCALE)
