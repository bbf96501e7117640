"""The same question in another form is the same question, and a filter that answers otherwise is noticed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from safedpa.safety import SafetyFilter, Status
from safedpa_lab.experiments.adversary.linear_judge import LinearJudge
from safedpa_lab.experiments.adversary.linear_problem import LinearProblem
from safedpa_lab.experiments.adversary.linear_shapes import random_problem
from safedpa_lab.experiments.adversary.mirrors import MIRRORS, Mirrors


def measured(seed=2):
    attack = Mirrors()
    found = attack.told([attack.work(piece) for piece in attack.pieces(seed, small=True)])
    return {row.what: row for row in found.rows if row.what.endswith("other answers")}, found.worst


@pytest.mark.parametrize("name", MIRRORS)
def test_the_reference_says_the_same_of_both_forms(name):
    """The mirrors themselves are right: what can be attained, and where, does not depend on the form."""
    compared = 0
    for number in range(0, 240, 6):
        problem = random_problem(11, number)
        if problem.shape in ("boundary", "whole", "meeting", "parallel", "violated"):
            continue
        other, back = MIRRORS[name](problem, np.random.default_rng(number))
        before, after = LinearJudge(problem).nearest(), LinearJudge(other).nearest()
        assert (before is None) == (after is None)
        if before is not None and after is not None:
            weights = np.sqrt(problem.weights / problem.weights.max())
            apart = weights * (back(after.action) - before.action) / (problem.high - problem.low)
            assert np.abs(apart).max() < 1e-5
            compared += 1
    assert compared > 8


def test_a_filter_that_prefers_the_first_barrier_is_noticed(monkeypatch):
    """Planted: all barriers but the first are forgotten."""

    def decide(self):
        return self.filter().decide(self.state, wish=self.wish, barriers=self.barriers()[:1])

    before, _ = measured()
    assert before["barriers in another order: other answers"].held
    monkeypatch.setattr(LinearProblem, "decide", decide)
    after, worst = measured()
    assert after["barriers in another order: other answers"].measured > 15
    assert worst[0]["apart"] > 1e-6 or len(set(worst[0]["statuses"])) == 2


def test_a_filter_that_remembers_the_last_action_is_noticed(monkeypatch):
    original = SafetyFilter.decide

    def decide(self, state, wish, *others, **known):
        verdict = original(self, state, wish, *others, **known)
        last = getattr(self, "planted", verdict.action)
        self.planted = verdict.action
        if verdict.status is not Status.corrected or np.shape(last) != np.shape(verdict.action):
            return verdict
        return replace(verdict, action=0.9 * verdict.action + 0.1 * last)

    monkeypatch.setattr(SafetyFilter, "decide", decide)
    found, _ = measured()
    assert found["a filter that answered others before: other answers"].measured > 5
    assert found["barriers in another order: other answers"].held


def test_a_filter_that_prefers_positive_actions_is_noticed(monkeypatch):
    original = SafetyFilter.decide

    def decide(self, state, wish, *others, **known):
        verdict = original(self, state, wish, *others, **known)
        moved = verdict.action + 1e-4 * (self.settings.high - verdict.action)
        return replace(verdict, action=moved) if verdict.status is Status.corrected else verdict

    monkeypatch.setattr(SafetyFilter, "decide", decide)
    found, _ = measured()
    assert found["actions turned round: other answers"].measured > 5
