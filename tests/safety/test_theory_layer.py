"""The boundary layer: where some action raises h by the error, h stays; where none does, errors add up, as stated."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa.safety import FilterSettings, FunctionBarrier, SafetyFilter
from safedpa.safety.least_unsafe import TOLERANCE
from safedpa.safety.theory_layer import Stay, least_after, stays_in_layer

ETA, EPSILON, STEP = 0.2, 0.02, 0.1
DEPTH = EPSILON / ETA


def driven(
    lowest: float, error: float, h: float, steps: int, *, at_rest: bool = False
) -> tuple[list[float], list[float]]:
    """h measured and predicted of x+ = x + 0.1 a, h = 1 - x, pushed towards the wall by ``error`` in every step.

    ``at_rest``: a robot that stands is not pushed.
    """
    settings = FilterSettings(
        action_low=(lowest,), action_high=(1.0,), backup_action=(max(lowest, 0.0),), eta=ETA, epsilon=EPSILON
    )
    barrier = FunctionBarrier(lambda x: 1.0 - x[0])
    safe = SafetyFilter(lambda x: (x, np.array([[STEP]])), [barrier], settings)
    x, now, then = 1.0 - h, [], []
    for _ in range(steps):
        verdict = safe.decide(np.array([x]), wish=[1.0])
        now.append(verdict.h_now)
        then.append(verdict.h_next)
        moved = STEP * float(verdict.action[0])
        x += moved + (0.0 if at_rest and abs(moved) < 1e-6 else error)
    return now, then


@pytest.mark.parametrize("h", [0.0, 0.01, 0.05, DEPTH])
@pytest.mark.parametrize("error", [0.0, 0.01, EPSILON])
def test_where_an_action_raises_h_by_the_error_h_stays_above_0_wherever_it_begins(h: float, error: float) -> None:
    given_away = TOLERANCE * (STEP + 2.0 * error)  # of what the actions can change in h, for the least change of a wish
    now, then = driven(-(error + given_away) / STEP, error, h, 300)
    assert min(now) >= min(h, (EPSILON - error) / ETA) - 1e-9, "where the condition is kept h tends to the second"
    bound = least_after(h, [error] * 300, [error] * 300, ETA)
    assert bound >= -1e-12
    assert min(now) >= bound - 1e-9
    assert all(stay.least_rise >= -1e-9 for stay in stays_in_layer(now, then, [DEPTH] * 300))


def test_where_actions_only_keep_h_errors_add_up_and_no_filter_helps() -> None:
    """A robot that is pushed for ever and cannot back away."""
    error = 0.005
    now, then = driven(0.0, error, DEPTH, 60)
    first = next(tick for tick, h in enumerate(now) if h < -1e-9)
    assert first in (20, 21), "the layer's depth over the error of a step"
    (stay,) = stays_in_layer(now, then, [DEPTH] * 60)
    assert stay.least_rise == pytest.approx(0.0, abs=1e-9), (
        "nothing of what there is may be given away, tick after tick"
    )
    assert stay.fall == pytest.approx(stay.errors, abs=1e-7)
    assert least_after(DEPTH, [0.0] * 59, [error] * 59, 0.0) == pytest.approx(now[-1], abs=1e-7)


def test_a_robot_that_stands_errs_no_more_and_stays_in_the_layer() -> None:
    now, then = driven(0.0, EPSILON, 2.0 * DEPTH, 100, at_rest=True)
    assert min(now) >= DEPTH - EPSILON - 1e-9
    assert now[-1] == pytest.approx(now[-20], abs=1e-6)
    assert all(stay.errors <= EPSILON + 1e-9 for stay in stays_in_layer(now, then, [DEPTH] * 100))


def test_the_layer_follows_a_worked_example() -> None:
    now = [0.5, 0.08, 0.06, 0.2, 0.05]
    then = [0.1, 0.09, 0.25, 0.1, 0.05]
    stays = stays_in_layer(now, then, [0.1] * 5)
    assert stays == [
        Stay(2, 0.08, 0.06, pytest.approx(0.01), pytest.approx(0.03 + 0.05)),
        Stay(1, 0.05, 0.05, 0.0, 0),
    ]
    assert [stay.fall for stay in stays] == [pytest.approx(0.02), 0.0]
    assert stays_in_layer([], [], []) == []
    assert stays_in_layer([0.1], [0.1], [0.1]) == [], "at its depth the layer is left"
    with pytest.raises(InputError, match="wanted as many of each"):
        stays_in_layer([0.1], [], [])
    with pytest.raises(InputError, match="1 rises and 0 errors"):
        least_after(0.1, [0.0], [], 0.2)
    assert least_after(0.1, [0.0, 0.0], [0.2, 0.0], 0.5) == pytest.approx(-0.1)
    assert least_after(0.1, [0.0, 0.3], [0.2, 0.0], 0.5) == pytest.approx(-0.1), "raised again by the second"
    assert least_after(0.0, [0.2], [0.1], 0.5) == 0.0, "at 0 the condition asks for no more than 0"
