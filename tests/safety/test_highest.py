"""The linear program behind the least-violation action, and that action against what scipy and fine grids know."""

from itertools import pairwise
from math import inf, nan
from typing import Any

import numpy as np
import pytest
import quadprog
from numpy.typing import NDArray
from scipy.optimize import linprog
from tests.safety.aims import Case, Counted

from safedpa.safety.solver.candidates import STEP_SHARES, action_grid, grid_around
from safedpa.safety.solver.least_violation import TOLERANCE
from safedpa.safety.solver.maximin_lp import MaxMinProgram, solve_by_dual_simplex

Values = NDArray[np.float64]


def reference(slopes: Values, heights: Values, levels: Values) -> float | None:
    """The largest attainable t; None where the levels cannot be held."""
    free = np.isnan(levels)
    actions = slopes.shape[1]
    A = np.hstack([-slopes, np.where(free, 1.0, 0.0)[:, np.newaxis]])
    b = heights - np.where(free, 0.0, levels)
    bounds = [*[(0.0, 1.0)] * actions, (None, None)]
    found = linprog([*[0.0] * actions, -1.0], A_ub=A, b_ub=b, bounds=bounds)
    return None if found.status != 0 else float(found.x[-1])


def least(slopes: Values, heights: Values, levels: Values, u: Values) -> float:
    return float((heights + slopes @ u)[np.isnan(levels)].min())


@pytest.mark.long
@pytest.mark.parametrize("actions", [1, 2, 3, 4])
def test_the_least_is_as_high_as_scipy_can_make_it(actions: int) -> None:
    random, program, held = np.random.default_rng(actions), MaxMinProgram(actions), 0
    for _ in range(200):
        slopes, heights, levels = drawn(random, actions)
        found = program.solve(slopes, heights, levels)
        assert found is not None
        u = np.array(found)
        assert (u >= 0.0).all()
        assert (u <= 1.0).all()
        best = reference(slopes, heights, levels)
        assert best is not None
        assert least(slopes, heights, levels, u) == pytest.approx(best, abs=1e-7)
        held += int((~np.isnan(levels)).sum())
        assert ((heights + slopes @ u >= levels - 1e-7) | np.isnan(levels)).all()
    assert held > 100


def test_levels_that_no_action_holds_have_no_answer() -> None:
    program = MaxMinProgram(1)
    assert program.solve(np.array([[1.0], [1.0]]), np.zeros(2), np.array([np.nan, 1.5])) is None
    assert program.solve(np.array([[1.0], [-1.0]]), np.zeros(2), np.array([0.75, -0.25])) is None
    found = program.solve(np.array([[1.0], [-1.0], [1.0]]), np.zeros(3), np.array([0.25, -0.75, np.nan]))
    assert found == pytest.approx([0.75], abs=1e-7)


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_numbers_that_are_none_have_no_answer(number: float) -> None:
    program = MaxMinProgram(2)
    for place in range(2):
        slopes = np.array([[1.0, 0.5], [0.0, 1.0]])
        slopes[0, place] = number
        assert program.solve(slopes.tolist(), [0.0] * 2, [np.nan] * 2) is None


def test_of_several_optima_the_one_in_the_middle_is_taken_and_the_answer_is_its_callers_own() -> None:
    """The second action changes nothing: it is not thrown about."""
    found = MaxMinProgram(2).solve(np.array([[1.0, 0.0]]), np.zeros(1), np.full(1, np.nan))
    assert found == pytest.approx([1.0, 0.5], abs=1e-3)
    program = MaxMinProgram(1)
    first = program.solve(np.array([[1.0]]), np.zeros(1), np.full(1, np.nan))
    assert first is not None
    program.solve(np.array([[-1.0]]), np.zeros(1), np.full(1, np.nan))
    assert first == pytest.approx([1.0], abs=1e-7)


def drawn(random: np.random.Generator, actions: int) -> tuple[Values, Values, Values]:
    """Slopes, heights and levels that some action holds; at least the first row is free."""
    rows = int(random.integers(1, 20))
    slopes, heights = random.normal(size=(rows, actions)), random.normal(size=rows)
    inside = heights + slopes @ random.uniform(0.0, 1.0, actions)
    some = random.random(rows) < 0.4
    some[0] = False
    return slopes, heights, np.where(some, inside - random.uniform(0.0, 0.2, rows), nan)


