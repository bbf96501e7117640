"""This project and its peers are given the same problems, and answers are judged by what is hidden."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safedpa.dynamics import load_model
from safedpa.robots.car.barriers import ObstacleBarrier
from safedpa.safety import SafetyFilter, Status
from safedpa.safety.braking import Braking
from safedpa_lab.benchmarks.diagnosis_cases import CASES, NAMES, expression_is_right, terms_are_right, told, written
from safedpa_lab.benchmarks.filter_problem import FilterProblem, problem_with, wedged
from safedpa_lab.benchmarks.peers.problem import Problem, compared
from safedpa_lab.benchmarks.rows.sensed import places_seen
from safedpa_lab.benchmarks.timing import in_turn


@pytest.fixture(scope="module")
def eight() -> FilterProblem:
    return problem_with(8)


def peers_problem(problem: FilterProblem, calls: int = 0) -> Problem:
    return Problem(problem.question(calls, 1.0, ""))


@given(
    x=st.floats(-3.0, 3.0),
    y=st.floats(-3.0, 3.0),
    yaw=st.floats(-3.1, 3.1),
    speed=st.floats(-0.8, 2.2).filter(lambda speed: abs(speed) > 1e-300),  # at rest the slope has two sides
)
def test_peers_get_the_barrier_of_this_project(x: float, y: float, yaw: float, speed: float) -> None:
    problem = wedged()
    theirs, state = peers_problem(problem), np.array([x, y, yaw, speed])
    settings = problem.settings
    ours = ObstacleBarrier(
        problem.obstacles,
        theirs.question["footprint"],
        Braking(settings.barrier("braking_deceleration"), settings.barrier("braking_gain")),
        settings.barrier("clearance"),
    )
    h, p = theirs.gradient(state)
    assert theirs.barrier(state) == pytest.approx(ours.values(state), abs=1e-9)
    assert h == pytest.approx(ours.values(state), abs=1e-8)
    away = h + theirs.reach > 1e-6  # on the body itself there is no direction
    assert p[away] == pytest.approx(ours.evaluate(state)[1][away], abs=1e-9)


def test_every_timed_decision_needs_the_quadratic_program(eight: FilterProblem) -> None:
    for name in ("car", "car_learned"):
        model = load_model(name)
        one = SafetyFilter.for_model(model, eight.settings)
        verdicts = [one.decide(*asked, barriers=eight.barriers()) for asked in eight.requests(model)]
        assert {verdict.status for verdict in verdicts} == {Status.corrected}
        assert {verdict.solver for verdict in verdicts} == {"solved"}


def test_the_scene_is_always_the_same(eight: FilterProblem) -> None:
    assert problem_with(8).states.tobytes() == eight.states.tobytes()


def test_no_action_frees_the_wedged_car() -> None:
    A, b = peers_problem(wedged()).conditions(np.zeros(4))
    settings = wedged().settings
    corners = np.array([[u, v] for u in np.linspace(settings.low[0], settings.high[0], 40) for v in (-0.34, 0.34)])
    reached = corners @ A.T
    assert not (reached >= b).all(axis=1).any()
    model = load_model("car")
    one = SafetyFilter.for_model(model, settings, wedged().barriers())
    assert one.decide(*wedged().requests(model)[0]).status is Status.violated


def test_a_peer_is_timed_and_its_answers_are_kept(eight: FilterProblem) -> None:
    answer = compared(peers_problem(eight, calls=30), lambda state, wish: wish, version="1")
    assert answer["calls"] == 30
    assert answer["version"] == "1"
    assert answer["actions"] == [[2.0, 0.0]] * len(eight.states)


@pytest.mark.parametrize(
    ("action", "words"),
    [
        ((2.0, 0.0), "the unsafe wish"),
        ((9.0, 0.0), "beyond the limits"),
        ((0.0, 0.0), "within the limits"),
        ((float("nan"), 0.0), "(nan, 0) and says nothing"),
    ],
)
def test_what_a_peer_does_without_a_solution_is_reported(action: tuple[float, float], words: str) -> None:
    assert words in compared(peers_problem(wedged()), lambda state, wish: np.array(action))["says"]


def test_a_peer_that_raises_is_quoted() -> None:
    def decide(state: object, wish: object) -> np.ndarray:
        raise ArithmeticError

    assert compared(peers_problem(wedged()), decide)["says"] == "raises ArithmeticError"


def left_of(number: int, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    runs = told(written(CASES[number], folder, 2, 12.0))["runs"]
    middle, slopes = (np.concatenate([run[name] for run in runs]) for name in ("middle", "slopes"))
    return middle, slopes


@pytest.fixture(scope="module")
def noise(tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    """Of the slopes where nothing is hidden: the sensors' alone."""
    return left_of(0, tmp_path_factory.mktemp("nothing"))[1].std(axis=0)


