"""Bad numbers, missing inputs, failing functions and solvers: always a verdict, never open."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.dynamics import PhysicsModel, Setting
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.safety import FilterSettings, FunctionBarrier, Plausible, SafetyFilter, Solution, Status, Verdict
from safedpa.safety import decision as decision_module
from safedpa.safety.validation import InvalidInput, checked_input

GOOD = np.array([0.0, 0.0, 0.0, 0.5])
NOMINAL = np.array([0.4, 0.1])
CAR = FilterSettings.for_robot("car")


class Awkward:
    def __array__(self, *_: Any, **__: Any) -> np.ndarray:
        raise RuntimeError("cannot be read")


BAD_STATES = [
    (None, "state is missing"),
    ([1.0, 2.0, 3.0, math.nan], "state holds NaN or infinity"),
    ([1.0, -math.inf, 3.0, 0.0], "state holds NaN or infinity"),
    ([1.0, 2.0], r"state has shape (2,), wanted (4,)"),
    ([[0.0, 0.0, 0.0, 0.5]], r"state has shape (1, 4), wanted (4,)"),
    (3.0, r"state has shape (), wanted (4,)"),
    ("fast", "state does not consist of numbers"),
    ([1.0, None, "x", 2], "state does not consist of numbers"),
    (Awkward(), "state does not consist of numbers"),
    ([0.0, 0.0, 0.0, 31.0], "state is out of its plausible range: speed = 31, wanted -30 to 30"),
    ([0.0, -2e4, 0.0, 0.0], "state is out of its plausible range: y = -20000, wanted -10000 to 10000"),
]
BAD_NOMINAL_ACTIONS = [
    (None, "nominal is missing"),
    ([math.nan, 0.0], "nominal holds NaN or infinity"),
    ([0.0, math.inf], "nominal holds NaN or infinity"),
    ([0.0], "nominal has shape (1,), wanted (2,)"),
    ([[0.0, 0.0]], "nominal has shape (1, 2), wanted (2,)"),
    ([{}, 0.0], "nominal does not consist of numbers"),
    ([30.0, 0.0], "nominal is out of its plausible range: entry 0 = 30, wanted -26.6 to 28"),
    ([0.0, -8.0], "nominal is out of its plausible range: entry 1 = -8, wanted -7.14 to 7.14"),
]


def assert_brakes(verdict: Verdict, reason: str) -> None:
    assert verdict.status is Status.fallback
    assert reason in verdict.reason
    np.testing.assert_array_equal(verdict.action, [0.0, 0.0])
    assert np.isfinite([verdict.slack, verdict.h_now, verdict.h_next, verdict.margin]).all()
    assert verdict.slack >= 0.0
    assert verdict.intervened


@pytest.mark.parametrize(("state", "reason"), BAD_STATES)
def test_bad_state(car_filter: SafetyFilter, state: Any, reason: str) -> None:
    verdict = car_filter.decide(state, NOMINAL)
    assert_brakes(verdict, reason)
    assert not verdict.known
    np.testing.assert_array_equal(verdict.nominal, NOMINAL)


@pytest.mark.parametrize(("nominal", "reason"), BAD_NOMINAL_ACTIONS)
def test_bad_nominal_action(car_filter: SafetyFilter, nominal: Any, reason: str) -> None:
    verdict = car_filter.decide(GOOD, nominal)
    assert_brakes(verdict, reason)
    assert verdict.known
    assert verdict.nominal is None
    assert verdict.h_now > 0.0
    assert verdict.margin == 0.01


def test_edges_of_the_plausible_range_are_believed_and_of_several_problems_all_are_named(car_filter: SafetyFilter):
    assert car_filter.decide(GOOD, [28.0, 0.0]).status is not Status.fallback
    assert car_filter.decide([0.0, 0.0, 0.0, 30.0], NOMINAL).status is not Status.fallback
    verdict = car_filter.decide(None, [math.nan, 1.0], stale=["latent"])
    assert verdict.reason == "Reason: latent is stale; state is missing; nominal holds NaN or infinity."
    assert verdict.solver == "not run"


def test_a_latent_that_the_model_needs(car: PhysicsModel) -> None:
    free = car.with_settings({"base.speed_gain": Setting(4.0, free=True)})
    safe = SafetyFilter.for_model(free, CAR, car_barriers(CAR, (0.08, 0.4, 0.12), [(2.0, 0.0, 0.3)]))
    assert safe.decide(GOOD, NOMINAL, [4.0]).status is Status.passed
    for latent, reason in (
        (None, "latent is missing"),
        ([math.nan], "latent holds NaN"),
        ([1.0, 2.0], "latent has shape (2,), wanted (1,)"),
        ([-3.0], "latent is out of its plausible range: base.speed_gain = -3"),
        ([51.0], "wanted 0.05 to 50"),
    ):
        verdict = safe.decide(GOOD, NOMINAL, latent)
        assert_brakes(verdict, reason)
        assert not verdict.known


@pytest.mark.parametrize("name", ["state", "nominal", "latent", "scene"])
def test_stale_inputs_bring_the_backup(car_filter: SafetyFilter, name: str) -> None:
    verdict = car_filter.decide(GOOD, NOMINAL, stale=[name])
    assert_brakes(verdict, f"{name} is stale")
    assert verdict.known is (name != "state")


def test_a_stale_state_does_not_reach_the_backup(car: PhysicsModel) -> None:
    seen: list[Any] = []

    def backup(state: Any) -> np.ndarray:
        seen.append(state)
        return np.array([0.0, 0.1])

    safe = SafetyFilter.for_model(car, CAR, car_barriers(CAR, (0.08, 0.4, 0.12), []), backup=backup)
    np.testing.assert_array_equal(safe.decide(GOOD, NOMINAL, stale=["state"]).action, [0.0, 0.1])
    np.testing.assert_array_equal(safe.decide(None, NOMINAL).action, [0.0, 0.1])
    assert seen == [None, None, None]  # the first when the filter was made
    safe.decide(GOOD, None)
    np.testing.assert_array_equal(seen[3], GOOD)


@pytest.mark.parametrize("stale", [None, 5, "state", {"state": 1}], ids=repr)
def test_if_it_is_unclear_what_is_stale_the_state_is_not_trusted(car: PhysicsModel, stale: Any) -> None:
    safe = SafetyFilter.for_model(
        car, CAR, car_barriers(CAR, (0.08, 0.4, 0.12), []), backup=lambda state: [0.1, 0.0 if state is None else 0.3]
    )
    verdict = safe.decide(GOOD, NOMINAL, stale=stale)
    assert (verdict.status, verdict.reason) == (Status.fallback, "Reason: stale is no list of names.")
    assert verdict.action.tolist() == [0.1, 0.0]
    assert not verdict.known


@pytest.mark.parametrize(
    ("nominal", "reason"),
    [(None, "nominal is missing"), ([math.nan, 0.0], "nominal holds NaN or infinity")],
    ids=repr,
)
def test_without_a_nominal_action_even_a_filter_that_is_switched_off_takes_the_backup(car, nominal, reason):
    off = replace(CAR, enabled=False)
    safe = SafetyFilter.for_model(car, off, car_barriers(off, (0.08, 0.4, 0.12), []), backup=lambda _: [0.1, 0.2])
    verdict = safe.decide(GOOD, nominal)
    assert (verdict.status, verdict.reason) == (Status.fallback, f"Reason: {reason}.")
    assert verdict.action.tolist() == [0.1, 0.2]
    assert verdict.known


@pytest.mark.parametrize(
    "result",
    [RuntimeError("no"), np.array([math.nan, 0.0]), np.array([0.0]), "nonsense", ["0.9", "0.9"],
     np.ma.array([0.9, 0.9], mask=True), None],
    ids=str,
)  # fmt: skip
def test_a_failing_backup_is_replaced_by_the_resting_action(car: PhysicsModel, result: Any) -> None:
    def backup(state: Any) -> Any:
        if isinstance(result, Exception):
            raise result
        return np.zeros(2) if state is None else result

    safe = SafetyFilter.for_model(car, CAR, car_barriers(CAR, (0.08, 0.4, 0.12), []), backup=backup)
    assert_brakes(safe.decide(GOOD, None), "nominal is missing")


def test_a_backup_beyond_the_actuator_is_clipped_and_without_one_the_settings_say_where_to_rest(car: PhysicsModel):
    safe = SafetyFilter.for_model(car, CAR, backup=lambda _: np.array([-9.0, 9.0]))
    np.testing.assert_array_equal(safe.decide(GOOD, None).action, [-0.6, 0.34])
    resting = FilterSettings.for_robot("car", backup_action=(-0.2, 0.05))
    np.testing.assert_array_equal(SafetyFilter.for_model(car, resting).decide(None, None).action, [-0.2, 0.05])
    away = FilterSettings(action_low=(0.5,), action_high=(1.0,))
    safe = SafetyFilter(lambda x: (x, np.eye(1)), None, away)
    np.testing.assert_array_equal(safe.decide(None, None).action, [0.5])


def scalar_filter(**changes: Any) -> SafetyFilter:
    parts: dict[str, Any] = {
        "affine": lambda x: (x, np.eye(1)),
        "barriers": [FunctionBarrier(lambda x: 1.0 - x[0])],
        "settings": FilterSettings(action_low=(-1.0,), action_high=(1.0,), epsilon=0.0),
    }
    return SafetyFilter(**{**parts, **changes})


def raises(*_: Any) -> Any:
    raise ZeroDivisionError("user's own")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"affine": raises}, "ZeroDivisionError: user's own"),
        ({"affine": lambda x: (x, np.eye(1)), "step": raises}, "ZeroDivisionError: user's own"),
        ({"barriers": [FunctionBarrier(raises)]}, "ZeroDivisionError: user's own"),
        ({"barriers": [FunctionBarrier(lambda x: 1.0 - x[0], raises)]}, "ZeroDivisionError: user's own"),
        ({"affine": lambda x: (x * math.nan, np.eye(1))}, "no finite number for any action"),
        ({"step": lambda x, a: np.full(1, math.inf)}, "no finite number for any action"),
        ({"barriers": [FunctionBarrier(lambda x: math.nan)]}, "h at the state: got NaN"),
        ({"barriers": [FunctionBarrier(lambda x: 1.0 - x[0], lambda x: [math.nan])]}, "gradient of h: got NaN"),
        (
            {"step": lambda x, a: x + 2.0, "barriers": [FunctionBarrier(lambda x: 0.4 if x[0] < 1.0 else math.inf)]},
            "no finite number for any action",
        ),
    ],
)
def test_failing_functions_of_the_user(changes: dict[str, Any], reason: str) -> None:
    verdict = scalar_filter(**changes).decide(np.zeros(1), [1.0])
    assert verdict.status is Status.fallback
    assert reason in verdict.reason
    np.testing.assert_array_equal(verdict.action, [0.0])


@pytest.mark.parametrize(
    "changes",
    [
        {"step": lambda x, a: x + a, "affine": lambda x: (x, np.full((1, 1), math.nan))},
        {"step": lambda x, a: x + a if a[0] < 0.5 else x * math.nan},
        {"barriers": [FunctionBarrier(lambda x: 1.0 - x[0] if x[0] < 0.5 else math.inf, lambda x: [-1.0])]},
    ],
)
def test_where_the_way_from_the_nominal_action_has_no_numbers_another_is_gone(changes: dict[str, Any]) -> None:
    """Slopes, a next state or an h at the nominal action that are no numbers: other actions are predicted and kept."""
    verdict = scalar_filter(**changes).decide(np.zeros(1), [1.0])
    assert verdict.status is Status.corrected
    assert verdict.known
    assert 0.0 <= verdict.action[0] <= 0.2
    assert verdict.h_next == 1.0 - verdict.action[0]


def test_failure_half_way_still_reports_h() -> None:
    verdict = scalar_filter(barriers=[FunctionBarrier(lambda x: 1.0 - x[0], raises)]).decide(np.zeros(1), [1.0])
    assert verdict.known
    assert (verdict.h_now, verdict.h_next) == (1.0, 1.0)


def program_reports(monkeypatch: pytest.MonkeyPatch, safe: SafetyFilter, *solutions: Solution) -> None:
    """The program's answers, one after the other, the last one again and again."""
    left = list(solutions)
    monkeypatch.setattr(safe.tools.program.__class__, "solve", lambda *_: left.pop(0) if len(left) > 1 else left[0])