@pytest.mark.long
@pytest.mark.parametrize("actions", [1, 2, 3, 4])
def test_it_is_as_high_as_scipy_can_make_it_and_nearly_always_answers(actions: int) -> None:
    random, silent = np.random.default_rng(actions), 0
    for _ in range(400):
        slopes, heights, levels = drawn(random, actions)
        found = solve_by_dual_simplex(slopes.tolist(), heights.tolist(), levels.tolist())
        if found is None:
            silent += 1
            continue
        u, best = np.array(found), reference(slopes, heights, levels)
        assert best is not None
        assert (u >= 0.0).all()
        assert (u <= 1.0).all()
        assert least(slopes, heights, levels, u) == pytest.approx(best, abs=1e-9)
        assert ((heights + slopes @ u >= levels - 1e-10) | np.isnan(levels)).all()
    assert silent <= 2


def test_a_single_row_leads_to_its_bounds_two_that_pull_apart_meet_and_a_level_holds_a_row() -> None:
    assert solve_by_dual_simplex([[1.0, -0.5]], [0.0], [nan]) == [1.0, 0.0]
    assert solve_by_dual_simplex([[-1.0]], [3.0], [nan]) == [0.0]
    assert solve_by_dual_simplex([[1.0], [-1.0]], [0.0, 0.5], [nan, nan]) == pytest.approx([0.25], abs=1e-12)
    assert solve_by_dual_simplex([[1.0], [-3.0]], [0.0, 1.0], [nan, nan]) == pytest.approx([0.25], abs=1e-12)
    # Alone the first would go to 1; the second one falls below -0.4 there.
    assert solve_by_dual_simplex([[1.0], [-1.0]], [0.0, 0.0], [nan, -0.4]) == pytest.approx([0.4], abs=1e-12)
    assert solve_by_dual_simplex([[1.0], [-1.0]], [0.0, 0.0], [nan, -2.0]) == [1.0]


def test_heights_of_any_size_are_compared_to_their_own_rounding() -> None:
    found = solve_by_dual_simplex([[1.0, 0.2], [-1.0, 0.1]], [1e6, 1e6 + 0.5], [nan, nan])
    assert found == pytest.approx([0.2, 1.0], abs=1e-9)
    assert solve_by_dual_simplex([[1.0], [1.0]], [0.0, 1e12], [nan, nan]) == [1.0]


@pytest.mark.parametrize(
    ("slopes", "offsets", "middle"),
    [
        ([[1.0, 0.0]], [0.0], [1.0, 0.5]), ([[0.0, 0.0]], [0.0], [0.5, 0.5]), ([[0.0]], [0.0], [0.5]),
        ([[1.0, 1.0], [-1.0, -1.0]], [0.0, 1.0], [0.25, 0.25]), ([[1.0, 6e-10]], [0.0], [1.0, 1.0]),
    ],
)  # fmt: skip
def test_of_several_optima_the_one_nearest_to_the_middle_is_taken(
    slopes: list[list[float]], offsets: list[float], middle: list[float]
) -> None:
    assert solve_by_dual_simplex(slopes, offsets, [nan] * len(offsets)) == pytest.approx(middle, abs=1e-9)


@pytest.mark.parametrize(
    ("slopes", "levels"),
    [
        ([[1.0], [1.0]], [nan, 1.5]), ([[1.0], [-1.0]], [0.75, -0.25]), ([[1.0], [1.0], [-1.0]], [nan, 0.75, -0.25]),
        ([[1.0]], [0.5]), ([[1.0], [0.0]], [nan, 0.5]),
    ],
)  # fmt: skip
def test_no_answer_where_levels_cannot_be_held_or_no_row_is_free(slopes: list[list[float]], levels: list[float]):
    assert solve_by_dual_simplex(slopes, [0.0] * len(slopes), levels) is None


@pytest.mark.parametrize("number", [nan, inf, -inf])
def test_numbers_that_are_none_have_no_vertex(number: float) -> None:
    for place in range(2):
        slopes = [[1.0, 0.5], [0.0, 1.0]]
        slopes[0][place] = number
        assert solve_by_dual_simplex(slopes, [0.0, 0.0], [nan, nan]) is None
    assert solve_by_dual_simplex([[1.0, 0.5]], [number], [nan]) is None
    assert solve_by_dual_simplex([[1.0, 0.5], [1.0, 1.0]], [0.0, number], [nan, 0.1]) is None


