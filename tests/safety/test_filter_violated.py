"""Relaxed and violated: what is taken where not all can be kept, or some h is below 0 already."""

import numpy as np
import pytest

from safedpa.safety import FilterSettings, FunctionBarrier, SafetyFilter, Status, Verdict


def infeasible(start: float, backup: object = None, gain: float = 1.0) -> Verdict:
    """h = x, which falls by 3 whatever is done: larger actions let it fall less; the wish is -0.5."""
    settings = FilterSettings(action_low=(-1.0,), action_high=(1.0,), epsilon=0.0)
    safe = SafetyFilter(
        lambda x: (x - 3.0, np.array([[gain]])),
        [FunctionBarrier(lambda x: x[0])],
        settings,
        backup=backup,  # type: ignore[arg-type]
    )
    return safe.decide(np.array([start]), [-0.5])


def test_relaxed_takes_the_action_that_leaves_the_most() -> None:
    verdict = infeasible(5.0)
    assert verdict.status is Status.relaxed
    assert verdict.action[0] == pytest.approx(1.0, abs=0.02)
    assert verdict.reason == "Not kept: h."
    assert verdict.slack == pytest.approx(4.0 - verdict.h_next)
    assert verdict.h_next == pytest.approx(3.0, abs=0.02)
    assert verdict.active == ("h",)


@pytest.mark.parametrize("backup", [-1.0, 0.25, 1.0])
def test_violated_takes_the_action_that_raises_h_most_whatever_the_backup(backup: float) -> None:
    verdict = infeasible(-2.0, backup=lambda state: np.array([backup]))
    assert verdict.status is Status.violated
    assert verdict.action[0] == pytest.approx(1.0, abs=0.02)
    assert verdict.reason == "Below 0: h."
    assert verdict.h_now == -2.0
    assert verdict.h_next == pytest.approx(-4.0, abs=0.02)
    assert verdict.solver == "solved"
    assert verdict.intervened


@pytest.mark.parametrize(("start", "status"), [(5.0, Status.relaxed), (-2.0, Status.violated)])
def test_where_no_action_helps_within_one_step_the_backup_is_taken(start: float, status: Status) -> None:
    """All are equally unsafe by then: the backup is what is known to be good beyond."""
    verdict = infeasible(start, backup=lambda state: np.array([0.25]), gain=0.0)
    assert verdict.status is status
    assert verdict.action[0] == 0.25
    assert verdict.reason.endswith(" No action moves h within one step: the backup is taken for the wish.")


@pytest.mark.parametrize(
    ("start", "status"), [(1e-12, Status.relaxed), (0.0, Status.relaxed), (-1e-12, Status.violated)]
)
def test_violated_begins_right_below_zero(start: float, status: Status) -> None:
    assert infeasible(start).status is status


def test_violated_even_where_the_wish_keeps_every_condition() -> None:
    """From -1 to -0.5 is what a condition asks for and more; nobody is to be told that all is well."""
    settings = FilterSettings(action_low=(-1.0,), action_high=(1.0,), epsilon=0.0)
    safe = SafetyFilter(lambda x: (x, np.eye(1)), [FunctionBarrier(lambda x: x[0])], settings)
    verdict = safe.decide(np.array([-1.0]), [0.5])
    assert verdict.status is Status.violated
    assert verdict.slack == 0.0
    assert verdict.action[0] == pytest.approx(1.0, abs=0.02)


def test_violated_names_all_that_is_below_zero() -> None:
    settings = FilterSettings(action_low=(-1.0,), action_high=(1.0,), epsilon=0.0)
    barrier = FunctionBarrier(lambda x: [x[0] - 1.0, x[0], -2.0 - x[0]], names=("a", "b", "c"))
    verdict = SafetyFilter(lambda x: (x, np.eye(1)), [barrier], settings).decide(np.zeros(1), [0.0])
    assert verdict.reason == "Below 0: a, c."


def test_relaxed_names_three_barriers_and_says_that_there_are_more() -> None:
    settings = FilterSettings(action_low=(-1.0,), action_high=(1.0,), epsilon=0.0)

    def reason(count: int) -> str:
        names = tuple(f"h{index}" for index in range(count))
        barrier = FunctionBarrier(lambda x: [1.0 + index + x[0] for index in range(count)], names=names)
        safe = SafetyFilter(lambda x: (x - 9.0, np.eye(1)), [barrier], settings)
        return safe.decide(np.zeros(1), [0.0]).reason

    assert reason(1) == "Not kept: h0."
    assert reason(3) == "Not kept: h0, h1, h2."
    assert reason(4) == "Not kept: h0, h1, h2, ...."