def solution(action: float, solved: bool = True, status: str = "solved") -> Solution:
    return Solution([action], [0.0], solved, status)


GIVEN_UP = solution(0.1, False, "max iter reached")


@pytest.mark.parametrize("useless", [GIVEN_UP, solution(math.nan), solution(math.inf)], ids=["gives up", "nan", "inf"])
def test_a_solver_that_gives_up_is_replaced_by_another_road(monkeypatch: pytest.MonkeyPatch, useless: Solution) -> None:
    """From the backup, which satisfies the condition, as far towards the nominal action as it allows: 0.2 would be the
    nearest."""
    safe = scalar_filter()
    program_reports(monkeypatch, safe, useless)
    verdict = safe.decide(np.zeros(1), [1.0])
    assert verdict.status is Status.corrected
    assert verdict.solver == useless.status
    assert verdict.known
    assert 0.15 < verdict.action[0] <= 0.2
    assert verdict.h_next == 1.0 - verdict.action[0]
    assert verdict.slack == 0.0


@pytest.mark.parametrize("beyond", [1.1, 7.0, -1.00001])
def test_a_solution_beyond_the_bounds_is_judged_at_the_bounds(monkeypatch: pytest.MonkeyPatch, beyond: float) -> None:
    safe = scalar_filter()
    program_reports(monkeypatch, safe, solution(beyond))
    verdict = safe.decide(np.zeros(1), [1.0])
    assert verdict.status is Status.corrected
    assert 0.15 < verdict.action[0] <= 0.2
    assert verdict.h_next >= 0.8


