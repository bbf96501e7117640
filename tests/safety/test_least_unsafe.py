"""The least-violation action, aim by aim: the highest, then the conditions, then the nominal action."""

from itertools import product
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.safety.aims import Case

from safedpa.safety import QuadraticProgram
from safedpa.safety.solver.least_violation import TOLERANCE
from safedpa.safety.solver.maximin_lp import MaxMinProgram
from safedpa.safety.solver.sqp import DecisionError

Values = NDArray[np.float64]


class Mute:
    def solve(self, *_: Any) -> None:
        return None


@pytest.mark.parametrize("far", [10.0, 1e3, 1e6])
def test_what_is_given_away_is_a_share_of_what_actions_can_change(far: float) -> None:
    """However far below 0 it is: all that can be done is done."""
    found = Case(lambda a: [a[0] - far], [-far], [-1.0]).run()
    assert found.action[0] >= 1.0 - 2.1 * TOLERANCE


@pytest.mark.parametrize("actions", [3, 5])
def test_few_candidates_do_not_show_what_many_actions_can_change(actions: int) -> None:
    """Of five actions no corners are tried: what a handful of outcomes have in common is not beyond their reach."""
    rest = [0.0] * (actions - 1)
    known = [[-1.0, share, *rest[1:]] for share in np.linspace(-1.0, 1.0, 12)]
    case = Case(lambda a: [a[0] - 3.0, a[1] + 3.0], [-3.0, 3.0], [-1.0, *rest])
    found = case.run(*known)
    assert case.stuck == ()
    assert found.action[0] == pytest.approx(1.0, abs=2.5 * TOLERANCE)


@pytest.mark.parametrize(("actions", "known"), [(1, [[1.0], [0.95]]), (3, [[1.0, 0.0, 0.0]])])
def test_for_an_actuator_that_saturates_the_corners_count_and_not_the_gradient(actions: int, known: list[list[float]]):
    """What the actions change is 0.1, though the slope at the best of them promises 2: of that little is given away."""
    rest = [0.0] * (actions - 1)
    case = Case(lambda a: [max(a[0] - 0.9, 0.0) - 3.0], [-3.0], [-1.0, *rest], backup=[1.0, *rest])
    assert case.run(*known).action[0] == pytest.approx(1.0 - 0.05 * TOLERANCE, abs=1e-5)


def test_a_little_height_is_given_away_for_the_nominal_action_but_not_from_just_zero_or_to_below_it() -> None:
    """The programs give away half of what the comparison allows for: rounding refuses nothing."""
    found = Case(lambda a: [a[0] - 3.0], [-3.0], [-1.0]).run()
    assert found.action[0] == pytest.approx(1.0 - TOLERANCE, abs=1e-6)
    plenty = Case(lambda a: [a[0] + 1.0], [-3.0], [-1.0]).run()
    assert plenty.h_next[0] == pytest.approx(2.0 - TOLERANCE, abs=1e-6)
    found = Case(lambda a: [a[0] - 1.0, 0.5], [3.0, 1.0], [-1.0]).run()
    assert found.action[0] == pytest.approx(1.0, abs=1e-6)


def test_after_the_least_share_the_next_least_is_raised_and_then_the_third() -> None:
    """h_0 is worth a hundredth: -0.5 of 1 and -50 of 100 are alike, and 0 lies between them."""
    found = Case(lambda a: [a[0] - 0.5, 100.0 * (-a[0] - 0.5)], [-1.0, -100.0], [0.9]).run()
    assert found.action[0] == pytest.approx(0.0, abs=0.01)
    # h_0 moves with the first action alone, h_1 with the second: both go up, though h_0 is the least.
    found = Case(lambda a: [a[0] - 5.0, a[1] - 3.0], [-5.0, -3.0], [-1.0, -1.0]).run()
    assert found.action == pytest.approx((1.0, 1.0), abs=0.02)
    heights = [5.0, 3.0, 1.5]
    found = Case(lambda a: [a[row] - heights[row] for row in range(3)], [-h for h in heights], [-1.0] * 3).run()
    assert found.action == pytest.approx((1.0, 1.0, 1.0), abs=0.02)


