"""The problems that the attacks pose: other forms of one problem, peers' problems, small systems, drives."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from tests.lab.adversary.problems import plane

from safedpa_lab.experiments.adversary.line_systems import late_drive
from safedpa_lab.experiments.adversary.linear_problem import LinearProblem
from safedpa_lab.experiments.adversary.linear_shapes import SHAPES, random_problem
from safedpa_lab.experiments.adversary.looking_systems import disc_by_higher_order
from safedpa_lab.experiments.adversary.mirrors import MIRRORS
from safedpa_lab.experiments.adversary.peers import peer_problems
from safedpa_lab.experiments.adversary.standing import Standing


def one_action() -> LinearProblem:
    """x+ = x + a and h = x, in one dimension."""
    return plane(0.5, f=[0.75], g=[[1.0]], P=[[1.0]], q=[0.0], low=[-1.0], high=[2.0], wish=[0.25], weights=[1.0],
                 epsilon=[0.0])  # fmt: skip


def two_actions() -> LinearProblem:
    """Of different ranges, that move both states; three rows."""
    return plane(
        0.5, -0.25, f=[0.25, -0.5], g=[[1.0, 0.5], [-0.25, 2.0]], low=[-1.0, 0.0], high=[2.0, 0.5],
        P=[[1.0, 0.0], [0.0, 1.0], [-1.0, 2.0]], q=[0.1, 0.2, 0.3], epsilon=[0.0] * 3, wish=(0.75, 0.125),
        weights=(1.0, 3.0),
    )  # fmt: skip


@pytest.mark.parametrize("name", list(MIRRORS))
@pytest.mark.parametrize("problem", [one_action(), two_actions()], ids=["one action", "two actions"])
def test_another_form_of_a_problem_has_the_same_h_for_the_same_actions(name: str, problem: LinearProblem) -> None:
    """A row that was added is 1 whatever is done."""
    random = np.random.default_rng(3)
    other, back = MIRRORS[name](problem, random)
    np.testing.assert_allclose(back(other.wish), problem.wish, atol=1e-9)
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
def test_the_backup_of_a_late_drive_brakes_the_speed_after_its_pending_actions(
    state: tuple[float, ...], looking_ahead: bool
) -> None:
    system = late_drive(looking_ahead=looking_ahead)
    reached = np.array(state)
    for _ in range(3):
        reached = system.after(reached, np.zeros((1, 1)))[0]
    assert system.backup(np.array(state)) == pytest.approx([-5.0 * reached[1]])


@pytest.mark.parametrize(("away", "speed"), [(1.0, 1.0), (0.25, 0.5), (2.25, 1.5), (0.01, 0.1)])
def test_a_disc_allows_the_speed_that_a_brake_of_half_a_metre_per_second_squared_stops(
    away: float, speed: float
) -> None:
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