def never_kept(**changes: Any) -> SafetyFilter:
    """h = 1 - x, and x moves to 0.5 + a / 5 at least: the condition asks for h of 0.8."""
    parts: dict[str, Any] = {"affine": lambda x: (x + 0.5, np.array([[0.2]])), **changes}
    return scalar_filter(**parts)


def test_where_nothing_is_kept_and_the_solver_gives_up_the_least_unsafe_is_still_found(monkeypatch: pytest.MonkeyPatch):
    """By the linear program; and where that gives up as well, among the corners of the range."""
    safe = never_kept()
    program_reports(monkeypatch, safe, GIVEN_UP)
    verdict = safe.decide(np.zeros(1), [1.0])
    assert verdict.status is Status.relaxed
    assert verdict.action[0] == pytest.approx(-1.0, abs=0.01)
    assert verdict.solver == "max iter reached"
    monkeypatch.setattr(safe.tools.maximin_lp.__class__, "solve", lambda *_: None)
    blind = safe.decide(np.zeros(1), [1.0])
    assert blind.status is Status.relaxed
    assert blind.action[0] == -1.0
    assert blind.h_next == pytest.approx(0.7)
    assert blind.slack == pytest.approx(0.1)


def test_a_backup_that_keeps_all_while_every_solver_gives_up_is_predicted(monkeypatch: pytest.MonkeyPatch) -> None:
    """No action on the way from it to the nominal action satisfies the condition: the backup itself, as a correction,
    with its h."""
    safe = scalar_filter(affine=lambda x: (x + 0.1, np.array([[0.2]])), backup=lambda state: np.array([0.5]))
    program_reports(monkeypatch, safe, GIVEN_UP)
    verdict = safe.decide(np.zeros(1), [1.0])
    assert verdict.status is Status.corrected
    assert verdict.action[0] == 0.5
    assert verdict.h_next == pytest.approx(0.8)
    assert verdict.known