def test_the_next_ones_are_raised_to_their_conditions_and_no_higher() -> None:
    """h_1 asks for -0.2 of the second action; from there on the nominal action decides."""
    for asked in (-0.2, 0.5):
        found = Case(lambda a: [a[0] - 5.0, a[1] + 3.0], [-5.0, 3.0 + asked], [-1.0, -1.0], eta=0.0).run()
        assert found.action == pytest.approx((1.0, asked), abs=0.02)
        kept = Case(lambda a: [a[0] - 5.0, a[1] + 3.0], [-5.0, 3.0 + asked], [-1.0, 0.8], eta=0.0).run()
        assert kept.action == pytest.approx((1.0, 0.8), abs=0.02)


def test_a_condition_below_the_least_of_all_lowers_it_no_further() -> None:
    """h_1 asks for -3 of its 4 only, -0.75; but the least of all is -2 of 3, and is not given away for the nominal
    action."""
    found = Case(lambda a: [a[0] - 3.0, 2.0 * a[1] - 2.0], [-3.0, -3.0], [-1.0, -1.0], eta=0.0).run()
    assert found.action == pytest.approx((1.0, -1.0 / 3.0), abs=0.02)
    both = Case(
        lambda a: [a[0] - 3.0, -a[0] + 3.0 * a[1] - 2.0, a[1] + 9.0], [-3.0, -7.0, 9.5], [-1.0, -1.0], eta=0.0
    ).run()
    assert both.action == pytest.approx((1.0, 0.5), abs=0.02)


def test_a_row_that_no_action_moves_holds_nothing_up_and_where_none_moves_the_nominal_action_is_left() -> None:
    """h_0 is the least and stays it; h_1 is brought to its condition, the second action stays as requested."""
    found = Case(lambda a: [-7.0, a[0] - 0.5], [-7.0, 0.1], [-1.0, 0.25], eta=0.0).run()
    assert found.action == pytest.approx((0.6, 0.25), abs=0.02)
    case = Case(lambda a: [-7.0], [-7.0], [0.3])
    assert case.run([0.3], [0.1]).action == (0.3,)
    assert case.run([0.1], [0.3]).action == (0.3,)


def test_of_what_is_known_the_best_is_never_lost() -> None:
    """Programs that give up: of what is known and the corners the highest is taken, then what is nearest the nominal
    action."""

    def bump(a: Values) -> list[float]:
        return [0.5 - abs(a[0] - 0.2) - 0.1 * a[1]]

    case = Case(bump, [-1.0], [0.0, 0.0], highest=Mute())
    one, other = case.run([0.0, 0.0], [0.2, -0.5]), case.run([0.2, -0.5], [0.0, 0.0])
    assert one.action == other.action
    assert one.action[0] == pytest.approx(0.2)
    assert one.h_next[0] >= 0.59, "and what one entry alone brings on top"
    corners = Case(lambda a: [a[0] - a[1] - 3.0], [-1.0], [0.0, 0.0], highest=Mute())
    assert corners.run([0.0, 0.0]).action == (1.0, -1.0)


def test_of_equally_high_ones_what_breaks_conditions_less_comes_before_the_nominal_action() -> None:
    """h_0 stays the least; h_1 misses its condition by more at the one that is nearer to the nominal action."""

    case = Case(lambda a: [-7.0, a[0]], [-7.0, 2.0], [-0.5], eta=0.0, highest=Mute())
    assert case.run([-0.5], [0.5]).action == (1.0,)
    kept = Case(lambda a: [-7.0, a[0]], [-7.0, 0.25], [-0.5], eta=0.0, highest=Mute())
    found = kept.run([-0.5], [0.3])
    assert found.is_feasible is False
    assert found.residual[1] >= 0.0
    assert found.action[0] <= 0.3, "and nearer to the nominal action by itself, as far as the condition allows"


