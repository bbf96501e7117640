"""The filter's row: problems that peers get too, floors under a decision, targets from the same run."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safedpa.dynamics import LearnedBase, load_model
from safedpa.robots.car.barriers.obstacles import ObstacleBarrier
from safedpa.safety import SafetyFilter, Status
from safedpa.safety.barriers.stopping import Braking
from safedpa_lab.benchmarks.filter_problem import (
    FLOORS,
    MODELS,
    FilterProblem,
    decided,
    networks_alone,
    problem_with,
    program_alone,
    wedged,
    with_floors,
)
from safedpa_lab.benchmarks.peers.filters import Problem, compared
from safedpa_lab.benchmarks.python_source import without_compiler
from safedpa_lab.benchmarks.results import Curve, Effort, Floor, Row, Target
from safedpa_lab.benchmarks.rows import filter as row
from safedpa_lab.benchmarks.rows.diagnosis import CASES, NAMES, expression_is_right, reported, terms_are_right, written
from safedpa_lab.benchmarks.rows.sensed import places_seen
from safedpa_lab.benchmarks.table import target_texts
from safedpa_lab.benchmarks.timing import in_turn

NETWORKS, PHYSICS = MODELS.values()


@pytest.fixture(scope="module")
def eight() -> FilterProblem:
    return problem_with(8)


def test_the_networks_alone_compute_what_the_model_knows(eight: FilterProblem) -> None:
    model = load_model("car_learned")
    assert isinstance(model.base, LearnedBase)
    call, asked = networks_alone(eight, model)
    assert len(asked) == len(eight.states)
    for known in asked[:5]:
        assert call(known) == pytest.approx(model.base.known_at(*known))


def test_the_program_alone_satisfies_the_rows_that_the_nominal_action_breaks(eight: FilterProblem) -> None:
    model = load_model("car_learned")
    solve, posed = program_alone(eight, model)
    for A, b, nominal in posed:
        solution = solve((A, b, nominal))
        assert solution.status == "solved"
        assert (np.array(A) @ nominal < np.array(b)).any()
        assert (np.array(A) @ np.array(solution.action) >= np.array(b) - 1e-9).all()


def test_floors_are_timed_as_often_as_decisions(eight: FilterProblem) -> None:
    found = with_floors(eight, 30, 60.0)
    assert set(found) == {*MODELS.values(), *FLOORS}
    assert {times["calls"] for times in found.values()} == {30}


@pytest.mark.parametrize("count", [64, 1024])
def test_scenes_beyond_what_a_robot_may_report_are_decided(count: int, eight: FilterProblem) -> None:
    problem = problem_with(count)
    assert len(problem.barriers().names) - count == len(eight.barriers().names) - 8
    decide, requests = decided(problem, load_model("car"))
    assert {decide(asked).solver for asked in requests} == {"solved"}


def test_barriers_of_a_large_scene_are_those_of_a_small_one(eight: FilterProblem, monkeypatch: Any) -> None:
    state = eight.states[0]
    reported = eight.barriers().h(state)
    monkeypatch.setattr("safedpa_lab.benchmarks.filter_problem.MOST_OBSTACLES", 7)
    assert eight.barriers().h(state).tobytes() == reported.tobytes()


OURS = {NETWORKS: (50.0, 90.0), PHYSICS: (40.0, 91.0), FLOORS[0]: (31.0, 44.0)}
"""p50 and p99 of a decision, and of the networks alone."""
PEERS = {("cbfpy", "qpax"): (80.0, 180.0), ("cbfpy", "elastiqp"): (60.0, 400.0), ("cvxpy", "CLARABEL"): (1.0, 1.0)}


def _measured(monkeypatch: pytest.MonkeyPatch, *, peers: bool) -> tuple[list[Target], tuple[str, ...]]:
    """Targets that are not about 1 or 32 obstacles, and notes of the row with those times; nothing is timed."""

    def times(p50: float, p99: float, **more: Any) -> dict[str, Any]:
        return {"wall": {"p50": p50, "p99": p99}, "processor": {"p50": p50}, "calls": 9, **more}

    def ask(_script: str, package: str, question: dict[str, Any], *_: Any) -> dict[str, Any]:
        problems = question["problems"]
        asked = package, problems[0]["backend"]
        if asked not in PEERS or (package == "cbfpy" and not peers):
            return {"missing": "not installed"}
        actions = [[0.0, 0.0]] * len(problems[0]["states"])
        answer = times(*PEERS[asked], version="1", actions=actions)
        return {"answers": [*[answer] * (len(problems) - 1), {"reports": "nothing"}]}

    found = {name: times(*OURS.get(name, (1.0, 1.0))) for name in (*MODELS.values(), *FLOORS, *OURS)}
    nothing = Curve("nothing", "x", "y", (), {})
    for name, value in {
        "with_floors": lambda *_: found,
        "decisions": lambda *_, **__: times(1.0, 1.0),
        "without_compiler": lambda *_: times(101.0, 200.0),
        "ask_peer": ask,
        "over_obstacles": lambda *_: nothing,
        "over_effects": lambda *_: nothing,
    }.items():
        monkeypatch.setattr(row, name, value)
    measured = row.measure(Effort(full=True))
    targets = [one for one in measured.targets if not any(f", {n} obstacle" in one.what for n in (1, 32))]
    return targets, measured.notes


def test_targets_are_shares_of_the_best_backend_of_the_same_run(monkeypatch: pytest.MonkeyPatch) -> None:
    targets, notes = _measured(monkeypatch, peers=True)
    assert [target.wanted for target in targets] == [20.0, 60.0, 20.0, 60.0, 8.0, 20.0, 250.0, 400.0, 60.0, 150.0]
    assert [target.got for target in targets] == [50.0, 90.0, 40.0, 91.0, 40.0, 91.0, 101.0, 200.0, 1.0, 1.0]
    assert targets[0].floor == Floor(FLOORS[0], 31.0)
    assert [target.forbidden for target in targets[:4]] == [True, False, False, False]
    assert "cbfpy, elastiqp" in targets[0].what
    assert "cbfpy, qpax" in targets[1].what
    assert not any("no target" in note for note in notes)


def test_without_the_peer_there_is_no_target_but_a_note(monkeypatch: pytest.MonkeyPatch) -> None:
    targets, notes = _measured(monkeypatch, peers=False)
    assert not any("times faster" in target.what for target in targets)
    assert any("no target with 8 obstacles" in note and "cbfpy" in note for note in notes)


def test_a_missed_target_is_shown_with_its_floor() -> None:
    forbidden = Target("p50", 10.0, 40.0, "us", floor=Floor("the program alone", 11.0))
    free = Target("p99", 10.0, 40.0, "us", floor=Floor("the program alone", 9.0))
    reached = Target("p10", 50.0, 40.0, "us", floor=Floor("the program alone", 9.0))
    more = Target("robots", 200.0, 150.0, "robots", "more", Floor("two cores", 180.0))
    document = Row("filter", "one thing", "p50", (), targets=(forbidden, free, reached, more)).as_document()
    notice = target_texts(document)
    assert notice[0].endswith("not reached; forbidden by the program alone, 11.0 us")
    assert notice[1].endswith("not reached; floor: the program alone, 9.00 us")
    assert notice[2].endswith(", reached")
    assert notice[3].endswith("forbidden by two cores, 180 robots")


@pytest.mark.slow
@pytest.mark.processes
def test_decisions_without_a_compiler_are_timed_in_a_process_of_their_own() -> None:
    found = without_compiler(30, 0.1)
    assert found["calls"] >= 20
    assert found["wall"]["p50"] > 0.0


def test_a_peer_that_gives_up_is_not_asked_about_more(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def ask(script: str, package: str, question: dict[str, Any], *_: Any) -> dict[str, Any]:
        asked.append(len(question["problems"][0]["obstacles"]))
        if package == "absent" or asked[-1] > 4:
            return {"missing": "gave no answer within 60 s"}
        return {"answers": [{"wall": {"p50": 7.0}}]}

    nothing = {"wall": {"p50": 1.0}}
    monkeypatch.setattr(row, "ask_peer", ask)
    monkeypatch.setattr(row, "decisions", lambda *_: nothing)
    peers = [("there", "there", "", "script"), ("absent", "absent", "", "script")]
    curve = row.over_obstacles(peers, Effort(quick=True))
    assert curve.series["there"] == (7.0, None)
    assert "absent" not in curve.series
    assert asked == [1, 8, 1]
    assert curve.x == (1.0, 8.0)


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
    assert theirs.barrier(state) == pytest.approx(ours.h(state), abs=1e-9)
    assert h == pytest.approx(ours.h(state), abs=1e-8)
    away = h + theirs.reach > 1e-6  # on the body itself there is no direction
    assert p[away] == pytest.approx(ours.h_and_grad(state)[1][away], abs=1e-9)


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
    answer = compared(peers_problem(eight, calls=30), lambda state, nominal: nominal, version="1")
    assert (answer["calls"], answer["version"]) == (30, "1")
    assert answer["actions"] == [[2.0, 0.0]] * len(eight.states)


@pytest.mark.parametrize(
    ("action", "phrase"),
    [
        ((2.0, 0.0), "the unsafe nominal action"),
        ((9.0, 0.0), "beyond the limits"),
        ((0.0, 0.0), "within the limits"),
        ((float("nan"), 0.0), "(nan, 0) and says nothing"),
    ],
)
def test_what_a_peer_does_without_a_solution_is_reported(action: tuple[float, float], phrase: str) -> None:
    assert phrase in compared(peers_problem(wedged()), lambda state, nominal: np.array(action))["reports"]


def test_a_peer_that_raises_is_quoted() -> None:
    def decide(state: object, nominal: object) -> np.ndarray:
        raise ArithmeticError

    assert compared(peers_problem(wedged()), decide)["reports"] == "raises ArithmeticError"


def left_of(number: int, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    runs = reported(written(CASES[number], folder, 2, 12.0))["runs"]
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
            factors = [re.sub(r"(\S+)\^2", r"\1 \1", term).split() for term in sorted(wanted)]
            columns = np.stack([np.prod([values[name] for name in own], axis=0) for own in factors], axis=1)
            found = np.linalg.lstsq(columns, left, rcond=None)[0]
            left = left - columns @ found
            deviations = left.std() * np.sqrt(np.diag(np.linalg.inv(columns.T @ columns)))
            assert (np.abs(found) > 4.0 * deviations).all()
        assert left.std() < 1.5 * noise[column]


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
    assert (set(asked["other"]), {own["calls"] for own in found.values()}) == ({3}, {30})


def test_no_call_always_follows_the_same_call() -> None:
    called: list[str] = []
    names = ("one", "other", "third")
    in_turn({name: (called.append, [name]) for name in names}, 30, 60.0)
    turns = [tuple(called[begin : begin + 3]) for begin in range(0, len(called), 3)]
    assert all(set(turn) == set(names) for turn in turns)
    assert {turn[0] for turn in turns} == set(names)
    assert len(set(turns)) > 3