def test_a_level_without_end_is_no_number_and_there_are_as_many_heights_and_levels_as_rows() -> None:
    assert solve_by_dual_simplex([[1.0], [1.0]], [0.0, 0.0], [nan, -inf]) is None
    assert solve_by_dual_simplex([[1.0], [1.0]], [0.0, 0.0], [nan, inf]) is None
    for heights, levels in (([0.0, 0.0], [nan]), ([0.0], [nan, nan]), ([], [nan])):
        with pytest.raises(ValueError, match=f"1 rows, {len(heights)} offsets and {len(levels)} levels"):
            solve_by_dual_simplex([[1.0]], heights, levels)
    assert solve_by_dual_simplex([], [], []) is None


SIDE = (-1.0, 2.0, 3.0)


@pytest.mark.parametrize(("actions", "points"), [(1, 9), (2, 5), (3, 3), (4, 2)])
def test_evenly_spread_with_all_corners(actions: int, points: int) -> None:
    found = action_grid((SIDE,) * actions, affine=False)
    assert len(found) == len(set(found)) == points**actions
    for entry in range(actions):
        values = sorted({action[entry] for action in found})
        np.testing.assert_allclose(values, np.linspace(-1.0, 2.0, points), atol=1e-15)
        assert (values[0], values[-1]) == (-1.0, 2.0)  # bit for bit: within the bounds


@pytest.mark.parametrize("actions", [1, 2, 3, 4])
def test_of_an_affine_model_the_corners_alone(actions: int) -> None:
    found = action_grid((SIDE,) * actions, affine=True)
    assert len(found) == 2**actions
    assert {value for action in found for value in action} == {-1.0, 2.0}


@pytest.mark.parametrize("affine", [False, True])
def test_of_many_actions_none(affine: bool) -> None:
    assert action_grid((SIDE,) * 5, affine=affine) == []


def test_the_highest_value_is_the_bound_itself() -> None:
    """0.1 + 0.2 * 3 / 3 would be beyond 0.3."""
    assert max(action_grid(((0.1, 0.3, 0.2),), affine=False)) == (0.3,)
    assert action_grid(((0.1, 0.3, 0.2), (0.0, 1.0, 1.0)), affine=True) == [
        (0.1, 0.0),
        (0.1, 1.0),
        (0.3, 0.0),
        (0.3, 1.0),
    ]


def test_what_lies_around_an_action_is_one_entry_moved_within_the_bounds_nearer_and_nearer() -> None:
    sides = ((0.0, 10.0, 10.0), (-1.0, 1.0, 2.0))
    assert grid_around(sides, (5.0, 0.0), 0.25) == [(2.5, 0.0), (7.5, 0.0), (5.0, -0.5), (5.0, 0.5)]
    assert grid_around(sides, (0.0, 0.75), 0.25) == [(2.5, 0.75), (0.0, 0.25), (0.0, 1.0)], (
        "no step that a bound forbids"
    )
    assert grid_around(sides, (0.0, 1.0), 0.0) == []
    sides = (SIDE,) * 3
    for other in grid_around(sides, (0.1, 0.2, 0.3), 0.1):
        assert sum(one != kept for one, kept in zip(other, (0.1, 0.2, 0.3), strict=True)) == 1
    # From a quarter of the range, between the points of the lattice, down to what is as good as the same.
    assert tuple(sorted(STEP_SHARES, reverse=True)) == STEP_SHARES
    assert 0.2 < STEP_SHARES[0] <= 0.25
    assert 0.005 < STEP_SHARES[-1] < 0.01
    assert all(0.3 < less / more < 0.6 for more, less in pairwise(STEP_SHARES))


