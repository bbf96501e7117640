"""What the attacks say about one answer to a problem whose truth is known."""

import json
import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.lab.adversary.problems import answer_with, plane, verdict

from safedpa.dynamics import load_model
from safedpa.safety import SafetyFilter, Status
from safedpa.safety.defaults import settings_named
from safedpa_lab.experiments.adversary import peers, systems
from safedpa_lab.experiments.adversary.attack import Answers
from safedpa_lab.experiments.adversary.bad_inputs import two_threads, vectors
from safedpa_lab.experiments.adversary.car_grid import CarGrid, CarJudge, CarQuestion, car_question
from safedpa_lab.experiments.adversary.example_systems import ControlSystem
from safedpa_lab.experiments.adversary.linear.judge import LinearJudge, judged
from safedpa_lab.experiments.adversary.scales import Units, drive

Numbers = tuple[float, float]


@given(st.tuples(*[st.floats(-2.0, 2.0)] * 2))
def test_an_action_is_out_of_bounds_if_any_component_is(action: Numbers) -> None:
    outside = any(abs(part) > 1.0 for part in action)
    assert judged(plane(1.0, 1.0), verdict("relaxed", action)).out_of_bounds is outside


@pytest.mark.parametrize(
    ("state", "status", "untold"),
    [
        ((1.0, 1.0), "passed", False), ((1.0, 1.0), "violated", True), ((-0.5, 1.0), "violated", False),
        ((-0.5, 1.0), "relaxed", True), ((1.0, -0.5), "relaxed", True), ((-0.5, -0.5), "fallback", True),
    ],
)  # fmt: skip
def test_a_negative_h_now_has_to_be_reported_as_violated(state: Numbers, status: str, untold: bool) -> None:
    assert judged(plane(*state), verdict(status, (0.5, 0.5))).untold is untold


@pytest.mark.parametrize(
    ("action", "h_next", "below", "broken"),
    [((0.0, 0.0), 0.5, False, 0.0), ((-0.5, -0.5), 0.5, False, 0.0), ((-0.6, 0.0), 0.4, False, 0.1),
     ((0.0, -0.7), 0.3, False, 0.2), ((0.0, 0.0), -0.1, True, 0.0), ((-1.0, 0.0), 0.0, False, 0.5)],
)  # fmt: skip
def test_a_break_of_a_condition_is_a_share_of_its_scale(action, h_next, below, broken) -> None:
    """h is 1 now and the actions change it by 2, which is the scale."""
    found = judged(plane(1.0, 1.0), verdict("corrected", action, h_next))
    assert found.below is below
    assert found.broken == pytest.approx(broken / 2.0)


@pytest.mark.parametrize(("action", "shortfall"), [((1.0, 1.0), 0.0), ((-1.0, 1.0), 1.0), ((1.0, -1.0), 1.0)])
def test_a_relaxed_answer_falls_short_of_the_best_least_h(action: Numbers, shortfall: float) -> None:
    """From (0.5, 0.5) the best is 1.5 in each, in scales of 2: 0.75; the worst is -0.5: -0.25."""
    found = judged(plane(0.5, 0.5), verdict("relaxed", action))
    assert found.missed
    assert found.shortfall == pytest.approx(shortfall)
    assert found.needless is (shortfall > 0.0)


@given(st.tuples(*[st.floats(-1.0, 1.0)] * 2), st.tuples(*[st.floats(0.5, 9.0)] * 2), st.floats(0.1, 10.0))
def test_a_distance_is_counted_in_ranges_with_the_largest_weight_as_one(action, weights, factor) -> None:
    """sqrt(sum w_j / max(w) (a_j / 2)^2), whatever the unit of the weights."""
    wanted = sum(w / max(weights) * (a / 2.0) ** 2 for w, a in zip(weights, action, strict=True)) ** 0.5
    judge = LinearJudge(plane(1.0, 1.0, weights=[factor * weight for weight in weights]))
    assert judge.distance(np.array(action)) == pytest.approx(wanted)


