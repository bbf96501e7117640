"""Verdicts at the edges: exact tolerances, limited rounds, rarer ways to an action, what could not be computed."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.internals.safety.test_batch_search import TWO, Problems

from safedpa.dynamics import PhysicsModel, Setting, fingerprint, load_model
from safedpa.effects import effect
from safedpa.runtime.calibrated_model import CalibratedModel, uncalibrated
from safedpa.runtime.robot_session import RobotSession
from safedpa.safety import (
    FilterSettings,
    FunctionBarrier,
    Prediction,
    QuadraticProgram,
    SafetyFilter,
    Solution,
    Status,
    Verdict,
)
from safedpa.safety import decision as decision_module
from safedpa.safety import decision as decisions
from safedpa.safety.defaults import settings_named
from safedpa.safety.prediction.dead_time import InFlightCommands
from safedpa.safety.solver.constraints import ActionCandidate, Constraints
from safedpa.safety.validation import FiniteClock
from safedpa.safety.verdict import resting_verdict
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene


def line_filter(wall: float = 1.0, **changes: object) -> SafetyFilter:
    """x[t+1] = x + a, h = wall - x, exact in binary: eta 1, so that the condition is h(x+) >= epsilon."""
    settings = FilterSettings(action_low=(-4.0,), action_high=(4.0,), epsilon=0.0, eta=1.0, **changes)  # type: ignore[arg-type]
    return SafetyFilter(lambda x: (x, np.eye(1)), [FunctionBarrier(lambda x: wall - x[0])], settings)


def test_what_leads_to_just_the_limit_is_kept_and_active_means_within_a_fiftieth_of_the_scale() -> None:
    safe = line_filter()
    assert safe.decide(np.zeros(1), [1.0]).status is Status.passed
    assert safe.decide(np.zeros(1), [1.0 + 1e-9]).status is Status.corrected
    # h now is 1: residuals up to 0.02.
    safe = line_filter()
    assert safe.decide(np.zeros(1), [0.9801]).active == ("h",)
    assert safe.decide(np.zeros(1), [0.9799]).active == ()


def test_backup_that_leads_to_just_the_limit_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decision_module, "solve_sqp", lambda conditions, program, nominal, start, *_: (start, "solved"))
    verdict = line_filter(wall=0.0).decide(np.zeros(1), [1.0])
    assert (verdict.status, verdict.reason) == (Status.corrected, "Found from another start than the nominal action.")
    assert verdict.action[0] == 0.0


def test_search_result_that_leads_to_just_the_limit_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    def found(conditions: Constraints, *_: object) -> tuple[ActionCandidate, str]:
        return conditions.evaluate((1.0,)), "solved"

    monkeypatch.setattr(decision_module, "solve_sqp", found)
    verdict = line_filter().decide(np.zeros(1), [2.0])
    assert (verdict.status, verdict.reason) == (Status.corrected, "")


@pytest.mark.parametrize("relinearisations", [0, 3])
def test_program_is_posed_once_and_then_as_often_as_allowed(monkeypatch: pytest.MonkeyPatch, relinearisations: int):
    """A solver whose answers all break the condition and never come again: the search gives up after the last round."""
    safe, calls = line_filter(relinearisations=relinearisations), []

    def stubborn(_: object, A: np.ndarray, b: np.ndarray, nominal: np.ndarray) -> Solution:
        calls.append(nominal)
        return Solution(np.array([2.0 - 0.01 * len(calls)]), np.zeros(1), True, "solved")

    monkeypatch.setattr(QuadraticProgram, "solve", stubborn)
    assert safe.decide(np.zeros(1), [2.0]).reason == "Found from another start than the nominal action."
    assert len(calls) == 3 * (relinearisations + 1)  # from the nominal action, then from two others


def test_what_could_not_be_computed_is_not_made_up() -> None:
    def raises(*_: object) -> np.ndarray:
        raise RuntimeError("no prediction")

    settings = FilterSettings(action_low=(-1.0,), action_high=(1.0,), epsilon=0.0)
    safe = SafetyFilter(lambda x: (x, np.eye(1)), [FunctionBarrier(lambda x: 3.0 - x[0])], settings, step=raises)
    for state, h_now in (([1.0], 2.0), (None, 0.0)):
        verdict = safe.decide(state, [0.5])
        assert verdict.status is Status.fallback
        assert (verdict.known, verdict.slack, verdict.h_now, verdict.h_next, verdict.active) == (
            False, 0.0, h_now, 0.0, (),
        )  # fmt: skip


def infeasible(start: float, backup: object = None, gain: float = 1.0) -> Verdict:
    """h = x, which falls by 3 whatever is done: larger actions let it fall less; the nominal action is -0.5."""
    settings = FilterSettings(action_low=(-1.0,), action_high=(1.0,), epsilon=0.0)
    safe = SafetyFilter(
        lambda x: (x - 3.0, np.array([[gain]])),
        [FunctionBarrier(lambda x: x[0])],
        settings,
        backup=backup,  # type: ignore[arg-type]
    )
    return safe.decide(np.array([start]), [-0.5])


def test_relaxed_takes_the_action_that_leaves_the_most() -> None:
    verdict = infeasible(5.0)
    assert verdict.status is Status.relaxed
    assert verdict.action[0] == pytest.approx(1.0, abs=0.02)
    assert verdict.reason == "Not satisfied: h."
    assert verdict.slack == pytest.approx(4.0 - verdict.h_next)
    assert verdict.h_next == pytest.approx(3.0, abs=0.02)
    assert verdict.active == ("h",)


@pytest.mark.parametrize("backup", [-1.0, 0.25, 1.0])
def test_violated_takes_the_action_that_raises_h_most_whatever_the_backup(backup: float) -> None:
    verdict = infeasible(-2.0, backup=lambda state: np.array([backup]))
    assert verdict.status is Status.violated
    assert verdict.action[0] == pytest.approx(1.0, abs=0.02)
    assert verdict.reason == "Below 0: h."
    assert verdict.h_now == -2.0
    assert verdict.h_next == pytest.approx(-4.0, abs=0.02)
    assert verdict.solver == "solved"
    assert verdict.intervened


@pytest.mark.parametrize(("start", "status"), [(5.0, Status.relaxed), (-2.0, Status.violated)])
def test_where_no_action_helps_within_one_step_the_backup_is_taken(start: float, status: Status) -> None:
    """All are equally unsafe by then: the backup is what is known to be good beyond."""
    verdict = infeasible(start, backup=lambda state: np.array([0.25]), gain=0.0)
    assert verdict.status is status
    assert verdict.action[0] == 0.25
    assert verdict.reason.endswith(" No action changes h within one step: the backup is used as the nominal action.")


@pytest.mark.parametrize(
    ("start", "status"), [(1e-12, Status.relaxed), (0.0, Status.relaxed), (-1e-12, Status.violated)]
)
def test_violated_begins_right_below_zero(start: float, status: Status) -> None:
    assert infeasible(start).status is status


def test_violated_names_all_that_is_below_zero_even_where_the_nominal_action_keeps_every_condition() -> None:
    """From -1 to -0.5 satisfies the condition and more, but the verdict must not say that all is well."""
    settings = FilterSettings(action_low=(-1.0,), action_high=(1.0,), epsilon=0.0)
    safe = SafetyFilter(lambda x: (x, np.eye(1)), [FunctionBarrier(lambda x: x[0])], settings)
    verdict = safe.decide(np.array([-1.0]), [0.5])
    assert verdict.status is Status.violated
    assert verdict.slack == 0.0
    assert verdict.action[0] == pytest.approx(1.0, abs=0.02)
    settings = FilterSettings(action_low=(-1.0,), action_high=(1.0,), epsilon=0.0)
    barrier = FunctionBarrier(lambda x: [x[0] - 1.0, x[0], -2.0 - x[0]], names=("a", "b", "c"))
    verdict = SafetyFilter(lambda x: (x, np.eye(1)), [barrier], settings).decide(np.zeros(1), [0.0])
    assert verdict.reason == "Below 0: a, c."


def test_relaxed_names_three_barriers_and_says_that_there_are_more() -> None:
    settings = FilterSettings(action_low=(-1.0,), action_high=(1.0,), epsilon=0.0)

    def reason(count: int) -> str:
        names = tuple(f"h{index}" for index in range(count))
        barrier = FunctionBarrier(lambda x: [1.0 + index + x[0] for index in range(count)], names=names)
        safe = SafetyFilter(lambda x: (x - 9.0, np.eye(1)), [barrier], settings)
        return safe.decide(np.zeros(1), [0.0]).reason

    assert reason(1) == "Not satisfied: h0."
    assert reason(3) == "Not satisfied: h0, h1, h2."
    assert reason(4) == "Not satisfied: h0, h1, h2, ...."


Values = NDArray[np.float64]


def test_an_action_brought_back_is_nearest_once_the_program_is_posed_from_there(monkeypatch: pytest.MonkeyPatch):
    """h = min(a_1, 1) + a_2 - 1.2: what was found stands on the plateau, at its edge the nearest is on the slope."""
    settings = FilterSettings(action_low=(0.0, 0.0), action_high=(4.0, 4.0), eta=1.0, epsilon=0.0)

    def step(x: Values, a: Values) -> Values:
        return np.array([min(a[0], 1.0), a[1]])

    def affine(x: Values, around: Values) -> tuple[Values, Values]:
        g = np.diag([float(around[0] <= 1.0), 1.0])
        return step(x, around) - g @ around, g

    gradient = np.array([1.0, 1.0])
    barrier = FunctionBarrier(lambda x: x[0] + x[1] - 1.2, lambda x: gradient)
    found, searched = [(2.0, 0.5)], decisions.solve_sqp

    def far_at_first(conditions: Any, *rest: Any) -> Any:
        return (conditions.evaluate(found.pop()), "solved") if found else searched(conditions, *rest)

    monkeypatch.setattr(decisions, "solve_sqp", far_at_first)
    verdict = SafetyFilter(Prediction(affine, step), [barrier], settings).decide((1.0, 1.0), (0.1, 0.1))
    assert verdict.status is Status.corrected
    np.testing.assert_allclose(verdict.action, (0.6, 0.6), atol=1e-6)


@pytest.mark.parametrize(
    ("seed", "bend", "most", "rows", "robot"),
    [(3, 1.5, 2.0, 2, 8), (5, 1.5, 2.0, 2, 16), (6, 0.5, 1.2, 3, 41), (8, 1.5, 2.0, 2, 53), (9, 0.5, 1.2, 3, 45)],
)
def test_a_feasible_action_next_to_the_least_broken_of_many_is_found(seed, bend, most, rows, robot):
    """Islands that neither the tangents nor the lattice meet, in front of a saturated actuator."""
    problems = Problems(seed, 60, TWO, bend, most, rows)

    def step(x: Values, action: Values) -> Values:
        return problems.moved(robot, x, action)

    def affine(x: Values, around: Values) -> tuple[Values, Values]:
        g = problems.g(robot, around)
        return step(x, around) - g @ around, g

    names = tuple(f"h{row}" for row in range(rows))
    barrier = FunctionBarrier(lambda x: problems.heights(robot, x), lambda x: problems.gradient(robot, x), names)
    state = problems.state[robot]
    verdict = SafetyFilter(Prediction(affine, step), [barrier], TWO).decide(state, problems.nominal[robot])
    assert (verdict.status, verdict.reason) == (
        Status.corrected,
        "Found by a search around the least-violation sample.",
    )
    now, then = barrier.h(state), barrier.h(step(state, verdict.action))
    assert (then >= (1.0 - TWO.eta) * now + 0.01 - 1e-9 * np.abs(now)).all()


LATE = load_model("car").with_effect(effect("car", "actuator_delay"), {"seconds": Setting(0.2)})
HELD = (1.0, 0.0)


def decided(low: float, state: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)) -> tuple[Verdict, Verdict]:
    """Past a pillar that is passed before this action acts, h = ``low`` inside and 1 elsewhere; and without it."""
    memory = LATE.initial_memory(np.array(HELD))
    inside = FunctionBarrier(lambda x: low if 0.08 < x[0] < 0.17 else 1.0)
    free = FunctionBarrier(lambda x: 1.0)
    found = [
        SafetyFilter.for_model(LATE, FilterSettings.for_robot("car", epsilon=0.0), barriers=[barrier]).decide(
            state, HELD, LATE.latent, memory=InFlightCommands(memory, HELD)
        )
        for barrier in (inside, free)
    ]
    return found[0], found[1]


def test_a_collision_before_the_action_acts_is_reported() -> None:
    verdict, free = decided(-0.2)
    assert (free.status, free.h_next) == (Status.passed, 1.0)
    assert (verdict.status, verdict.h_next) == (Status.relaxed, -0.2)
    assert verdict.reason == "Some h falls below 0 before this action takes effect."
    np.testing.assert_array_equal(verdict.action, free.action)


@pytest.mark.parametrize("low", [0.0, 0.3])
def test_a_narrow_pass_before_the_action_acts_is_reported_and_nothing_is_given_up(low: float) -> None:
    verdict, _ = decided(low)
    assert (verdict.status, verdict.h_next, verdict.reason) == (Status.passed, low, "")


def test_another_verdict_keeps_its_own_reason() -> None:
    """Below 0 now and on the way: it says which h that is."""
    verdict, _ = decided(-0.2, (0.1, 0.0, 0.0, 1.0))
    assert verdict.status is Status.violated
    assert verdict.h_next == -0.2
    assert "falls below" not in verdict.reason


SETTINGS = FilterSettings(
    action_low=(-1.0,), action_high=(1.0,), backup_action=(0.5,), eta=0.5, epsilon={"default": 0.0}
)


SAFE = SafetyFilter(lambda x: (x - 0.1, np.eye(1)), [FunctionBarrier(lambda x: x[0])], SETTINGS)
"""It drifts down by 0.1 a tick; h is the height; the backup goes up."""


@pytest.mark.parametrize(
    ("height", "action", "status"),
    [
        (3.0, 0.5, Status.corrected),  # the resting action passes, but no one requested it
        (0.05, 0.5, Status.corrected),
        (-3.0, 1.0, Status.violated),
    ],
)
def test_the_resting_action_stands_in_for_the_nominal_action(height: float, action: float, status: Status) -> None:
    verdict = SAFE.hold("the nominal action is stale", np.array([height]))
    assert verdict.status is status
    assert verdict.action[0] == pytest.approx(action, abs=0.01)
    assert verdict.nominal is None
    assert verdict.reason.endswith("The nominal action is stale: the resting action stood in for it.")
    assert verdict.known


def test_with_anything_else_amiss_it_is_the_fallback() -> None:
    verdict = SAFE.hold("the nominal action is stale", np.array([np.nan]))
    assert verdict.status is Status.fallback
    assert verdict.nominal is None
    assert "stood in" not in verdict.reason
    assert "state" in verdict.reason


@pytest.mark.parametrize("now", [0.0, 12.5, -3.0, 1e15, -1e15])
def test_a_finite_time_is_passed_on_unchanged(now: float) -> None:
    assert FiniteClock(lambda: now)() == now


@pytest.mark.parametrize("now", [1.01e15, -1.01e15, 1e300, -1e300, math.inf, -math.inf, math.nan, "noon", None])
def test_what_can_be_no_time_is_0(now: object) -> None:
    assert FiniteClock(lambda: now)() == 0.0


def delayed() -> PhysicsModel:
    return load_model("car").with_effect(effect("car", "actuator_delay"), {"seconds": Setting(0.2)})


@pytest.mark.parametrize("late", [True, False])
def test_with_a_delay_the_next_tick_says_nothing_of_the_nominal_action(late: bool, monkeypatch: pytest.MonkeyPatch):
    """Commands in flight raise h; because of that the nominal action, which acts later, would be passed on."""
    model, settings = delayed() if late else load_model("car"), settings_named("car")
    own = fingerprint(model)
    memory = RobotSession.create(CalibratedModel(model, own, uncalibrated(settings, own)), settings)
    state = CarRobot(Scene.random(3, "none"), 0.05).state_message()
    memory.barriers = memory.scene.of(state)
    if late:
        memory.pending = InFlightCommands(model.initial_memory(np.array([0.0, 0.0])), (0.0, 0.0))
    resting: Any = resting_verdict(np.zeros(2), "none")
    relaxed = type(resting)(**{**vars(resting), "status": Status.relaxed, "nominal": np.array([0.5, 0.0])})
    found = memory.escape_boundary_layer(state, relaxed, model.latent)
    assert (found is relaxed) is late


def test_it_rests_knows_nothing_and_says_why() -> None:
    rest = np.array([0.0, 0.1])
    verdict = resting_verdict(rest, "no state has the right length")
    assert verdict.status is Status.fallback
    assert verdict.intervened
    assert "Reason: no state has the right length." in verdict.sentence
    reported = verdict.as_dict()
    assert reported["action"] == [0.0, 0.1]
    assert {name: reported[name] for name in ("slack", "h_now", "h_next", "margin", "microseconds")} == {
        "slack": 0.0, "h_now": 0.0, "h_next": 0.0, "margin": 0.0, "microseconds": 0.0,
    }  # fmt: skip
    assert (reported["active"], reported["nominal"], reported["known"], reported["solver"]) == (
        [],
        None,
        False,
        "not run",
    )


def test_its_action_is_a_copy() -> None:
    rest = np.zeros(2)
    verdict = resting_verdict(rest, "no one is there")
    rest[0] = 9.0
    assert verdict.action.tolist() == [0.0, 0.0]
    with pytest.raises(ValueError, match="read-only"):
        verdict.action[0] = 1.0
