"""Verdicts at the edges: exact tolerances, limited rounds, what could not be computed."""

import numpy as np
import pytest

from safedpa.safety import FilterSettings, FunctionBarrier, QuadraticProgram, SafetyFilter, Solution, Status
from safedpa.safety import decision as decision_module
from safedpa.safety.conditions import Conditions, Outcome


def line_filter(wall: float = 1.0, **changes: object) -> SafetyFilter:
    """x[t+1] = x + a, h = wall - x, exact in binary: eta 1, so that the condition is h(x+) >= epsilon."""
    settings = FilterSettings(action_low=(-4.0,), action_high=(4.0,), epsilon=0.0, eta=1.0, **changes)  # type: ignore[arg-type]
    return SafetyFilter(lambda x: (x, np.eye(1)), [FunctionBarrier(lambda x: wall - x[0])], settings)


def test_what_leads_to_just_the_limit_is_kept() -> None:
    safe = line_filter()
    assert safe.decide(np.zeros(1), [1.0]).status is Status.passed
    assert safe.decide(np.zeros(1), [1.0 + 1e-9]).status is Status.corrected


def test_active_means_within_a_fiftieth_of_the_scale() -> None:
    """h now is 1: residuals up to 0.02."""
    safe = line_filter()
    assert safe.decide(np.zeros(1), [0.9801]).active == ("h",)
    assert safe.decide(np.zeros(1), [0.9799]).active == ()


def test_kinds_without_a_margin_have_none() -> None:
    safe = SafetyFilter(
        lambda x: (x, np.eye(1)),
        [FunctionBarrier(lambda x: 1.0 - x[0])],
        FilterSettings(action_low=(-1.0,), action_high=(1.0,)),
    )
    assert safe.decide(np.zeros(1), [0.0]).margin == 0.0
    assert safe.decide(None, [0.0]).margin == 0.0


def test_backup_that_leads_to_just_the_limit_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decision_module, "search", lambda conditions, program, wish, start, *_: (start, "solved"))
    verdict = line_filter(wall=0.0).decide(np.zeros(1), [1.0])
    assert (verdict.status, verdict.reason) == (Status.corrected, "Found from another start than the wish.")
    assert verdict.action[0] == 0.0


def test_search_result_that_leads_to_just_the_limit_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    def found(conditions: Conditions, *_: object) -> tuple[Outcome, str]:
        return conditions.outcome((1.0,)), "solved"

    monkeypatch.setattr(decision_module, "search", found)
    verdict = line_filter().decide(np.zeros(1), [2.0])
    assert (verdict.status, verdict.reason) == (Status.corrected, "")


@pytest.mark.parametrize("relinearisations", [0, 3])
def test_program_is_posed_once_and_then_as_often_as_allowed(
    monkeypatch: pytest.MonkeyPatch, relinearisations: int
) -> None:
    """A solver whose answers all break the condition and never come again: the search gives up after the last round."""
    safe, calls = line_filter(relinearisations=relinearisations), []

    def stubborn(_: object, A: np.ndarray, b: np.ndarray, wish: np.ndarray) -> Solution:
        calls.append(wish)
        return Solution(np.array([2.0 - 0.01 * len(calls)]), np.zeros(1), True, "solved")

    monkeypatch.setattr(QuadraticProgram, "solve", stubborn)
    assert safe.decide(np.zeros(1), [2.0]).reason == "Found from another start than the wish."
    assert len(calls) == 3 * (relinearisations + 1)  # from the wish, then from two others


def test_what_could_not_be_computed_is_not_made_up() -> None:
    def raises(*_: object) -> np.ndarray:
        raise RuntimeError("no prediction")

    settings = FilterSettings(action_low=(-1.0,), action_high=(1.0,), epsilon=0.0)
    safe = SafetyFilter(lambda x: (x, np.eye(1)), [FunctionBarrier(lambda x: 3.0 - x[0])], settings, step=raises)
    for state, h_now in (([1.0], 2.0), (None, 0.0)):
        verdict = safe.decide(state, [0.5])
        assert verdict.status is Status.fallback
        assert (verdict.known, verdict.slack, verdict.h_now, verdict.h_next, verdict.active) == (
            False,
            0.0,
            h_now,
            0.0,
            (),
        )