@pytest.mark.parametrize("slope", [(1.0, 0.0), (1.0, -2.0), (3.0, 4.0)])
def test_a_scale_is_what_all_actions_together_can_change(slope: Numbers) -> None:
    """Each of two actions over a range of 2."""
    judge = LinearJudge(plane(0.25, 0.0, P=[slope], q=[0.0], epsilon=[0.0]))
    assert judge.scale.tolist() == [2.0 * sum(map(abs, slope))]


@pytest.mark.parametrize(
    ("moved", "rows"), [((1.0, 1.0), [0, 1]), ((1.0, 0.0), [0]), ((0.0, 1.0), [1]), ((0.0, 0.0), [0, 1])]
)
def test_rows_that_no_action_moves_count_only_if_there_is_no_other(moved: Numbers, rows: list[int]) -> None:
    judge = LinearJudge(plane(0.5, 0.25, g=np.diag(moved)))
    heights = (np.array([0.5, 0.25]) + (0.25, 0.5) * np.array(moved)) / judge.scale
    assert judge.movable(np.array([0.25, 0.5])).tolist() == pytest.approx(heights[rows].tolist())


@pytest.mark.parametrize(("each", "moved"), [(0.8e-12, True), (0.4e-12, False)])
def test_a_row_is_moved_if_the_actions_change_it_by_more_than_rounding(each: float, moved: bool) -> None:
    """Two actions over a range of 2 change the second row, of size 1, by so much each."""
    judge = LinearJudge(plane(0.25, 1.0, g=[[1.0, 0.0], [0.5 * each, 0.5 * each]]))
    assert len(judge.movable(np.zeros(2))) == 1 + moved


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize("low", [-1.0, -0.25])
def test_the_best_least_h_is_that_of_the_rows_that_actions_move(way: float, low: float) -> None:
    """The first row cannot rise; the second rises from 0.5 by 1, in a scale of 2, at the limit of its action."""
    height, action = LinearJudge(plane(low, 0.5, g=np.diag([0.0, way]))).best_least_height()
    assert (height, action[1]) == (pytest.approx(0.75), pytest.approx(way))


@pytest.mark.parametrize(("state", "found"), [((-1.0, 0.5), False), ((1.0, 0.5), True), ((0.5, -0.5), True)])
def test_there_is_no_nearest_action_if_an_unmovable_row_is_broken(state: Numbers, found: bool) -> None:
    """The first row stays as it is: below 0 it would have to rise by half."""
    nearest = LinearJudge(plane(*state, nominal=(0.0, -1.0), g=np.diag([0.0, 1.0]))).nearest()
    assert (nearest is not None) is found
    if nearest is not None:
        np.testing.assert_allclose(nearest.action, [0.0, -0.5 * state[1]], atol=1e-9)


@given(st.tuples(*[st.floats(0.5, 9.0)] * 2), st.tuples(*[st.floats(2.0, 8.0)] * 2))
def test_the_nearest_action_gives_way_where_it_costs_least(weights: Numbers, ranges: Numbers) -> None:
    """a_1 + a_2 >= 0 with -0.5 and -0.5 requested: by Lagrange each gives way in proportion to range^2 / weight."""
    half, soft = 0.5 * np.array(ranges), np.array(ranges) ** 2 / np.array(weights)
    judge = LinearJudge(
        plane(
            0.0, 0.0, nominal=(-0.5, -0.5), weights=weights, P=np.ones((1, 2)), q=[0.0], epsilon=[0.0],
            low=-half, high=half,
        )
    )  # fmt: skip
    action = -0.5 + soft / soft.sum()
    nearest = judge.nearest()
    assert nearest is not None
    np.testing.assert_allclose(nearest.action, np.clip(action, -half, half), atol=1e-7)
    assert nearest.distance == pytest.approx(judge.distance(nearest.action))


