"""A decision with a deadline: the best candidate in time, with the status that is true of it."""

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from safedpa.safety import FilterSettings, FunctionBarrier, SafetyFilter, Status

DT = 0.1
FEASIBLE = (Status.passed, Status.corrected)


def step(x: Any, a: Any) -> Any:
    """A car on a plane: position, heading and speed; not affine in its actions."""
    speed = np.clip(x[3] + DT * np.clip(a[0], -2.0, 2.0), -0.5, 2.0)
    yaw = x[2] + DT * speed * np.tan(np.clip(a[1], -0.5, 0.5))
    return np.array([x[0] + DT * speed * np.cos(yaw), x[1] + DT * speed * np.sin(yaw), yaw, speed])


def affine(x: Any, around: Any = (0.0, 0.0)) -> Any:
    base = step(x, around)
    g = np.array([(step(x, around + e) - step(x, around - e)) / 2e-6 for e in 1e-6 * np.eye(2)]).T
    return base - g @ np.asarray(around), g


def h(x: Any) -> Any:
    stop = max(x[3], 0.0) ** 2 / 4.0
    return [np.hypot(x[0] - cx, x[1] - cy) - 0.4 - stop for cx, cy in ((1.5, 0.1), (2.5, -1.0), (0.5, 1.4))]


def make_filter(clock: Any = None) -> SafetyFilter:
    own = FilterSettings(action_low=(-2.0, -0.5), action_high=(2.0, 0.5), backup_action=(-2.0, 0.0), epsilon=0.01)
    barriers = [FunctionBarrier(h, names=("a", "b", "c"))]
    return SafetyFilter(affine, barriers, own, step=step, **({} if clock is None else {"clock": clock}))


SAFE = make_filter()


@given(some.integers(0, 2**32 - 1), some.integers(1, 120))
@settings(max_examples=150, deadline=None)
def test_whatever_the_budget_the_status_is_true_and_more_of_it_is_never_worse(seed: int, budget: int) -> None:
    random = np.random.default_rng(seed)
    x = random.uniform((-1, -1.5, -3, -0.5), (3, 1.5, 3, 2.0))
    nominal = random.uniform((-2, -0.5), (2, 0.5))
    whole = SAFE.decide(x, nominal)
    cut = SAFE.decide(x, nominal, evaluations=budget)
    again = SAFE.decide(x, nominal, evaluations=budget)
    assert cut == again
    before, after = np.array(h(x)), np.array(h(step(x, cut.action)))
    satisfied = bool((after - 0.8 * before - 0.01 >= -1e-7).all() and (after >= -1e-7).all())
    assert (cut.status in FEASIBLE) == (satisfied and before.min() >= 0.0)
    assert (cut.status is Status.violated) == (before.min() < 0.0)
    if cut.solver != "out of time":
        assert cut == whole
    else:
        assert "deadline" in cut.reason
    if cut.status in FEASIBLE:
        assert whole.status in FEASIBLE
        away, best = (np.linalg.norm((v.action - nominal) / (4.0, 1.0)) for v in (cut, whole))
        assert best <= away + 1e-3


def test_a_clock_that_has_run_out_gives_the_backup_or_better() -> None:
    readings = itertools.count()
    late = make_filter(lambda: float(next(readings)))
    verdict = late.decide([0.6, 0.1, 0.0, 1.0], [2.0, 0.0], deadline=0.5)
    assert verdict.solver == "out of time"
    assert verdict.action.tolist() == [-2.0, 0.0]
    relaxed = late.decide([0.6, 0.1, 0.0, 1.0], [2.0, 0.0], deadline=1e-6, epsilon={"function": 5.0})
    assert relaxed.status is Status.relaxed
    assert relaxed.reason.startswith("Not satisfied: a, c, b.")
    off = SafetyFilter(affine, late.barriers, replace(late.settings, enabled=False), step=step)
    for limit in (1, 5):
        assert off.decide([0.6, 0.1, 0.0, 1.0], [2.0, 0.0], evaluations=limit).status is Status.disabled
    off = off.decide([0.6, 0.1, 0.0, 1.0], [2.0, 0.0], deadline=1e-12)
    assert (off.status, off.action.tolist()) == (Status.disabled, [2.0, 0.0])
    assert late.decide([-2.0, 0.1, 0.0, 0.0], [0.5, 0.0], deadline=100.0).status is Status.passed


@pytest.mark.parametrize("wrong", [0, -1.0, float("nan"), "soon"])
def test_a_limit_that_is_none_brings_the_backup(wrong: Any) -> None:
    for what in ("deadline", "evaluations"):
        verdict = SAFE.decide([-2.0, 0.1, 0.0, 0.0], [0.5, 0.0], **{what: wrong})
        assert verdict.status is Status.fallback
        assert f"{what}: got" in verdict.reason
