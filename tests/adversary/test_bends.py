"""Problems that are not linear: the grid finds what is wrong with an answer, and says so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from safedpa.safety import SafetyFilter, Status
from safedpa_lab.experiments.adversary.bends import Bends, bent_answer
from safedpa_lab.experiments.adversary.bent_problem import BENT_SHAPES, BentProblem, bent_problem


def bent(h, wish=1.0, actions=1, eta=0.5, epsilon=0.0, units=(1.0, 1.0)):
    """At the origin; the first action moves x, the second y, each by itself."""

    def moved(a):
        return np.pad(a, ((0, 0), (0, 2 - a.shape[1])))

    return BentProblem("by hand", np.zeros(2), moved, h, actions, np.full(actions, wish), eta, epsilon, units)


def wall(x):
    """h = 0.4 - x: with eta 0.5 the furthest is x = 0.2."""
    return 0.4 - x[:, :1]


@pytest.mark.parametrize("units", [(1.0, 1.0), (1e-5, 1e4)])
def test_a_wall_is_kept_in_all_units(units):
    problem = bent(wall, units=units)
    verdict = problem.decide()
    assert verdict.status is Status.corrected
    assert verdict.action[0] / units[1] == pytest.approx(0.2, abs=1e-6)
    answer = bent_answer(problem)
    assert answer.broken == pytest.approx(0.0, abs=1e-9)
    assert answer.excess == pytest.approx(0.0, abs=2e-3)  # the grid's own steps


@pytest.fixture
def answers(monkeypatch):
    """Puts another answer in the place of the filter's."""

    def use(action, status):
        original = SafetyFilter.decide

        def decide(self, *arguments, **known):
            verdict = original(self, *arguments, **known)
            return replace(verdict, action=np.array(action), status=status)

        monkeypatch.setattr(SafetyFilter, "decide", decide)

    return use


def test_a_broken_condition_is_told_in_scales(answers):
    answers([0.3], Status.passed)
    found = bent_answer(bent(wall))
    assert found.broken == pytest.approx(0.1 / 2.0)  # the scale is what the action can change: 2
    assert not found.below
    answers([0.5], Status.passed)
    assert bent_answer(bent(wall)).below


def test_a_correction_that_goes_too_far_is_told_in_ranges(answers):
    answers([-1.0], Status.corrected)
    assert bent_answer(bent(wall)).excess == pytest.approx(0.6, abs=2e-3)


def test_a_feasible_action_that_was_not_found_is_told(answers):
    answers([1.0], Status.relaxed)
    found = bent_answer(bent(wall))
    assert found.missed
    assert found.needless
    assert found.shortfall == pytest.approx((1.4 + 0.6) / 2.0)


def test_what_cannot_be_kept_is_not_missed(answers):
    answers([-1.0], Status.relaxed)
    found = bent_answer(bent(lambda x: 0.4 - 0.0 * x[:, :1], epsilon=1.0))
    assert not found.missed
    assert not found.needless


def test_the_same_number_is_the_same_problem():
    for number in range(len(BENT_SHAPES)):
        one, other = bent_problem(3, number), bent_problem(3, number)
        grid = np.random.default_rng(number).uniform(-0.7, 0.7, (20, one.actions))
        np.testing.assert_array_equal(one.h(one.moved(grid)), other.h(other.moved(grid)))
        np.testing.assert_array_equal(one.wish, other.wish)


def test_planted_faults_make_the_counts_rise(monkeypatch):
    def measured():
        attack = Bends()
        found = attack.told([attack.work(piece) for piece in attack.pieces(1, small=True)])
        return {row.what: row for row in found.rows}, found.worst

    original = SafetyFilter.decide

    def deaf(self, state, wish, **known):
        verdict = original(self, state, wish, **known)
        low, high = self.settings.low, self.settings.high
        return replace(verdict, action=np.clip(wish, low, high), status=Status.passed)

    before, _ = measured()
    monkeypatch.setattr(SafetyFilter, "decide", deaf)
    after, worst = measured()
    for shape in BENT_SHAPES:
        what = f"{shape}: largest break of a condition, in scales"
        assert after[what].measured > 0.01
        assert after[what].measured > before[what].measured
    assert worst[0]["fault"] == "condition broken"