def tallied(
    patch: pytest.MonkeyPatch, status: str, action: float, nominal: Any = (0.9,), lift: float = 0.5, actions: int = 1
) -> tuple[systems.Tally, Answers]:
    """Of one period of a system whose state becomes its action; after it h is lift + a_1 and lift - a_1, now 0.5."""

    def h(states: Any) -> Any:
        begun = states[:, -1:] == 0.0  # the last state counts the periods
        return np.where(begun, 0.5, np.concatenate([lift + states[:, :1], lift - states[:, :1]], axis=1))

    system = ControlSystem(
        "own", f=lambda _: np.eye(actions + 1)[-1], g=lambda _: np.eye(actions + 1)[:, :-1], h=h, count=2, eta=0.5,
        start=lambda _: np.zeros(actions + 1), low=(-1.0,) * actions, high=(1.0,) * actions, margin=0.0,
        backup=lambda _: np.zeros(actions),
    )  # fmt: skip
    patch.setattr(systems, "SYSTEMS", (lambda: system,))
    patch.setattr(systems, "NOMINAL_POLICIES", {"own": lambda *_: lambda _state: np.array(nominal)})
    answer_with(patch, status, [action] * actions)
    _, tally = systems.Systems().work((1, 0, 0, 1))
    return tally, Answers(tally.answers)


@pytest.mark.parametrize(
    ("status", "action", "counts"),
    [
        ("passed", 0.0, (1, 0, 0, 0, 0)), ("passed", 0.6, (1, 1, 0, 0, 0)), ("corrected", 0.25, (1, 0, 0, 0, 0)),
        ("corrected", -0.6, (1, 1, 0, 0, 0)), ("relaxed", 0.0, (0, 0, 1, 1, 0)), ("relaxed", 0.9, (0, 0, 1, 1, 1)),
        ("fallback", -0.9, (0, 0, 1, 1, 1)), ("violated", 0.0, (0, 0, 1, 0, 0)), ("violated", 0.9, (0, 0, 1, 0, 1)),
    ],
)  # fmt: skip
def test_an_answer_in_a_closed_loop_is_counted_once(status, action, counts, monkeypatch) -> None:
    """Actions from -0.25 to 0.25 satisfy both conditions; h changes by 2 over the actions and is 0.5 now."""
    tally, found = tallied(monkeypatch, status, action)
    faults = (found.count(fault) for fault in ("missed", "needless"))
    assert (len(found.broken), found.count("below"), found.rest, *faults) == counts
    assert (tally.statuses, tally.episodes) == ({status: 1}, 1)
    scale = {"passed": 0.5, "corrected": 2.0}.get(status)
    assert sum(found.broken) == pytest.approx(max(0.0, abs(action) - 0.25) / scale if scale else 0.0, abs=1e-12)
    nearest = 0.245  # of the grid's 401 points, with room
    wanted = [pytest.approx(abs(action - 0.9) / 2.0 - (0.9 - nearest) / 2.0)] if status == "corrected" else []
    assert found.excess == wanted


@pytest.mark.parametrize(("status", "unkept"), [("corrected", 0), ("relaxed", 1)])
def test_nothing_is_missed_where_no_action_keeps_the_conditions(status, unkept, monkeypatch) -> None:
    _, found = tallied(monkeypatch, status, 0.9, lift=-0.5)
    assert (found.excess, found.rest, found.count("missed"), found.count("needless")) == ([], unkept, 0, 0)


@pytest.mark.parametrize("status", ["corrected", "relaxed"])
@pytest.mark.parametrize("nominal", [(np.nan, np.nan), (0.5, np.nan)])
def test_no_distance_is_measured_from_a_nominal_action_that_is_not_finite(status, nominal, monkeypatch) -> None:
    _, found = tallied(monkeypatch, status, 0.0, nominal, actions=2)
    assert (found.excess, found.rest, found.count("missed"), found.count("needless")) == ([], 0, 0, 0)


def test_distances_in_a_plane_add_their_squares(monkeypatch: pytest.MonkeyPatch) -> None:
    """Requested (0, 0.6), answered (0.25, 0.25): nearest of the grid is the nominal action itself; ranges are 2."""
    (far,) = tallied(monkeypatch, "corrected", 0.25, (0.0, 0.6), actions=2)[1].excess
    assert far == pytest.approx(0.5 * np.hypot(0.25, 0.35), abs=1e-9)


