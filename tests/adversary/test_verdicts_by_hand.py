"""What the attacks say of one answer, against small problems of two conditions whose truth is known by hand."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa_lab.experiments.adversary import campaign, mirrors, report, systems
from safedpa_lab.experiments.adversary.attack import Result, Row
from safedpa_lab.experiments.adversary.bad_values import vectors
from safedpa_lab.experiments.adversary.bends import _judged as bent
from safedpa_lab.experiments.adversary.car_judge import CarJudge
from safedpa_lab.experiments.adversary.linear_judge import LinearJudge
from safedpa_lab.experiments.adversary.linear_problem import LinearProblem
from safedpa_lab.experiments.adversary.linear_verdict import judged
from safedpa_lab.experiments.adversary.peers import _unsafe
from safedpa_lab.experiments.adversary.scales import _allowed


def plane(*state: float, wish: tuple[float, float] = (0.0, 0.0), weights: tuple[float, float] = (1.0, 1.0)) -> Any:
    """x+ = x + a and h = x, both of two numbers, a within -1 and 1, eta 0.5: a >= -x / 2."""
    return LinearProblem(
        shape="by hand", state=np.array(state), f=np.array(state), g=np.eye(2), P=np.eye(2), q=np.zeros(2),
        low=-np.ones(2), high=np.ones(2), wish=np.array(wish), weights=np.array(weights), eta=0.5, epsilon=np.zeros(2),
        gradient=True,
    )  # fmt: skip


def verdict(status: str, action: tuple[float, float], h_next: float = 0.0) -> Any:
    return SimpleNamespace(status=SimpleNamespace(value=status), action=np.array(action), h_next=h_next, reason="")


@pytest.mark.parametrize(
    ("action", "outside"),
    [((0.0, 0.0), False), ((1.0, -1.0), False), ((1.1, 0.0), True), ((0.0, 1.1), True), ((-1.1, 0.0), True),
     ((0.0, -1.1), True), ((1.1, 1.1), True), ((-1.1, -1.1), True)],
)  # fmt: skip
def test_an_action_is_out_of_bounds_where_any_of_its_numbers_is(action: tuple[float, float], outside: bool) -> None:
    assert judged(plane(1.0, 1.0), verdict("relaxed", action)).out_of_bounds is outside


@pytest.mark.parametrize(
    ("state", "status", "untold"),
    [
        ((1.0, 1.0), "passed", False), ((1.0, 1.0), "violated", True), ((-0.5, 1.0), "violated", False),
        ((-0.5, 1.0), "relaxed", True), ((1.0, -0.5), "relaxed", True), ((-0.5, -0.5), "fallback", True),
        ((-0.5, -0.5), "violated", False),
    ],
)  # fmt: skip
def test_what_is_below_now_has_to_be_told(state: tuple[float, float], status: str, untold: bool) -> None:
    assert judged(plane(*state), verdict(status, (0.5, 0.5))).untold is untold


@pytest.mark.parametrize(
    ("action", "h_next", "below", "broken"),
    [((0.0, 0.0), 0.5, False, 0.0), ((-0.5, -0.5), 0.5, False, 0.0), ((-0.6, 0.0), 0.4, False, 0.1),
     ((0.0, -0.7), 0.3, False, 0.2), ((0.0, 0.0), -0.1, True, 0.0), ((-1.0, 0.0), 0.0, False, 0.5)],
)  # fmt: skip
def test_a_condition_is_broken_by_a_share_of_its_scale(
    action: tuple[float, float], h_next: float, below: bool, broken: float
) -> None:
    """h is 1 now and the actions change it by 2, which is the scale."""
    found = judged(plane(1.0, 1.0), verdict("corrected", action, h_next))
    assert found.below is below
    assert found.broken == pytest.approx(broken / 2.0)


@pytest.mark.parametrize(("action", "shortfall"), [((1.0, 1.0), 0.0), ((-1.0, 1.0), 1.0), ((1.0, -1.0), 1.0)])
def test_a_relaxed_answer_falls_short_of_the_best_least_h(action: tuple[float, float], shortfall: float) -> None:
    """Of state (0.5, 0.5) the best is 1.5 in each, in scales of 2: 0.75; the worst is -0.5: -0.25."""
    found = judged(plane(0.5, 0.5), verdict("relaxed", action))
    assert found.missed
    assert found.shortfall == pytest.approx(shortfall)
    assert found.needless is (shortfall > 0.0)


@pytest.mark.parametrize(
    ("action", "weights", "distance"),
    [((0.6, 0.8), (1.0, 1.0), 0.5), ((0.6, 0.0), (1.0, 4.0), 0.15), ((0.0, 0.8), (1.0, 4.0), 0.4),
     ((0.6, 0.8), (4.0, 4.0), 0.5), ((1.0, 1.0), (1.0, 3.0), np.sqrt(1.0 / 3.0))],
)  # fmt: skip
def test_a_distance_is_counted_in_ranges_the_largest_weight_being_one(
    action: tuple[float, float], weights: tuple[float, float], distance: float
) -> None:
    assert LinearJudge(plane(1.0, 1.0, weights=weights)).distance(np.array(action)) == pytest.approx(distance)


@pytest.mark.parametrize("slope", [(1.0, 0.0), (1.0, -2.0), (3.0, 4.0)])
def test_a_scale_is_all_that_the_actions_can_change_together(slope: tuple[float, float]) -> None:
    """Each of two actions over a range of 2."""
    problem = plane(0.25, 0.0)
    problem = LinearProblem(**vars(problem) | {"P": np.array([slope]), "q": np.zeros(1), "epsilon": np.zeros(1)})
    assert LinearJudge(problem).scale.tolist() == [2.0 * sum(map(abs, slope))]


@pytest.mark.parametrize(
    ("moved", "rows"), [((True, True), [0, 1]), ((True, False), [0]), ((False, True), [1]), ((False, False), [0, 1])]
)
def test_rows_that_no_action_moves_count_only_where_there_is_no_other(
    moved: tuple[bool, bool], rows: list[int]
) -> None:
    problem = LinearProblem(**vars(plane(0.5, 0.25)) | {"g": np.diag([float(one) for one in moved])})
    judge = LinearJudge(problem)
    action = np.array([0.25, 0.5])
    heights = np.array([0.5, 0.25]) + action * moved
    assert judge.movable(action).tolist() == pytest.approx((heights / judge.scale)[rows].tolist())


@pytest.mark.parametrize(("state", "found"), [((-1.0, 0.5), False), ((1.0, 0.5), True), ((0.5, -0.5), True)])
def test_where_a_row_that_nothing_moves_is_broken_there_is_no_nearest_action(
    state: tuple[float, float], found: bool
) -> None:
    """The first row stays as it is: below 0 it would have to rise by half."""
    problem = LinearProblem(**vars(plane(*state, wish=(0.0, -1.0))) | {"g": np.diag([0.0, 1.0])})
    nearest = LinearJudge(problem).nearest()
    assert (nearest is not None) is found
    if nearest is not None:
        np.testing.assert_allclose(nearest.action, [0.0, -0.5 * state[1]], atol=1e-9)


@pytest.mark.parametrize(
    ("action", "unsafe"),
    [((0.0, 0.0), False), ((np.nan, 0.0), True), ((np.nan, np.inf), True), ((1.5, 0.0), True), ((1.0005, 0.0), False),
     ((-0.9, 0.0), True), ((0.0, -1.5), True), ((1.5, 1.5), True)],
)  # fmt: skip
def test_an_action_is_unsafe_where_any_number_or_condition_is(action: tuple[float, float], unsafe: bool) -> None:
    assert _unsafe(LinearJudge(plane(1.0, 1.0)), np.array(action)) is unsafe


class Bent:
    """Two conditions of one action within -1 and 1: h = 0.5 + a and 0.5 - a * side after it, 0.5 now."""

    shape, actions, eta, wish, units = "by hand", 1, 0.5, np.array([0.9]), (1.0, 1.0, 1.0)
    epsilon, state = np.zeros(2), np.zeros(1)

    def __init__(self, side: float, lift: float = 0.5) -> None:
        self._side, self._lift = side, lift

    def moved(self, actions: Any) -> Any:
        return np.asarray(actions)

    def h(self, states: Any) -> Any:
        return np.concatenate([self._lift + states, self._lift - self._side * states], axis=1)


@pytest.mark.parametrize(
    ("status", "lift", "action", "missed", "needless"),
    [
        ("relaxed", 0.5, 0.0, True, False), ("relaxed", 0.5, 0.9, True, True), ("fallback", 0.5, -0.9, True, True),
        ("violated", 0.5, 0.9, False, False), ("relaxed", -0.25, 0.9, True, False), ("fallback", 0.0, 0.0, True, False),
    ],
)  # fmt: skip
def test_against_a_grid_an_answer_is_needless_where_some_point_keeps_every_h_above_zero(
    status: str, lift: float, action: float, missed: bool, needless: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With lift 0.5 points from -0.25 to 0.25 keep both conditions; below 0 none keeps both h."""
    monkeypatch.setattr(
        "safedpa_lab.experiments.adversary.bends._far", lambda problem, actions: np.abs(actions - problem.wish)[:, 0]
    )
    problem: Any = Bent(1.0, lift)
    found = bent(problem, 7, status, np.array([action]))
    if lift > 0.0:
        assert (found.missed, found.needless) == (missed, needless)
    else:
        assert found.needless is needless
    assert found.number == 7


