"""The problems that the attacks pose, and the reference that judges answers to them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import quadprog
from tests.lab.adversary.problems import plane

from safedpa_lab.experiments.adversary.drives import Standing
from safedpa_lab.experiments.adversary.example_systems import disc_by_higher_order, late_drive
from safedpa_lab.experiments.adversary.linear.judge import LinearJudge
from safedpa_lab.experiments.adversary.linear.problem import SHAPES, LinearProblem, random_problem
from safedpa_lab.experiments.adversary.mirrors import MIRRORS
from safedpa_lab.experiments.adversary.peers import peer_problems


@pytest.mark.parametrize("name", list(MIRRORS))
@pytest.mark.parametrize(
    "problem",
    [
        plane(0.5, f=[0.75], g=[[1.0]], P=[[1.0]], q=[0.0], low=[-1.0], high=[2.0], nominal=[0.25], weights=[1.0],
              epsilon=[0.0]),
        plane(0.5, -0.25, f=[0.25, -0.5], g=[[1.0, 0.5], [-0.25, 2.0]], low=[-1.0, 0.0], high=[2.0, 0.5],
              P=[[1.0, 0.0], [0.0, 1.0], [-1.0, 2.0]], q=[0.1, 0.2, 0.3], epsilon=[0.0] * 3, nominal=(0.75, 0.125),
              weights=(1.0, 3.0)),
    ],
    ids=["one action", "two actions that both move both states"],
)  # fmt: skip
def test_another_form_of_a_problem_has_the_same_h_for_the_same_actions(name: str, problem: LinearProblem) -> None:
    """A row that was added is 1 whatever is done."""
    random = np.random.default_rng(3)
    other, back = MIRRORS[name](problem, random)
    np.testing.assert_allclose(back(other.nominal), problem.nominal, atol=1e-9)
    for share in random.uniform(0.0, 1.0, (4, len(other.low))):
        action = other.low + share * (other.high - other.low)
        assert (back(action) >= problem.low - 1e-9).all()
        assert (back(action) <= problem.high + 1e-9).all()
        there = other.heights(other.after(action))
        here = problem.heights(problem.after(back(action)))
        assert all(np.abs(there - h).min() < 1e-9 for h in here)
        assert all(np.abs([*here, 1.0] - h).min() < 1e-9 for h in there)


@pytest.mark.parametrize(
    ("g", "turned"),
    [([[1.0, 1.0], [0.0015, 0.0]], False), ([[1.0, 0.0], [0.0015, 0.0]], True),
     ([[0.5, 0.5], [0.00125, -0.00025]], True)],
)  # fmt: skip
def test_states_of_mixed_units_are_not_turned(g: Any, turned: bool) -> None:
    """If all actions together change one state a thousand times as much as another, their units differ."""
    problem = plane(0.0, 0.0, g=g)
    other, _ = MIRRORS["states turned"](problem, np.random.default_rng(1))
    assert (other is not problem) is turned


@pytest.mark.parametrize("mixed", [False, True])
@pytest.mark.parametrize("count", [0, 1, 4])
def test_peers_get_the_requested_number_of_problems(count: int, mixed: bool) -> None:
    assert len(peer_problems(1, count, mixed)) == count


def test_problems_of_the_violated_shape_are_below_zero_now() -> None:
    """With one row and with many; some have some rows below zero, others all of them."""
    place = list(SHAPES).index("violated")
    now = [p.heights(p.state) for p in (random_problem(1, place + len(SHAPES) * number) for number in range(60))]
    below = [int((h < 0.0).sum()) for h in now]
    assert min(below) >= 1
    assert {1, 12} <= {len(h) for h in now}
    assert any(0 < some < len(h) for some, h in zip(below, now, strict=True))
    assert any(some == len(h) > 1 for some, h in zip(below, now, strict=True))


@pytest.mark.parametrize("looking_ahead", [False, True])
@pytest.mark.parametrize("state", [(0.0, 0.5, 0.25, -0.5, 0.75), (0.0, -0.1, 0.0, 0.0, 0.0), (1.0, 0.0, 1.0, 1.0, 1.0)])
def test_the_backup_of_a_late_drive_brakes_the_speed_after_its_pending_actions(state, looking_ahead) -> None:
    system = late_drive(looking_ahead=looking_ahead)
    reached = np.array(state)
    for _ in range(3):
        reached = system.after(reached, np.zeros((1, 1)))[0]
    assert system.backup(np.array(state)) == pytest.approx([-5.0 * reached[1]])


@pytest.mark.parametrize(("away", "speed"), [(1.0, 1.0), (0.25, 0.5), (2.25, 1.5), (0.01, 0.1)])
def test_a_disc_allows_the_speed_that_a_brake_of_half_a_metre_per_second_squared_stops(away, speed) -> None:
    """v^2 / (2 * 0.5) is the way to the disc of 0.5 m: h is 0 at that speed, and grows as the speed falls."""
    for slower in (0.0, 0.05):
        h = disc_by_higher_order().heights(np.array([[0.5 + away, 0.0, -(speed - slower), 0.0]]))
        assert h.min() == pytest.approx(slower, abs=1e-9)


@pytest.mark.parametrize("small", [False, True])
def test_drives_that_look_for_standstills_alternate_between_no_delay_and_six_milliseconds(small: bool) -> None:
    pieces = Standing().pieces(3, small)
    cars = [one for one in pieces if one.driver != "point"]
    late = {load: [one.until_action for one in cars if one.load == load] for load in {one.load for one in cars}}
    assert set(map(len, late.values())) == {1 if small else 25}
    for own in late.values():
        assert own == [0.006 * (number % 2) for number in range(len(own))]
    assert len({(one.load, one.seed) for one in pieces}) == len(pieces)


def one_dimension(now: float, drift: float, epsilon: float = 0.0, nominal: float = 1.0) -> LinearProblem:
    """h = x, x+ = now + drift - a, a in 0 to 1, eta 0.5: kept by a <= now / 2 + drift - epsilon."""
    return plane(now, f=[now + drift], g=[[-1.0]], P=[[1.0]], q=[0.0], low=[0.0], high=[1.0], nominal=[nominal],
                 weights=[1.0], epsilon=[epsilon])  # fmt: skip


def test_an_infeasible_problem_has_no_nearest_action_but_a_least_unsafe_one():
    judge = LinearJudge(one_dimension(0.5, -2.0))
    assert judge.nearest() is None
    best, action = judge.best_least_height()
    assert action[0] == pytest.approx(0.0)
    assert best == pytest.approx(-1.5 / 1.0)  # the scale is what the action can change: 1
    assert judge.best_least_residual()[0] == pytest.approx(-1.75)


def test_a_scale_is_the_largest_of_h_margin_and_reach():
    assert LinearJudge(one_dimension(3.0, 0.0)).scale[0] == 3.0
    assert LinearJudge(one_dimension(0.3, 0.0)).scale[0] == 1.0
    assert LinearJudge(one_dimension(0.3, 0.0, epsilon=7.0)).scale[0] == 7.0


def by_quadprog(problem: LinearProblem) -> float | None:
    """Distance of the optimum; None where quadprog says that there is none."""
    judge, actions = LinearJudge(problem), len(problem.low)
    width = problem.high - problem.low
    slope = (problem.P @ problem.g) * width / judge.scale[:, None]
    limit = (judge.required - problem.heights(problem.after(problem.low))) / judge.scale
    nominal = (problem.nominal - problem.low) / width
    rows = np.vstack([slope, np.eye(actions), -np.eye(actions)])
    limits = np.concatenate([limit, np.zeros(actions), -np.ones(actions)])
    hessian = np.diag(2.0 * problem.weights)
    try:
        found = quadprog.solve_qp(hessian, hessian @ nominal, rows.T.copy(), limits)[0]
    except ValueError:
        return None
    return float(np.sqrt((problem.weights / problem.weights.max() * (found - nominal) ** 2).sum()))


@pytest.mark.long
@pytest.mark.parametrize("first", range(0, 1100, 275))
def test_two_references_agree_on_random_problems(first):
    compared = 0
    for number in range(first, first + 275):
        problem = random_problem(5, number)
        if problem.shape in ("costly", "feeble", "parallel"):
            continue  # where quadprog's own tolerance decides
        own, other = LinearJudge(problem).nearest(), by_quadprog(problem)
        room = LinearJudge(problem).best_least_residual()[0]
        if room > 1e-6:
            assert own is not None
            assert other is not None
            assert own.distance == pytest.approx(other, abs=1e-6)
            compared += 1
        elif room < -1e-6:
            assert own is None
    assert compared > 50


def test_no_random_action_is_better_than_what_the_linear_program_attains():
    random = np.random.default_rng(3)
    for number in range(110):
        problem = random_problem(6, number)
        judge = LinearJudge(problem)
        best = judge.best_least_height()[0]
        room = judge.best_least_residual()[0]
        for action in random.uniform(problem.low, problem.high, (50, len(problem.low))):
            assert judge.heights(action).min() <= best + 1e-7
            assert judge.residuals(action).min() <= room + 1e-7


def test_other_units_change_nothing_that_the_reference_says():
    random = np.random.default_rng(4)
    for number in range(len(SHAPES) * 4):
        problem = replace(random_problem(7, number), witness=None)
        rows, states, actions = len(problem.q), len(problem.f), len(problem.low)
        other = problem.scaled(*(10.0 ** random.uniform(-3, 3, count) for count in (rows, states, actions)))
        assert LinearJudge(other).best_least_height()[0] == pytest.approx(
            LinearJudge(problem).best_least_height()[0], abs=1e-4
        )


def test_a_witness_keeps_what_it_is_a_witness_of():
    found = [p for p in (random_problem(8, number) for number in range(2200)) if p.witness is not None]
    assert len(found) > 20
    for problem in found:
        assert LinearJudge(problem).broken(problem.witness) == 0.0