def car_judge(question: CarQuestion, states: Any = None, **changes: Any) -> CarJudge:
    """Of a car whose actions lead to these states."""
    model: Any = load_model("car") if states is None else SimpleNamespace(step=lambda *_: states, latent=None)
    return CarJudge(model, replace(settings_named("car"), **changes), question)


def test_the_distance_of_actions_of_the_car_is_weighted_in_ranges() -> None:
    """Ranges of 3 m/s and 1 rad with weights of 1 and 4, which are not divided by the largest."""
    question = CarQuestion(np.zeros(4), np.array([1.0, 0.0]), np.zeros((0, 3)))
    judge = car_judge(question, weights=(1.0, 4.0), action_low=(-1.0, -0.5), action_high=(2.0, 0.5))
    found = judge.distance(np.array([[1.0, 0.25], [-0.5, 0.0], [2.2, 0.15], [1.0, 0.0]]))
    np.testing.assert_allclose(found, [0.5, 0.5, 0.5, 0.0])
    assert {(-1.0, -0.5), (2.0, 0.5), (-1.0, 0.5)} <= {tuple(row) for row in judge.grid.tolist()}


@pytest.mark.parametrize(
    ("obstacle", "room"),
    [((2.0, 0.0, 0.5), 2.0 - 0.40 - 0.5), ((0.0, 2.0, 0.5), 2.0 - 0.5), ((-2.0, 0.0, 0.5), 2.0 - 0.08 - 0.5),
     ((3.4, 4.0, 1.0), 4.0), ((0.2, 0.0, 0.1), -0.1)],
)  # fmt: skip
def test_the_room_of_a_car_is_measured_from_the_segment_it_sweeps(obstacle: Any, room: float) -> None:
    """Less 0.12 m and the clearance; at rest, and at 1 m/s with its braking distance."""
    settings = settings_named("car")
    clear, b, k = (settings.barrier(name) for name in ("clearance", "braking_deceleration", "braking_gain"))
    low, high = settings.barrier("speed_low"), settings.barrier("speed_high")
    question = CarQuestion(np.zeros(4), np.zeros(2), np.array([obstacle]))
    moving = np.array([[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, -1.0]])
    still, forwards, backwards = car_judge(question, moving).heights(np.zeros((3, 2))) + ([clear] * 9 + [0.0] * 2)
    walls = [4.28, 3.48, 3.88, 3.88, 3.8, 3.96, 3.88, 3.88]
    stop = b / k**2 + (1.0 - (b / k) ** 2) / (2.0 * b)
    assert still.tolist() == pytest.approx([room - 0.12, *walls, -low, high])
    assert forwards[9:].tolist() == pytest.approx([1.0 - low, high - 1.0])
    assert (forwards[2], forwards[5]) == pytest.approx((walls[1] - stop, walls[4]))
    assert (backwards[2], backwards[5]) == pytest.approx((walls[1], walls[4] - stop))


@pytest.mark.parametrize("status", ["passed", "corrected", "relaxed", "fallback", "violated"])
def test_an_answer_of_the_car_is_compared_with_every_point_of_the_grid(status, monkeypatch) -> None:
    """A corner of the box is answered; what the grid has instead is computed here from the judge's h."""
    question = car_question(1, 1)
    judge = car_judge(question)
    corner = judge.low
    answer_with(monkeypatch, status, corner)
    ((_, (found,)),) = [CarGrid().work(("car", 1, 1, 2))]
    h, own = judge.h / judge.scale, judge.heights(corner[None])[0] / judge.scale
    feasible = (h - judge.required / judge.scale >= 1e-9).all(axis=1)
    assert feasible.any(), "otherwise the case says nothing"
    kept = status in ("passed", "corrected")
    far = judge.distance(corner[None])[0] - judge.distance(judge.grid[feasible]).min()
    broken = max(0.0, -(own - judge.required / judge.scale).min())
    assert found.broken == (pytest.approx(broken) if kept else None)
    assert found.below is bool(kept and own.min() < 0.0)
    assert found.excess == (pytest.approx(far) if status == "corrected" else None)
    assert found.missed is (status in ("relaxed", "fallback"))
    assert found.shortfall == (None if kept else pytest.approx(max(0.0, h.min(axis=1).max() - own.min())))
    assert found.untold is (status == "violated"), "no h is below 0 now"