def tallied(status: str, action: float, wish: Any = 0.9, lift: float = 0.5) -> systems.Tally:
    """Of a system of one action within -1 and 1, h = 0.5 + a and 0.5 - a after it and 0.5 now, eta 0.5."""
    system: Any = SimpleNamespace(
        heights=lambda states, since=None: np.concatenate([lift + states, lift - states], axis=1),
        after=lambda _state, actions: np.asarray(actions), eta=0.5, low=(-1.0,), high=(1.0,),
    )  # fmt: skip
    tally, grid = systems.Tally(), np.linspace(-1.0, 1.0, 41)[:, None]
    said: Any = SimpleNamespace(status=SimpleNamespace(value=status), action=np.array([action]))
    systems._judge(system, 0.0, grid, np.zeros(1), np.array([wish]), said, tally)
    return tally


@pytest.mark.parametrize(
    ("status", "action", "counts"),
    [
        ("passed", 0.0, (1, 0, 0, 0, 0)), ("passed", 0.6, (1, 1, 0, 0, 0)), ("corrected", 0.25, (1, 0, 0, 0, 0)),
        ("corrected", -0.6, (1, 1, 0, 0, 0)), ("relaxed", 0.0, (0, 0, 1, 1, 0)), ("relaxed", 0.9, (0, 0, 1, 1, 1)),
        ("fallback", -0.9, (0, 0, 1, 1, 1)), ("violated", 0.0, (0, 0, 1, 0, 0)), ("violated", 0.9, (0, 0, 1, 0, 1)),
    ],
)  # fmt: skip
def test_a_tally_of_one_answer(status: str, action: float, counts: tuple[int, ...]) -> None:
    """Actions from -0.25 to 0.25 keep both conditions, points from -0.2 to 0.2 with room."""
    found = tallied(status, action)
    assert (found.kept, found.below, found.unkept, found.missed, found.needless) == counts
    if status == "corrected":
        far = abs(action - 0.9) / 2.0 - 0.7 / 2.0
        assert found.excess == pytest.approx([far])
        assert found.broken == pytest.approx(max(0.0, abs(action) - 0.25) / 2.0, abs=1e-12)
    if status == "passed":
        assert found.broken == pytest.approx(max(0.0, (abs(action) - 0.25) / 0.5), abs=1e-12)


