"""Problems that are not linear: the grid finds what is wrong with an answer, and says so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.lab.adversary.problems import answer_with

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


def test_a_broken_condition_is_measured_in_scales(monkeypatch):
    """With a scale of 2, by which the action can change h."""
    answer_with(monkeypatch, "passed", [0.3])
    found = bent_answer(bent(wall))
    assert found.broken == pytest.approx(0.1 / 2.0)
    assert not found.below
    answer_with(monkeypatch, "passed", [0.5])
    assert bent_answer(bent(wall)).below


def test_a_correction_that_goes_too_far_is_measured_in_ranges(monkeypatch):
    answer_with(monkeypatch, "corrected", [-1.0])
    assert bent_answer(bent(wall)).excess == pytest.approx(0.6, abs=2e-3)
    assert bent_answer(bent(lambda x: 0.4 - 0.0 * x[:, :1], epsilon=1.0)).excess is None, "no action keeps it"


@pytest.mark.parametrize(
    ("status", "lift", "action", "missed", "needless"),
    [
        ("relaxed", 0.5, 0.0, True, False), ("relaxed", 0.5, 0.9, True, True), ("fallback", 0.5, -0.9, True, True),
        ("violated", 0.5, 0.9, False, False), ("relaxed", -0.25, 0.9, False, False),
        ("relaxed", 0.006, 0.9, True, True), ("relaxed", 0.002, 0.9, True, True),
    ],
)  # fmt: skip
def test_an_answer_misses_what_a_single_point_of_the_grid_keeps(status, lift, action, missed, needless, monkeypatch):
    """h = lift + a and lift - a: of points 0.002 apart those from -lift / 2 to lift / 2 keep both conditions."""
    answer_with(monkeypatch, status, [action])
    problem = bent(lambda x: np.concatenate([lift + x[:, :1], lift - x[:, :1]], axis=1))
    found = bent_answer(problem, 7)
    assert (found.number, found.status, found.missed, found.needless) == (7, status, missed, needless)
    own = (lift - abs(action)) / 2.0
    assert found.shortfall == pytest.approx(max(0.0, lift / 2.0 - own))


def test_a_number_always_draws_the_same_problem():
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
