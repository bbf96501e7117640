"""What the attacks are made of: problems put differently, peers' problems, small systems, two threads."""

from __future__ import annotations

from collections import Counter
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.adversary.test_rows_by_hand import figures
from tests.adversary.test_verdicts_by_hand import plane

from safedpa.safety import Status
from safedpa_lab.experiments.adversary import bad_inputs, scales
from safedpa_lab.experiments.adversary.line_systems import late_drive
from safedpa_lab.experiments.adversary.linear_problem import LinearProblem
from safedpa_lab.experiments.adversary.linear_shapes import SHAPES, random_problem
from safedpa_lab.experiments.adversary.looking_systems import disc_by_higher_order
from safedpa_lab.experiments.adversary.mirrors import MIRRORS
from safedpa_lab.experiments.adversary.peer_filters import _Parts
from safedpa_lab.experiments.adversary.peers import peer_problems
from safedpa_lab.experiments.adversary.standing import Standing


def single() -> LinearProblem:
    """x+ = x + a and h = x, both of one number."""
    changes = {
        "state": np.array([0.5]), "f": np.array([0.75]), "g": np.array([[1.0]]), "P": np.array([[1.0]]),
        "q": np.zeros(1), "low": -np.ones(1), "high": np.full(1, 2.0), "wish": np.array([0.25]), "weights": np.ones(1),
        "epsilon": np.zeros(1),
    }  # fmt: skip
    return LinearProblem(**vars(plane(0.0, 0.0)) | changes)


def uneven() -> LinearProblem:
    """Two actions of other ranges that move both of two states, and three rows."""
    changes = {
        "f": np.array([0.25, -0.5]), "g": np.array([[1.0, 0.5], [-0.25, 2.0]]), "low": np.array([-1.0, 0.0]),
        "high": np.array([2.0, 0.5]), "P": np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 2.0]]),
        "q": np.array([0.1, 0.2, 0.3]), "epsilon": np.zeros(3),
    }  # fmt: skip
    return LinearProblem(**vars(plane(0.5, -0.25, wish=(0.75, 0.125), weights=(1.0, 3.0))) | changes)


@pytest.mark.parametrize("name", list(MIRRORS))
@pytest.mark.parametrize("problem", [single(), uneven()], ids=["one action", "two actions"])
def test_a_problem_that_is_put_differently_says_the_same_of_the_same_actions(name: str, problem: LinearProblem) -> None:
    """Every h after an action is that of the action as it was; a row that was added is 1 whatever is done."""
    random = np.random.default_rng(3)
    other, back = MIRRORS[name](problem, random)
    np.testing.assert_allclose(back(other.wish), problem.wish, atol=1e-9)
    for share in random.uniform(0.0, 1.0, (4, len(other.low))):
        action = other.low + share * (other.high - other.low)
        assert (back(action) >= problem.low - 1e-9).all()
        assert (back(action) <= problem.high + 1e-9).all()
        told = other.heights(other.after(action))
        own = problem.heights(problem.after(back(action)))
        assert all(np.abs(told - h).min() < 1e-9 for h in own)
        assert all(np.abs([*own, 1.0] - h).min() < 1e-9 for h in told)


@pytest.mark.parametrize(
    ("g", "turned"),
    [
        ([[1.0, 1.0], [0.0015, 0.0]], False),  # 2 beside 0.0015
        ([[1.0, 0.0], [0.0015, 0.0]], True),  # 1 beside 0.0015
        ([[0.5, 0.5], [0.00125, -0.00025]], True),  # 1 beside 0.0015
    ],
)
def test_states_of_mixed_units_are_not_turned(g: list[list[float]], turned: bool) -> None:
    """What all actions together change in each state tells its size: more than a thousandfold is another unit."""
    problem = LinearProblem(**vars(plane(0.0, 0.0)) | {"g": np.array(g)})
    other, _ = MIRRORS["states turned"](problem, np.random.default_rng(1))
    assert (other is not problem) is turned


@pytest.mark.parametrize("mixed", [False, True])
@pytest.mark.parametrize("count", [0, 1, 4])
def test_peers_get_as_many_problems_as_are_asked_for_all_of_one_shape(count: int, mixed: bool) -> None:
    found = peer_problems(1, count, mixed)
    assert len(found) == count
    assert len({(one.P.shape, one.g.shape, one.state.shape, one.wish.shape) for one in found}) == min(count, 1)


def test_the_parts_of_a_problem_lie_one_behind_the_other() -> None:
    """2 + 2 + 2 * 3 + 4 * 2 + 4 numbers."""
    problem = {
        "state": np.arange(2.0), "f": 10.0 + np.arange(2.0), "g": 20.0 + np.arange(6.0).reshape(2, 3),
        "P": 30.0 + np.arange(8.0).reshape(4, 2), "q": 40.0 + np.arange(4.0), "wish": np.zeros(3),
    }  # fmt: skip
    parts = _Parts(problem)
    assert (parts.states, parts.actions, parts.size) == (2, 3, 22)
    packed = parts.packed(problem)
    assert len(packed) == 22
    for name in ("state", "f", "g", "P", "q"):
        np.testing.assert_array_equal(parts(packed, name), problem[name])