def test_where_nothing_keeps_both_nothing_is_missed_or_needless() -> None:
    found = tallied("relaxed", 0.9, lift=-0.5)
    assert (found.unkept, found.missed, found.needless) == (1, 0, 0)
    assert tallied("corrected", 0.9, lift=-0.5).excess == []


@pytest.mark.parametrize("status", ["corrected", "relaxed"])
def test_of_a_wish_that_is_none_no_distance_is_told(status: str) -> None:
    found = tallied(status, 0.0, wish=np.nan)
    assert (found.excess, found.unkept) == ([], 0)


def test_tallies_of_episodes_are_added_up() -> None:
    one = systems.Tally(least_h=0.5, crashed=1, episodes=2, broken=0.25, kept=3, below=5, missed=7, needless=11)
    other = systems.Tally(least_h=-0.5, crashed=2, episodes=3, broken=0.125, kept=5, below=7, missed=11, needless=13)
    one.statuses.update({"passed": 4, "relaxed": 1})
    other.statuses.update({"passed": 6})
    one.unkept, other.unkept, one.excess, other.excess = 17, 19, [0.5], [0.25, 0.125]
    one.add(other)
    assert (one.least_h, one.broken, one.excess) == (-0.5, 0.25, [0.5, 0.25, 0.125])
    assert (one.crashed, one.episodes, one.kept, one.below, one.missed, one.needless, one.unkept) == (
        3, 5, 8, 12, 18, 24, 36,
    )  # fmt: skip
    assert one.statuses == {"passed": 10, "relaxed": 1}


@pytest.mark.parametrize(("actions", "points"), [(1, 401), (2, 961)])
@pytest.mark.parametrize("barriers", [None, ()])
def test_a_grid_reaches_every_corner(actions: int, points: int, barriers: Any) -> None:
    system: Any = SimpleNamespace(barriers=barriers, low=(-2.0,) * actions, high=(4.0,) * actions)
    grid = systems._grid(system)
    assert grid.shape == ({401: 41, 961: 81}[points] if barriers is not None else points, actions)
    assert {tuple(row) for row in grid.tolist()} >= {(-2.0,) * actions, (4.0,) * actions}