@pytest.mark.long
@pytest.mark.parametrize("number", range(1, len(CASES)))
def test_the_terms_that_count_as_right_explain_the_logs(number: int, noise: np.ndarray, tmp_path: Path) -> None:
    """Each of them is found by least squares, far from zero, and what they leave is no more than the sensors' noise."""
    hidden = CASES[number]
    middle, slopes = left_of(number, tmp_path)
    values = {**dict(zip(NAMES, middle.T, strict=True)), "1": np.ones(len(middle))}
    for column, wanted in ((0, hidden.turn[0]), (1, hidden.push[0])):
        left = slopes[:, column]
        if wanted:
            terms = [np.prod([values[name] for name in _factors(term)], axis=0) for term in sorted(wanted)]
            columns = np.stack(terms, axis=1)
            found = np.linalg.lstsq(columns, left, rcond=None)[0]
            left = left - columns @ found
            deviations = left.std() * np.sqrt(np.diag(np.linalg.inv(columns.T @ columns)))
            assert (np.abs(found) > 4.0 * deviations).all()
        assert left.std() < 1.5 * noise[column]


def _factors(term: str) -> list[str]:
    return [name for part in term.split() for name in ([part[:-2]] * 2 if part.endswith("^2") else [part])]


def test_answers_are_judged_by_their_terms() -> None:
    nothing, drag, offset = CASES[0], CASES[1], CASES[5]
    assert terms_are_right(nothing, [{}, {}])
    assert not terms_are_right(nothing, [{}, {"speed": 0.1}])
    assert terms_are_right(drag, [{}, {"speed sign": -0.1}])
    assert not terms_are_right(drag, [{"speed": 0.1}, {"speed sign": -0.1}])
    assert terms_are_right(offset, [{"speed": 0.12}, {}])
    assert expression_is_right(drag, [[], ["speed"]])
    assert expression_is_right(offset, [["speed", "steer"], []])
    assert not expression_is_right(nothing, [[], ["speed"]])


@pytest.mark.parametrize("count", [64, 256, 1080])
def test_what_a_laser_sees_lies_on_walls_and_pillars_evenly(count: int) -> None:
    places = places_seen(count)
    on_wall = np.isclose(np.abs(places).max(axis=1), 4.0)
    pillars = np.array([(1.5, 1.2, 0.3), (-1.4, 1.6, 0.25), (-1.2, -1.5, 0.35), (1.8, -1.6, 0.2)])
    apart = np.abs(np.hypot(*(places[:, None] - pillars[:, :2]).transpose(2, 0, 1)) - pillars[:, 2]).min(axis=1)
    assert len(places) == count
    assert (on_wall | (apart < 1e-9)).all()
    steps = np.hypot(*np.diff(places[on_wall], axis=0).T)
    assert np.median(steps) == pytest.approx((32.0 + 2.0 * np.pi * 1.1) / count, rel=1e-6)


def test_calls_in_turn_are_each_given_their_own_inputs_as_often() -> None:
    asked: dict[str, list[int]] = {"one": [], "other": []}
    found = in_turn({"one": (asked["one"].append, [1, 2]), "other": (asked["other"].append, [3])}, 30, 60.0)
    assert asked["one"].count(1) + asked["one"].count(2) == len(asked["other"]) == 33
    assert set(asked["other"]) == {3}
    assert {own["calls"] for own in found.values()} == {30}


def test_no_call_always_follows_the_same_call() -> None:
    called: list[str] = []
    names = ("one", "other", "third")
    in_turn({name: (called.append, [name]) for name in names}, 30, 60.0)
    turns = [tuple(called[begin : begin + 3]) for begin in range(0, len(called), 3)]
    assert all(set(turn) == set(names) for turn in turns)
    assert {turn[0] for turn in turns} == set(names)
    assert len(set(turns)) > 3