def test_a_nearest_program_that_gives_up_leaves_the_highest() -> None:
    class GivesUp:
        def __init__(self) -> None:
            self.own: Any = QuadraticProgram(np.full(1, -1.0), np.full(1, 1.0), np.ones(1))
            self.low, self.range, self.sides = self.own.low, self.own.range, self.own.sides
            self.distance = self.own.distance

        def solve(self, *_: Any) -> Any:
            return type("Unsolved", (), {"solved": False, "action": (np.nan,)})()

    found = Case(lambda a: [a[0] - 3.0], [-3.0], [-1.0], program=GivesUp()).run()
    assert found.action[0] == pytest.approx(1.0, abs=1e-6)


def test_what_bends_is_followed_to_its_top_in_the_plane() -> None:
    """A tangent anywhere else leads past it: the programs are posed again, steps on the way are tried."""
    random = np.random.default_rng(0)
    for _ in range(20):
        top, nominal = random.uniform(-0.8, 0.8, (2, 2))
        found = Case(lambda a, top=top: [-1.0 - ((a - top) ** 2).sum()], [-1.0], nominal.tolist()).run()  # type: ignore[misc]
        assert found.h_next[0] >= -1.0 - 0.15


def test_corners_are_tried_where_a_tangent_is_blind_and_programs_posed_from_the_best() -> None:
    """Flat from -0.9 to 0.5, steep beyond: no gradient at the nominal action shows it."""
    found = Case(lambda a: [max(0.0, a[0] - 0.5) - 3.0], [-3.0], [0.0]).run()
    assert found.h_next[0] >= -2.5 - 0.01
    # The corner is a foothold; between it and the top the tangent leads on to the nominal action.
    found = Case(lambda a: [max(0.0, a[0] - 0.5) - 3.0, 2.0 - a[1]], [-3.0, 1.5], [0.0, 0.0]).run()
    assert found.h_next[0] >= -2.5 - 0.01
    assert found.action[1] == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize(("actions", "corners"), [(1, 2), (2, 4), (3, 8), (4, 16), (5, 0)])
def test_corners_are_tried_up_to_four_actions(actions: int, corners: int) -> None:
    case = Case(lambda a: [a.sum() - 9.0], [-9.0], [0.0] * actions)
    found = case.run()
    assert found.action == pytest.approx((1.0,) * actions, abs=0.02 * actions)
    every = set(product((-1.0, 1.0), repeat=actions))
    assert len(every & set(case.asked)) == corners or (corners == 0 and len(every & set(case.asked)) <= 1)


def test_where_one_action_alone_has_numbers_the_search_begins_there() -> None:
    """Five actions, so that no corners are tried; of the nominal action the model knows nothing."""
    case = Case(
        lambda a: [np.nan if a[0] == 0.7 else a.sum() - 9.0], [-9.0], [0.7] + [0.0] * 4, affine=False, backup=[0.0] * 5
    )
    found = case.run()
    assert found.is_finite
    assert found.action == pytest.approx((1.0,) * 5, abs=0.02)


@pytest.mark.parametrize("limit", [1.0, 100.0])
def test_without_corners_what_actions_can_change_is_what_the_tangent_says_over_their_range(limit: float) -> None:
    """h = sum of a / limit - 9 changes by 10 over the range of five actions; a thousandth of that is given away."""
    found = Case(lambda a: [a.sum() / limit - 9.0], [-9.0], [0.0] * 5, limit=limit).run()
    assert 5.0 - sum(found.action) / limit == pytest.approx(0.5 * TOLERANCE * 10.0, rel=1e-3)