class Affine:
    """h = base + slopes a, of one to three actions within -1 and 1."""

    def __init__(self, seed: int) -> None:
        random = np.random.default_rng(seed)
        actions, rows = int(random.integers(1, 4)), int(random.integers(2, 6))
        self.slopes = random.normal(size=(rows, actions))
        self.base, self.now = random.normal(-0.7, 0.8, rows), random.normal(-0.3, 0.8, rows)
        self.now[0] = -abs(self.now[0])
        self.nominal, self.eta = random.uniform(-1.0, 1.0, actions), float(random.uniform(0.05, 1.0))
        self.rhs = (1.0 - self.eta) * self.now
        self.reach = 2.0 * np.abs(self.slopes).sum(axis=1)
        self.scale = np.maximum(np.abs(self.now), self.reach)
        self.found = np.array(Case(self.after, self.now.tolist(), self.nominal.tolist(), eta=self.eta).run().action)

    def after(self, action: Values) -> Values:
        return np.asarray(self.base + self.slopes @ action)

    def highest(self, over: Values, levels: Values) -> float:
        """The largest attainable least h_i / scale_i over some rows, while others keep their levels (NaN: none)."""
        rows, actions = self.slopes.shape
        slopes, base = self.slopes / self.scale[:, np.newaxis], self.base / self.scale
        kept = ~np.isnan(levels)
        A = np.vstack([np.hstack([-slopes, np.ones((rows, 1))])[over], np.hstack([-slopes, np.zeros((rows, 1))])[kept]])
        b = np.concatenate([base[over], (base - levels)[kept]])
        bounds = [*[(-1.0, 1.0)] * actions, (None, None)]
        found = linprog([*[0.0] * actions, -1.0], A_ub=A, b_ub=b, bounds=bounds)
        assert found.status == 0
        return float(found.x[-1])

    def nearest(self, floors: Values) -> Values:
        """The action nearest to the nominal action with h >= floors."""
        eye = np.eye(len(self.nominal))
        C, d = np.vstack([self.slopes, eye, -eye]), [*(floors - self.base), *[-1.0] * (2 * len(eye))]
        return np.asarray(quadprog.solve_qp(2.0 * eye, 2.0 * self.nominal, C.T, np.array(d))[0])


@pytest.mark.parametrize("seed", range(100, 140))
def test_aim_by_aim_scipy_finds_nothing_better(seed: int) -> None:
    problem = Affine(seed)
    heights, given = problem.after(problem.found) / problem.scale, TOLERANCE * problem.reach / problem.scale
    rows, required = np.arange(len(heights)), problem.rhs / problem.scale
    first = problem.highest(rows >= 0, np.full(len(rows), np.nan))
    assert heights.min() >= first - given.max()
    held = min(first, float((problem.now / problem.scale).min()))  # what the robot has now is not given away
    slack = np.maximum(first - 0.4 * given, held - 1e-9)
    alone = [problem.highest(rows == row, np.where(rows == row, np.nan, slack)) for row in rows]
    free = np.array(alone) > first + 0.05
    if free.any():
        second = problem.highest(free, np.where(free, np.nan, slack))
        assert (heights >= np.minimum(required, second) - 2.0 * TOLERANCE)[free].all()
    floors = np.minimum(heights, np.maximum(required, heights.min())) - 1e-7
    np.testing.assert_allclose(problem.found, problem.nearest(floors * problem.scale), atol=3e-3)


def bent(seed: int) -> Any:
    """Two parabolas with tops of their own, and a line."""
    random = np.random.default_rng(seed)
    tops, steep = random.uniform(-0.9, 0.9, (2, 2)), random.uniform(0.3, 2.0, 2)
    line = random.normal(size=2)

    def h(a: Values) -> list[float]:
        away = ((a - tops) ** 2).sum(axis=1)
        return [*(-0.5 - steep * away).tolist(), float(line @ a) - 1.0]

    return h


def test_of_what_bends_a_fine_grid_knows_little_better() -> None:
    line, short = np.linspace(-1.0, 1.0, 41), []
    for seed in range(40):
        h, nominal = bent(seed), np.random.default_rng(1000 + seed).uniform(-1.0, 1.0, 2)
        found = np.array(Case(h, [-1.0, -1.0, -1.0], nominal.tolist(), affine=False).run().h_next)
        values = np.array([h(np.array([x, y])) for x in line for y in line])
        scale = np.maximum(1.0, values.max(axis=0) - values.min(axis=0))
        short.append((values / scale).min(axis=1).max() - (found / scale).min())
    assert np.median(short) <= TOLERANCE
    assert np.quantile(short, 0.9) <= 0.012
    assert max(short) <= 0.04


@pytest.mark.parametrize("top", [-0.6, 0.1, 0.5])
@pytest.mark.parametrize("nominal", [-1.0, 0.0, 0.9])
def test_the_top_of_a_parabola_is_found_within_what_may_be_given_away(top: float, nominal: float) -> None:
    found = Case(lambda a: [-1.0 - (a[0] - top) ** 2], [-1.0], [nominal]).run()
    assert found.h_next[0] >= -1.0 - TOLERANCE * (1.0 + abs(top)) ** 2


def test_the_robot_keeps_what_it_has_and_what_no_action_moves_counts_by_the_larger_of_is_and_was() -> None:
    """At the top already: given away once, it would be given away in every decision."""
    height = -2.0
    for _ in range(5):
        height = Case(lambda a: [a[0] - 3.0], [height], [-1.0]).run().h_next[0]
    assert height >= -2.0 - 1e-6
    # h_0 goes from 100 to -7: the others need no more than -0.07 of their scales, of 2 here.
    case = Case(lambda a: [-7.0, a[0] - 1.0], [100.0, -1.0], [-1.0], eta=0.0)
    assert case.run().action[0] == pytest.approx(1.0 - 0.07 * 2.0, abs=2.5 * TOLERANCE)