def test_below_zero_a_solver_that_gives_up_leaves_the_best_of_what_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    safe = scalar_filter()
    program_reports(monkeypatch, safe, GIVEN_UP)
    monkeypatch.setattr(safe.tools.maximin_lp.__class__, "solve", lambda *_: None)
    verdict = safe.decide(np.array([2.0]), [1.0])
    assert verdict.status is Status.violated
    assert verdict.action[0] == -1.0
    assert (verdict.h_now, verdict.h_next) == (-1.0, 0.0)


def test_search_that_finds_nothing_goes_from_the_backup_towards_the_nominal_action(monkeypatch: pytest.MonkeyPatch):
    """The QP misleads, always: what the backup leads to is taken as far as the condition allows, and said."""
    safe = scalar_filter()
    program_reports(monkeypatch, safe, solution(0.9))
    verdict = safe.decide(np.zeros(1), [1.0])
    assert verdict.status is Status.corrected
    assert verdict.reason == "Found from another start than the nominal action."
    assert 0.15 < verdict.action[0] <= 0.2


def test_a_backup_that_breaks_the_condition_is_no_place_to_go_from(monkeypatch: pytest.MonkeyPatch) -> None:
    """The backup 0.9 breaks it, the QP misleads: the linear program finds one that keeps it."""
    safe = scalar_filter(backup=lambda state: np.array([0.9]))
    program_reports(monkeypatch, safe, solution(0.9))
    verdict = safe.decide(np.zeros(1), [1.0])
    assert verdict.status is Status.corrected
    assert verdict.reason == "Found from another start than the nominal action."
    assert verdict.action[0] <= 0.2