@pytest.mark.parametrize("affine", [True, False])
def test_nothing_is_asked_of_an_action_beyond_the_bounds(affine: bool) -> None:
    random = np.random.default_rng(2)
    for _ in range(20):
        top, nominal = random.uniform(-1.2, 1.2, (2, 2))
        steep = float(random.uniform(0.5, 8.0))
        case = Case(
            lambda a, top=top, steep=steep: [-1.0 - steep * ((a - top) ** 2).sum(), np.exp(steep * a[0]) - 2.0],  # type: ignore[misc]
            [-1.0, 0.5],
            np.clip(nominal, -1.0, 1.0).tolist(),
            affine=affine,
        )
        case.run()
        assert max(max(abs(entry) for entry in action) for action in case.asked) <= 1.0


def test_a_program_that_gives_up_at_the_second_aim_leaves_what_the_first_one_found() -> None:
    """Five actions, so that no corners are tried: what one entry alone brings ends a twentieth short of it."""

    class Once:
        def __init__(self) -> None:
            self.own, self.asked = MaxMinProgram(5), 0

        def solve(self, *rows: Any) -> Any:
            self.asked += 1
            return self.own.solve(*rows) if self.asked % 2 else None

    found = Case(lambda a: [a[0] - 5.0, a[1] - 3.0], [-5.0, -3.0], [0.0] * 5, highest=Once()).run()
    assert found.action[0] == pytest.approx(1.0, abs=0.01)


def test_never_below_zero_where_all_can_be_kept_above() -> None:
    """Two h that pull against each other, by the millionth: both are 1e-4 at best, of scales of 2."""
    random = np.random.default_rng(1)
    for _ in range(50):
        slope, room = random.uniform(0.5, 5.0), 10.0 ** random.uniform(-4.0, -1.0)
        nominal = random.uniform(-1.0, 1.0, 2)
        found = Case(
            lambda a, slope=slope, room=room: [a[0] + room, room - slope * a[0]],  # type: ignore[misc]
            [1.0, 1.0],
            nominal.tolist(),
            eta=0.1,
        ).run()
        assert min(found.h_next) >= 0.0
        assert found.action[1] == pytest.approx(nominal[1], abs=1e-3)


def test_what_no_action_moves_within_one_step_brings_the_backup_unless_it_is_well() -> None:
    """h_0 is below 0 and does not depend on the action yet; h_1 is free, h_2 asks for a_1 >= 0.25."""
    case = Case(lambda a: [-7.0, a[0] + 9.0, a[1] + 1.0], [-7.0, 1.0, 1.25], [-1.0, -1.0], eta=0.0, backup=[0.5, -0.5])
    found = case.run()
    assert case.stuck == ("h0",)
    assert found.action == pytest.approx((0.5, 0.25), abs=0.02)
    case = Case(lambda a: [3.0, a[0] - 3.0], [3.0, -3.0], [0.0, 0.7], backup=[0.5, -0.5])
    assert case.run().action == pytest.approx((1.0, 0.7), abs=0.02)
    assert case.stuck == ()


@pytest.mark.parametrize(("now", "required", "stuck"), [(1.0, 1.0, ()), (1.0, 1.5, ("h0",)), (-1.0, 0.0, ("h0",))])
def test_stuck_is_what_is_below_zero_or_not_kept(now: float, required: float, stuck: tuple[str, ...]) -> None:
    """h_0 is 1 after any action."""
    case = Case(lambda a: [1.0, a[0] - 3.0], [now, -3.0], [0.0], eta=1.0 if required < 1.0 else 0.0)
    case.conditions.rhs[0] = required
    case.run()
    assert case.stuck == stuck


def test_actions_without_a_finite_prediction_are_left_out_and_without_any_there_is_no_decision() -> None:
    """h is a number for actions below 0.5 alone: of these the highest that is found."""
    case = Case(lambda a: [a[0] - 3.0 if a[0] < 0.5 else np.nan], [-3.0], [-1.0], affine=False)
    found = case.run()
    assert found.is_finite
    assert 0.0 <= found.action[0] < 0.5
    with pytest.raises(DecisionError, match="no finite number for any action"):
        Case(lambda a: [np.nan], [-3.0], [-1.0]).run()
