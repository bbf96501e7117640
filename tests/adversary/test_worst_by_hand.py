"""What the attacks add up and which cases they tell as the worst, from several answers with the same fault."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.adversary.test_rows_by_hand import figures
from tests.adversary.test_verdicts_by_hand import Bent, plane, tallied

from safedpa_lab.experiments.adversary import bends, car_grid, programs
from safedpa_lab.experiments.adversary.bends import BentAnswer
from safedpa_lab.experiments.adversary.linear_judge import LinearJudge
from safedpa_lab.experiments.adversary.linear_problem import LinearProblem
from safedpa_lab.experiments.adversary.linear_shapes import shape_of
from safedpa_lab.experiments.adversary.linear_verdict import Judged

RIGHT = Judged("corrected", False, False, 0.0, False, False, 0.0, False, None, False)
CARS = car_grid._Answer(
    0, "corrected", 0.0, below=False, missed=False, excess=0.0, shortfall=None, untold=False
)  # fmt: skip
BENDS = BentAnswer(0, "kinks", "corrected", broken=0.0, excess=0.0)
Told = list[dict[str, Any]]


def worst_programs(sizes: Sequence[float]) -> Told:
    return programs._worst([(7, number, replace(RIGHT, broken=size)) for number, size in enumerate(sizes)])


def worst_bends(sizes: Sequence[float]) -> Told:
    return bends._worst([replace(BENDS, number=number, broken=size) for number, size in enumerate(sizes)])


def worst_cars(sizes: Sequence[float]) -> Told:
    return car_grid._worst([replace(CARS, number=number, broken=size) for number, size in enumerate(sizes)])


@pytest.mark.parametrize("worst", [worst_programs, worst_bends, worst_cars], ids=["programs", "bends", "car"])
@pytest.mark.parametrize(
    ("sizes", "numbers", "count"),
    [([0.0, 0.5, 0.25, 1e-12, 0.75, 0.125], [4, 1, 2], 4), ([0.5], [0], 1), ([0.25, 0.0, 0.5], [2, 0], 2)],
)
def test_the_three_worst_of_a_fault_are_told_with_how_many_there_are(
    worst: Callable[[Sequence[float]], Told], sizes: list[float], numbers: list[int], count: int
) -> None:
    told = worst(sizes)
    assert [case["number"] for case in told] == numbers
    assert [case["size"] for case in told] == [sizes[number] for number in numbers]
    assert {(case["fault"], case["count"]) for case in told} == {("condition broken", count)}


def test_the_worst_programs_can_be_drawn_anew() -> None:
    """Each with its own seed, number and shape."""
    told = programs._worst([(3, 5, replace(RIGHT, broken=0.5)), (9, 2, replace(RIGHT, broken=0.25))])
    assert [(one["seed"], one["number"], one["shape"]) for one in told] == [(3, 5, shape_of(5)), (9, 2, shape_of(2))]


def test_several_of_each_wrong_answer_to_bent_problems() -> None:
    """Five corrections, of which two predict h < 0 and three go too far, and four answers that keep less."""
    answers = [
        replace(BENDS, below=True, excess=0.5), replace(BENDS, below=True, excess=0.3), replace(BENDS, excess=0.2),
        BENDS, BENDS, *[BentAnswer(9, "kinks", "relaxed", missed=True, shortfall=0.1, needless=True)] * 3,
        BentAnswer(9, "kinks", "violated", shortfall=0.0),
    ]  # fmt: skip
    found = figures(bends._rows("kinks", answers))
    assert found["kinks: passed or corrected, predicted h < 0"] == (2, 5)
    assert found["kinks: corrected 0.1 of a range beyond the grid"] == (pytest.approx(60.0), 5)
    assert found["kinks: not corrected, though the grid keeps all"] == (3, 4)
    assert found["kinks: h < 0 predicted, grid keeps h >= 0"] == (3, 4)


def test_several_of_each_wrong_answer_of_the_car() -> None:
    """Four corrections, of which three go too far, and three answers that miss what the grid keeps."""
    relaxed = replace(CARS, status="relaxed", broken=None, missed=True, excess=None, shortfall=0.5)
    answers = [*(replace(CARS, excess=far) for far in (0.2, 0.4, 0.3, 0.05)), relaxed, relaxed, relaxed]
    found = figures(car_grid._rows("car", answers))
    assert found["car: corrected 0.1 of a range beyond the grid"] == (75.0, 4)
    assert found["car: relaxed, though the grid keeps all"] == (3, 3)
    assert found["car: relaxed or violated: 1 % of scale below the grid"] == (3, 3)


def test_a_correction_where_no_point_of_the_grid_keeps_both_is_no_distance_too_far() -> None:
    """With h = -0.5 now both conditions ask for -0.25 after it: one for a >= 0.25, the other for a <= -0.25."""
    problem: Any = Bent(1.0, -0.5)
    assert bends._judged(problem, 1, "corrected", np.array([0.0])).excess is None


@pytest.mark.parametrize(
    ("lift", "missed"),
    [(0.5, True), (0.006, True), (0.002, True), (-0.5, False)],  # from -0.25 to 0.25, three points, one, and none
)
def test_against_a_grid_an_answer_is_missed_where_a_single_point_keeps_both(lift: float, missed: bool) -> None:
    """From -lift / 2 to lift / 2; points are 0.002 apart."""
    problem: Any = Bent(1.0, lift)
    assert bends._judged(problem, 1, "relaxed", np.array([0.9])).missed is missed


@pytest.mark.parametrize("status", ["corrected", "relaxed"])
def test_of_a_wish_with_one_number_missing_no_distance_is_told(status: str) -> None:
    """Of two actions: what the grid would keep nearest to half a wish is not known."""
    found = tallied(status, 0.0, wish=np.array([0.5, np.nan]))
    assert (found.excess, found.unkept, found.missed, found.needless) == ([], 0, 0, 0)


@pytest.mark.parametrize(
    ("weights", "ranges", "action", "distance"),
    [
        ((1.0, 1.0), (2.0, 2.0), (0.0, 0.0), 0.125**0.5),
        ((1.0, 4.0), (2.0, 2.0), (0.3, -0.3), 0.05**0.5),  # the dearer one gives way a quarter as far
        ((9.0, 1.0), (2.0, 2.0), (-0.4, 0.4), (0.0025 + 0.2025 / 9.0) ** 0.5),
        ((1.0, 1.0), (2.0, 4.0), (-0.3, 0.3), (0.01 + 0.04) ** 0.5),  # half of its range is twice as much
        ((1.0, 4.0), (2.0, 4.0), (0.0, 0.0), (0.25 * 0.0625 + 0.015625) ** 0.5),
    ],
)
def test_the_nearest_action_gives_way_where_it_costs_least(
    weights: tuple[float, float], ranges: tuple[float, float], action: tuple[float, float], distance: float
) -> None:
    """a_1 + a_2 >= 0, wished are -0.5 and -0.5: each gives way by its range^2 / weight as a share of 1."""
    half = 0.5 * np.array(ranges)
    changes = {"P": np.ones((1, 2)), "q": np.zeros(1), "epsilon": np.zeros(1), "low": -half, "high": half}
    problem = LinearProblem(**vars(plane(0.0, 0.0, wish=(-0.5, -0.5), weights=weights)) | changes)
    nearest = LinearJudge(problem).nearest()
    assert nearest is not None
    np.testing.assert_allclose(nearest.action, action, atol=1e-9)
    assert nearest.distance == pytest.approx(distance)


@pytest.mark.parametrize(("each", "moved"), [(0.8e-12, True), (0.4e-12, False)])
def test_a_row_is_moved_where_the_actions_move_it_together_by_a_share_of_1e_12(each: float, moved: bool) -> None:
    """The second row is 1 now; two actions over a range of 2 change it by so much each."""
    changes = {
        "P": np.eye(2), "g": np.array([[1.0, 0.0], [0.5 * each, 0.5 * each]]), "f": np.array([0.25, 1.0]),
        "state": np.array([0.25, 1.0]),
    }  # fmt: skip
    judge = LinearJudge(LinearProblem(**vars(plane(0.25, 1.0)) | changes))
    assert len(judge.movable(np.zeros(2))) == 1 + moved


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize("low", [-1.0, -0.25])
def test_the_best_least_h_is_that_of_the_rows_that_actions_move(way: float, low: float) -> None:
    """The first row stays below; the second rises from 0.5 by 1, in a scale of 2, where the action is the largest."""
    judge = LinearJudge(LinearProblem(**vars(plane(low, 0.5)) | {"g": np.diag([0.0, way])}))
    height, action = judge.best_least_height()
    assert height == pytest.approx(0.75)
    assert action[1] == pytest.approx(way)


@pytest.mark.parametrize(
    ("status", "kept", "missed", "excess", "shortfall"),
    [
        ("corrected", (1, 2), False, 0.25, None),  # the nearest of those that keep both is 0.5 away
        ("corrected", (2,), False, -0.25, None),
        ("corrected", (), False, None, None),
        ("relaxed", (1, 2), True, None, 0.125),
        ("fallback", (0,), True, None, 0.125),
        ("relaxed", (), False, None, 0.0),
        ("violated", (0, 1, 2), False, None, 0.125),
        ("passed", (0, 1, 2), False, None, None),
    ],
)
def test_one_answer_of_the_car_beside_three_points_of_the_grid(
    status: str,
    kept: tuple[int, ...],
    missed: bool,
    excess: float | None,
    shortfall: float | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two conditions ask for 0.5; the points keep both with 0.75 and otherwise the first alone; the answer 0.625."""
    h = np.array([[0.75, 0.75 if point in kept else 0.25] for point in range(3)])
    own = np.array([[0.625, 0.625 if kept else 0.25]])
    away = np.array([0.25, 0.5, 1.0, 0.75])
    judge = SimpleNamespace(
        h=h, required=np.array([0.5, 0.5]), scale=np.ones(2), grid=np.arange(3.0)[:, None], now=np.ones(2),
        heights=lambda _: own, distance=lambda actions: away[actions[:, 0].astype(int)],
    )  # fmt: skip
    answer = SimpleNamespace(status=SimpleNamespace(value=status), action=np.array([3.0]))
    monkeypatch.setattr(car_grid, "CarJudge", lambda *_: judge)
    monkeypatch.setattr(car_grid, "car_barriers", lambda *_: [])
    safe: Any = SimpleNamespace(decide=lambda *_, **__: answer)
    model: Any = SimpleNamespace(latent=None)
    question: Any = SimpleNamespace(state=None, wish=None, obstacles=None)
    settings: Any = None
    found = car_grid._answered(safe, model, settings, question, 7)
    assert (found.number, found.status, found.missed, found.excess) == (7, status, missed, excess)
    assert found.shortfall == (None if shortfall is None else pytest.approx(shortfall))
    assert found.untold is (status == "violated"), "no h is below 0 now"