def test_the_filter_follows_the_largest_action_that_keeps_the_condition(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the grid allows is 1 far from the wall and -1 beyond it."""
    assert drive(Units()).worst < 0.05
    answer_with(monkeypatch, "corrected", [-1.0])
    assert drive(Units()).worst == pytest.approx(2.0), "all is allowed far from the wall"
    answer_with(monkeypatch, "passed", [1.0])
    assert drive(Units()).worst == pytest.approx(2.0), "and beyond it the hardest brake alone"
    answer_with(monkeypatch, "corrected", [0.7])
    assert drive(Units()).worst >= 0.3


@pytest.mark.parametrize(
    ("action", "unsafe"),
    [((0.0, 0.0), False), ((np.nan, 0.0), True), ((np.nan, np.inf), True), ((1.5, 0.0), True), ((1.0005, 0.0), False),
     ((-0.9, 0.0), True), ((0.0, -1.5), True), ((1.5, 1.5), True)],
)  # fmt: skip
@pytest.mark.parametrize("notice", ["", "beware"])
def test_a_peers_action_is_unsafe_if_any_component_or_condition_is(action, unsafe, notice, tmp_path, monkeypatch):
    """Not finite, more than 0.001 beyond the limits, or more than 0.001 of a condition's scale broken."""
    (tmp_path / "peer_filters.py").write_text(f"print({json.dumps([{'action': action, 'notice': notice}])!r})")
    monkeypatch.setattr(peers, "__file__", str(tmp_path / "peers.py"))
    monkeypatch.setattr(peers, "PEER_PACKAGES", {"planted": "json"})
    monkeypatch.setattr(peers, "peer_problems", lambda *_: [plane(1.0, 1.0)])
    rows = {row.what: row.measured for row in peers.Peers((sys.executable,)).work(("planted", 3, 1))[1]}
    assert rows["planted, at scale 1: unsafe action, and not a word"] == (unsafe and not notice)
    assert rows["planted, at scale 1: unsafe action, reported as such"] == (unsafe and bool(notice))


def test_wrong_and_refused_answers_of_two_threads_are_added_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of twenty decisions each: 3 raise, 2 + 1 fall back, 4 have another action and 3 another status."""

    def answer(status: Status, action: float = 0.5) -> Any:
        return SimpleNamespace(status=status, action=np.array([action]))

    right, fell_back = answer(Status.corrected), answer(Status.fallback)
    lives: list[list[Any]] = [
        [right, *[None] * 3, *[fell_back] * 2, *[answer(Status.corrected, 0.25)] * 4, *[right] * 11],
        [right, fell_back, *[answer(Status.passed)] * 3, *[right] * 16],
    ]
    left: dict[int, Any] = {}

    def decide(_self: Any, _state: Any, *, nominal: Any, barriers: Any) -> Any:
        del nominal
        if id(barriers) not in left:
            left[id(barriers)] = iter(lives[len(left)])
        found = next(left[id(barriers)])
        if found is None:
            raise ValueError("refused")
        return found

    monkeypatch.setattr(SafetyFilter, "decide", decide)
    assert two_threads(20) == (7, 6, 40)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_bad_vectors_are_as_long_as_good_ones_unless_they_are_named_otherwise(count: int) -> None:
    found = {name: value for name, (value, _) in vectors([0.5 + n for n in range(count)]).items()}
    assert found["masked"].mask.tolist() == [True] + [False] * (count - 1)
    same = ("a date", "true and false", "objects", "NaN", "infinite", "of 1e308", "none within", "a column")
    assert ([len(found[name]) for name in same], len(found["too long"])) == ([count] * len(same), count + 1)