def test_a_distance_of_a_system_is_the_root_of_the_squares_in_ranges() -> None:
    system: Any = SimpleNamespace(low=(-1.0, 0.0), high=(1.0, 10.0))
    found = systems._far(system, np.array([[0.6, 4.0], [0.0, 0.0]]), np.zeros(2))
    assert found.tolist() == [0.5, 0.0]


def test_the_distance_of_the_cars_actions_is_weighted_in_ranges() -> None:
    """Ranges of 3 m/s and 1 rad."""
    judge = object.__new__(CarJudge)
    judge._settings, judge._question = SimpleNamespace(weights=(1.0, 4.0)), SimpleNamespace(wish=np.array([1.0, 0.0]))  # type: ignore[assignment]
    judge.low, judge.high = np.array([-1.0, -0.5]), np.array([2.0, 0.5])
    found = judge.distance(np.array([[1.0, 0.25], [-0.5, 0.0], [2.2, 0.15], [1.0, 0.0]]))
    np.testing.assert_allclose(found, [0.5, 0.5, 0.5, 0.0])


@pytest.mark.parametrize(
    ("obstacle", "room"),
    [((2.0, 0.0, 0.5), 2.0 - 0.40 - 0.5), ((0.0, 2.0, 0.5), 2.0 - 0.5), ((-2.0, 0.0, 0.5), 2.0 - 0.08 - 0.5),
     ((3.4, 4.0, 1.0), 4.0), ((0.2, 0.0, 0.1), -0.1)],
)  # fmt: skip
def test_the_room_of_a_car_that_stands(obstacle: tuple[float, float, float], room: float) -> None:
    """From the segment between its ends, less 0.12 m, no clearance and no braking."""
    known = {"clearance": 0.0, "speed_low": -1.0, "speed_high": 2.0, "braking_deceleration": 1.0, "braking_gain": 5.0}
    judge = object.__new__(CarJudge)
    judge._settings = SimpleNamespace(barrier=known.__getitem__)  # type: ignore[assignment]
    judge._question = SimpleNamespace(obstacles=np.array([obstacle]))  # type: ignore[assignment]
    h = judge._h(np.array([[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]))
    assert h[0, 0] == pytest.approx(room - 0.12)
    assert h[0, 1:5].tolist() == pytest.approx([4.28, 3.48, 3.88, 3.88])
    assert h[0, 5:9].tolist() == pytest.approx([3.8, 3.96, 3.88, 3.88])
    assert h[0, 9:].tolist() == [1.0, 2.0]
    assert h[1, 9:].tolist() == [2.0, 1.0]
    # at 1 m/s, beyond b / k = 0.2 m/s: 0.04 m and (1 - 0.04) / 2 m
    assert h[1, 2] == pytest.approx(3.48 - 0.52)


@pytest.mark.parametrize(("x", "v", "all_kept"), [(-5.0, 0.0, True), (0.0, 3.0, False)])
def test_far_from_the_wall_all_is_allowed_and_too_fast_before_it_the_hardest_brake(
    x: float, v: float, all_kept: bool
) -> None:
    assert _allowed(x, v) == (1.0 if all_kept else -1.0)


def test_before_the_wall_what_is_allowed_keeps_the_condition_and_a_little_more_does_not() -> None:
    found = _allowed(0.5, 0.5)
    assert -1.0 < found < 1.0

    def h(p: float, s: float) -> float:
        return 1.0 - p - max(s, 0.0) ** 2 / 1.6 - 0.1 * max(s, 0.0)

    def kept(a: float) -> bool:
        return h(0.525 + 0.00125 * a, 0.5 + 0.05 * a) >= 0.9 * h(0.5, 0.5) + 0.002

    assert kept(found - 1e-9)
    assert not kept(found + 0.01)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_bad_vectors_are_as_long_as_good_ones_where_they_say_so(count: int) -> None:
    good = [0.5 + n for n in range(count)]
    found = {name: value for name, (value, _) in vectors(good).items()}
    assert found["masked"].mask.tolist() == [True] + [False] * (count - 1)
    assert len(found["a date"]) == len(found["true and false"]) == len(found["objects"]) == count
    assert [len(found[name]) for name in ("NaN", "infinite", "of 1e308", "none within")] == [count] * 4
    assert (len(found["too long"]), len(found["a column"])) == (count + 1, count)


def test_worst_reflections_are_told_three_a_mirror_with_how_many_there_are() -> None:
    def item(name: str, number: int, apart: float, same: bool = False) -> Any:
        return mirrors.Reflected(name, number, ("passed", "relaxed"), apart, same)

    items = [item("a", n, 0.1 * n) for n in range(5)] + [item("b", 9, 0.5), item("b", 8, 0.7), item("c", 1, 9.0, True)]
    worst = mirrors._worst(items)
    assert [(one["fault"], one["number"], one["count"]) for one in worst] == [
        ("a", 4, 5), ("a", 3, 5), ("a", 2, 5), ("b", 8, 2), ("b", 9, 2),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("statuses", "action", "apart", "same"),
    [(("passed", "corrected"), (0.5, 0.5), 0.25, False), (("corrected", "corrected"), (0.0, 1.0), 0.5, False),
     (("passed", "passed"), (1.0, 0.0), 0.25, False), (("passed", "passed"), (0.0, 0.0), 0.0, True),
     (("relaxed", "violated"), (0.0, 0.0), 0.0, False), (("relaxed", "relaxed"), (0.0, 0.0), 0.0, True)],
)  # fmt: skip
def test_two_answers_are_apart_by_the_root_of_the_weight(
    statuses: tuple[str, str], action: tuple[float, float], apart: float, same: bool
) -> None:
    """Weights of 1 and 4, of which the largest counts as one: 0.25 and 1; ranges of 2."""
    problem = plane(1.0, 1.0, weights=(1.0, 4.0))
    one, other = verdict(statuses[0], (0.0, 0.0)), verdict(statuses[1], action)
    found = mirrors._beside("a", 1, problem, one, other, lambda value: value)
    assert found.apart == pytest.approx(apart)
    assert found.same is same


def test_a_campaign_counts_what_held_what_did_not_and_what_was_only_told() -> None:
    rows = [
        Row("a", 1.0, 9, most=2.0), Row("b", 3.0, 9, most=2.0), Row("c", 3.0), Row("d", 5.0, 9, least=4.0),
        Row("e", 1.0, 0, most=2.0), Row("f", 1.0, 9, least=0.5, most=2.0), Row("g", 9.0, 9, most=2.0),
    ]  # fmt: skip
    attack: Any = SimpleNamespace(name="n", sentence="s")
    told = campaign._told(attack, Result(rows), 1.26)
    assert (told["held"], told["failed"], len(told["rows"]), told["seconds"]) == (3, 2, 7, 1.3)


def test_progress_of_a_campaign_is_of_the_pieces_of_all_attacks(monkeypatch: pytest.MonkeyPatch) -> None:
    class Workers:
        def __init__(self, _: int) -> None: ...

        def __enter__(self) -> Any:
            return SimpleNamespace(map=map)

        def __exit__(self, *_: object) -> None: ...

    def attack(count: int) -> Any:
        return SimpleNamespace(
            name=str(count), sentence="", pieces=lambda *_: list(range(count)), work=lambda piece: piece,
            told=lambda answers: Result([Row("sum", float(sum(answers)), len(answers))]),
        )  # fmt: skip

    monkeypatch.setattr(campaign, "Workers", Workers)
    monkeypatch.setattr(campaign, "digest_of_code", lambda: "c")
    told: list[tuple[int, int]] = []
    kept: list[int] = []
    found = campaign.adversary(
        [attack(2), attack(3), attack(1)], 1, tell=lambda *one: told.append(one),
        keep=lambda result: kept.append(len(result["attacks"])),
    )  # fmt: skip
    assert told == [(n, 6) for n in range(1, 7)]
    assert kept == [1, 2, 3]
    assert [(part["rows"][0]["measured"], part["rows"][0]["of"]) for part in found["attacks"]] == [
        (1, 2),
        (3, 3),
        (0, 1),
    ]


@pytest.mark.parametrize("other", ["", "experiment", "seed", "small", "code"])
def test_parts_of_another_campaign_are_left_out_whatever_differs(other: str, tmp_path: Path) -> None:
    same: dict[str, Any] = {"experiment": "adversary", "seed": 1, "small": True, "code": "c"}
    before = same | ({other: "another"} if other else {})
    (tmp_path / "adversary.json").write_text(json.dumps(before | {"attacks": [{"name": "a"}, {"name": "b", "old": 1}]}))
    result = same | {"attacks": [{"name": "b", "old": 0}]}
    found = report.with_parts_before(result, tmp_path, ["c", "b", "a"])
    assert found["attacks"] == ([{"name": "b", "old": 0}] + ([] if other else [{"name": "a"}]))