def test_second_search_from_the_backup(monkeypatch: pytest.MonkeyPatch) -> None:
    original, calls = decision_module.solve_sqp, []

    def first_fails(conditions: Any, program: Any, nominal: Any, start: Any, rounds: int) -> Any:
        calls.append(start.action[0])
        if len(calls) == 1:
            return start, "solved"
        return original(conditions, program, nominal, start, rounds)

    monkeypatch.setattr(decision_module, "solve_sqp", first_fails)
    verdict = scalar_filter().decide(np.zeros(1), [1.0])
    assert verdict.reason == "Found from another start than the nominal action."
    assert verdict.action[0] == pytest.approx(0.2)
    assert calls[0] == 1.0
    assert (
        0.15 < calls[1] <= 0.2
    )  # towards the nominal action as far as is kept: tangents there are those of the nearest action


numbers = st.one_of(st.floats(), st.integers(), st.none(), st.booleans(), st.text(max_size=3))
anything = st.one_of(numbers, st.lists(numbers, max_size=6), st.lists(st.floats(), min_size=2, max_size=4))


@settings(derandomize=True, deadline=None, database=None, max_examples=300)
@given(anything, anything, anything, st.sampled_from([None, 3, "x"]))
def test_whatever_comes_in_a_verdict_goes_out(state: Any, nominal: Any, latent: Any, memory: Any) -> None:
    safe = SafetyFilter(
        lambda x, z: (x, np.eye(len(x))[:, :2]),
        [FunctionBarrier(lambda x: 3.0 - x[0])],
        replace(CAR, system=""),
        state_range=Plausible(np.full(4, -9.0), np.full(4, 9.0), ("a", "b", "c", "d")),
    )
    verdict = safe.decide(state, nominal, latent, memory=memory)
    assert (verdict.action >= CAR.low).all()
    assert (verdict.action <= CAR.high).all()
    assert np.isfinite([verdict.slack, verdict.h_now, verdict.h_next, verdict.margin, verdict.microseconds]).all()


def test_checked_input_gives_plain_numbers_or_a_reason() -> None:
    checked = checked_input("it", np.array([1, 2], dtype=np.float32), None)
    assert checked == (1.0, 2.0)
    assert isinstance(checked, tuple)
    assert all(type(entry) is float for entry in checked)
    assert checked_input("it", [[1.0]], None) == InvalidInput("it has shape (1, 1), wanted one axis")


def test_one_range_may_be_given_for_all_entries_but_none_that_leaves_entries_out() -> None:
    broad = Plausible(np.array([0.0]), np.array([1.0]), ("a", "b"))
    assert checked_input("x", [0.5, 1.0], broad) == (0.5, 1.0)
    refused = checked_input("x", [0.5, 1.5], broad)
    assert refused == InvalidInput("x is out of its plausible range: b = 1.5, wanted 0 to 1")
    with pytest.raises(ValueError, match="broadcast"):
        checked_input("x", [0.5, 0.5, 0.5], Plausible(np.zeros(2), np.ones(2), ("a", "b", "c")))