def test_problems_of_the_violated_shape_are_below_zero_now() -> None:
    """Of every number of rows, one alone too; in some of them every row is."""
    place = list(SHAPES).index("violated")
    rows, below = [], []
    for number in range(60):
        problem = random_problem(1, place + len(SHAPES) * number)
        now = problem.heights(problem.state)
        rows.append(len(now))
        below.append(int((now < 0.0).sum()))
    assert min(below) >= 1
    assert {1, 12} <= set(rows)
    assert any(0 < some < all_ for some, all_ in zip(below, rows, strict=True))
    assert any(some == all_ > 1 for some, all_ in zip(below, rows, strict=True))


@pytest.mark.parametrize("looking_ahead", [False, True])
@pytest.mark.parametrize("state", [(0.0, 0.5, 0.25, -0.5, 0.75), (0.0, -0.1, 0.0, 0.0, 0.0), (1.0, 0.0, 1.0, 1.0, 1.0)])
def test_the_backup_of_a_late_drive_brakes_the_speed_that_is_on_its_way(
    state: tuple[float, ...], looking_ahead: bool
) -> None:
    """The speed once the three actions that are on their way have acted, times -5."""
    system = late_drive(looking_ahead=looking_ahead)
    reached = np.array(state)
    for _ in range(3):
        reached = system.after(reached, np.zeros((1, 1)))[0]
    assert system.backup(np.array(state)) == pytest.approx([-5.0 * reached[1]])


@pytest.mark.parametrize(("away", "speed"), [(1.0, 1.0), (0.25, 0.5), (2.25, 1.5), (0.01, 0.1)])
def test_the_disc_allows_the_speed_from_which_a_brake_of_half_a_metre_per_second_squared_stops(
    away: float, speed: float
) -> None:
    """v^2 / (2 * 0.5) = the way to the disc of 0.5 m: h is 0 at that speed, and as much above as it is slower."""
    system = disc_by_higher_order()
    for slower in (0.0, 0.05):
        h = system.heights(np.array([[0.5 + away, 0.0, -(speed - slower), 0.0]]))
        assert h.min() == pytest.approx(slower, abs=1e-9)


@pytest.mark.parametrize("small", [False, True])
def test_drives_that_look_for_stands_are_in_turn_in_lockstep_and_as_late_as_a_robot_tells(small: bool) -> None:
    pieces = Standing().pieces(3, small)
    cars = [one for one in pieces if one.driver != "point"]
    late = {load: [one.until_action for one in cars if one.load == load] for load in {one.load for one in cars}}
    assert set(map(len, late.values())) == {1 if small else 25}
    for own in late.values():
        assert own == [0.006 * (number % 2) for number in range(len(own))]
    assert len({(one.load, one.seed) for one in pieces}) == len(pieces)


def test_drives_in_other_units_whose_statuses_differ_are_counted() -> None:
    same = scales.Drive(("passed",), (0.0,), 0.5, 0.0)
    other = scales.Drive(("relaxed",), (0.0,), 0.5, 0.0)
    found = figures(scales._rows("h", [other, same, other, other], same))
    assert found["h: drives with other statuses"] == (3, 4)


def test_answers_of_two_threads_are_added_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twenty decisions each: of the first thread 3 + 2 are refused and 4 mixed up, of the second 0 + 1 and 3."""
    right = SimpleNamespace(status=Status.corrected, action=np.array([0.5]))
    told = SimpleNamespace(status=Status.fallback, action=np.array([0.5]))
    wrong = SimpleNamespace(status=Status.corrected, action=np.array([0.25]))
    other = SimpleNamespace(status=Status.passed, action=np.array([0.5]))
    lives: list[list[Any]] = [
        [right, *[None] * 3, *[told] * 2, *[wrong] * 4, *[right] * 11],
        [right, told, *[other] * 3, *[right] * 16],
    ]
    left: dict[int, Any] = {}

    def decide(_state: Any, *, wish: Any, barriers: Any) -> Any:
        del wish
        if id(barriers) not in left:
            left[id(barriers)] = iter(lives[len(left)])
        answer = next(left[id(barriers)])
        if answer is None:
            raise ValueError("refused")
        return answer

    monkeypatch.setattr(bad_inputs, "_safe", lambda: SimpleNamespace(decide=decide))
    assert bad_inputs.two_threads(20) == (7, 6, 40)
    assert Counter(len(list(rest)) for rest in left.values()) == {0: 2}