def test_of_what_is_above_zero_half_is_given_away_and_nothing_of_a_zero_missed_by_rounding() -> None:
    found = Case(lambda a: [a[0] - 0.999], [-3.0], [-1.0]).run()
    assert found.h_next[0] == pytest.approx(0.0005, rel=1e-3)
    known = Case(lambda a: [a[0] - 0.999], [-3.0], [-1.0]).run(
        [-1.0], [0.9985]
    )  # 0.0005 below 0, nearer to the nominal action
    assert known.h_next[0] >= 0.0
    found = Case(lambda a: [a[0] - 1.0 - 1e-8], [-3.0], [-1.0]).run()
    assert found.h_next[0] >= -2e-8


@pytest.mark.parametrize(("now", "required"), [(0.0, 0.0), (0.5, 0.5), (1e6, 1e6 + 1e-8)])
def test_what_is_kept_but_for_rounding_is_not_stuck(now: float, required: float) -> None:
    """h_0 is the same after any action."""
    case = Case(lambda a: [max(now, 0.25), a[0] - 3.0], [now, -3.0], [0.0], eta=1.0)
    case.conditions.rhs[0] = required
    case.run()
    assert case.stuck == ()


@pytest.mark.parametrize("now", [0.0, 0.5])
def test_where_all_is_well_now_what_keeps_all_wins_over_what_almost_does(now: float) -> None:
    """The second known action is nearer to the nominal action, and misses its condition by less than else may be given
    away."""
    case = Case(lambda a: [a[0] + 5.0, 3.0], [5.5, now], [0.0], eta=0.0)
    found = case.run([0.5], [0.4995])
    assert found.action == (0.5,)
    assert len(case.asked) == 2 + 2 + 1, "and is not looked for any more: two known, two corners, the backup"


@pytest.mark.parametrize("now", [0.0, 0.1])
def test_what_keeps_all_is_no_more_a_question_of_height(now: float) -> None:
    """h_1 stays at a two-hundredth of its scale: of h_0 no more than its condition counts, and 1.0 is no better."""
    case = Case(lambda a: [a[0], 0.5], [now, 100.0], [-0.5], eta=1.0, epsilon=0.5)
    assert case.run([0.5], [0.4995]).action == (0.5,)
    assert len(case.asked) == 2 + 2 + 1


def test_an_affine_question_is_answered_in_one_round_without_anything_between_known_answers() -> None:
    """Four corners, the nominal action, the backup, the highest and the nearest as high; one linear program for each
    level."""
    highest = Counted(MaxMinProgram(2))
    rows, now = [[1.0, 1.0, -3.0], [-2.0, -1.0, -4.0], [0.3, -2.0, -3.6]], [-3.0, -4.0, -3.5]
    case = Case(lambda a: [x * a[0] + y * a[1] + z for x, y, z in rows], now, [0.0, 0.0], highest=highest)
    case.run()
    assert len(case.asked) == 4 + 1 + 1 + 2
    assert highest.solved == 1
    # As near to the nominal action as what may be given away allows: what the programs propose is predicted, and no
    # better.
    case = Case(lambda a: [a[0] - 3.0], [-3.0], [-1.0])
    assert case.run([-1.0], [0.9962]).action == (0.9962,)
    assert len(case.asked) == 2 + 2 + 1 + 2


def test_rows_that_keep_their_conditions_need_no_level_and_a_flat_one_is_the_least_all_the_same() -> None:
    """h_0 is raised; h_1 and h_2 keep theirs at once: one linear program."""
    highest = Counted(MaxMinProgram(2))
    case = Case(lambda a: [a[0] - 5.0, a[1] + 3.0, 4.0 - a[1]], [-5.0, 1.0, 1.0], [0.0, 0.0], highest=highest)
    case.run()
    assert highest.solved == 1
    # h_0 is the least, at its top and flat about it: h_1 needs no more than its condition, a_1 = -0.5.
    found = Case(lambda a: [-3.0 + min(0.0, 0.5 - a[0]), a[1] - 2.0], [-3.0, -2.5], [0.0, -1.0], eta=0.0).run()
    assert found.action == pytest.approx((0.0, -0.5), abs=1e-6)
