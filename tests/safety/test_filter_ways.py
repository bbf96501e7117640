"""The rarer ways to an action: brought back and posed once more, beside the least broken, past what is on its way."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.internals.safety.test_batch_search import TWO, Problems

from safedpa.dynamics import Setting, load_model
from safedpa.effects import effect
from safedpa.safety import FilterSettings, FunctionBarrier, Prediction, SafetyFilter, Status, Verdict
from safedpa.safety import decision as decisions
from safedpa.safety.on_its_way import Pending

Values = NDArray[np.float64]


def test_an_action_brought_back_is_nearest_once_the_program_is_posed_from_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """h = min(a_1, 1) + a_2 - 1.2: what was found stands on the plateau, at its edge the nearest is on the slope."""
    settings = FilterSettings(action_low=(0.0, 0.0), action_high=(4.0, 4.0), eta=1.0, epsilon=0.0)

    def step(x: Values, a: Values) -> Values:
        return np.array([min(a[0], 1.0), a[1]])

    def affine(x: Values, around: Values) -> tuple[Values, Values]:
        g = np.diag([float(around[0] <= 1.0), 1.0])
        return step(x, around) - g @ around, g

    gradient = np.array([1.0, 1.0])
    barrier = FunctionBarrier(lambda x: x[0] + x[1] - 1.2, lambda x: gradient)
    found, searched = [(2.0, 0.5)], decisions.search

    def far_at_first(conditions: Any, *rest: Any) -> Any:
        return (conditions.outcome(found.pop()), "solved") if found else searched(conditions, *rest)

    monkeypatch.setattr(decisions, "search", far_at_first)
    verdict = SafetyFilter(Prediction(affine, step), [barrier], settings).decide((1.0, 1.0), (0.1, 0.1))
    assert verdict.status is Status.corrected
    np.testing.assert_allclose(verdict.action, (0.6, 0.6), atol=1e-6)


@pytest.mark.parametrize(
    ("seed", "bend", "most", "rows", "robot"),
    [(3, 1.5, 2.0, 2, 8), (5, 1.5, 2.0, 2, 16), (6, 0.5, 1.2, 3, 41), (8, 1.5, 2.0, 2, 53), (9, 0.5, 1.2, 3, 45)],
)
def test_a_feasible_action_next_to_the_least_broken_of_many_is_found(
    seed: int, bend: float, most: float, rows: int, robot: int
) -> None:
    """Islands that neither the tangents nor the lattice meet, in front of a saturated actuator."""
    problems = Problems(seed, 60, TWO, bend, most, rows)

    def step(x: Values, action: Values) -> Values:
        return problems.moved(robot, x, action)

    def affine(x: Values, around: Values) -> tuple[Values, Values]:
        g = problems.g(robot, around)
        return step(x, around) - g @ around, g

    names = tuple(f"h{row}" for row in range(rows))
    barrier = FunctionBarrier(lambda x: problems.heights(robot, x), lambda x: problems.gradient(robot, x), names)
    state = problems.state[robot]
    verdict = SafetyFilter(Prediction(affine, step), [barrier], TWO).decide(state, problems.wish[robot])
    assert (verdict.status, verdict.reason) == (Status.corrected, "Found beside the least broken of many actions.")
    now, then = barrier.values(state), barrier.values(step(state, verdict.action))
    assert (then >= (1.0 - TWO.eta) * now + 0.01 - 1e-9 * np.abs(now)).all()


LATE = load_model("car").with_effect(effect("car", "actuator_delay"), {"seconds": Setting(0.2)})
HELD = (1.0, 0.0)


def decided(low: float, state: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)) -> tuple[Verdict, Verdict]:
    """Past a pillar that is passed before this action acts, h = ``low`` inside and 1 elsewhere; and without it."""
    memory = LATE.initial_memory(np.array(HELD))
    inside = FunctionBarrier(lambda x: low if 0.08 < x[0] < 0.17 else 1.0)
    free = FunctionBarrier(lambda x: 1.0)
    found = [
        SafetyFilter.for_model(LATE, FilterSettings(epsilon=0.0), barriers=[barrier]).decide(
            state, HELD, LATE.latent, memory=Pending(memory, HELD)
        )
        for barrier in (inside, free)
    ]
    return found[0], found[1]


def test_a_collision_before_the_action_acts_is_reported() -> None:
    verdict, free = decided(-0.2)
    assert (free.status, free.h_next) == (Status.passed, 1.0)
    assert (verdict.status, verdict.h_next) == (Status.relaxed, -0.2)
    assert verdict.reason == "Some h falls below 0 before this action can act."
    np.testing.assert_array_equal(verdict.action, free.action)


@pytest.mark.parametrize("low", [0.0, 0.3])
def test_a_narrow_pass_before_the_action_acts_is_reported_and_nothing_is_given_up(low: float) -> None:
    verdict, _ = decided(low)
    assert (verdict.status, verdict.h_next, verdict.reason) == (Status.passed, low, "")


def test_another_verdict_keeps_its_own_words() -> None:
    """Below 0 now and on the way: it says which h that is."""
    verdict, _ = decided(-0.2, (0.1, 0.0, 0.0, 1.0))
    assert verdict.status is Status.violated
    assert verdict.h_next == -0.2
    assert "falls below" not in verdict.reason
