"""What the filter keeps of a robot that stands, of its escape, of another model, and of dead times."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.internals.safety.robot_memory import decided_of, driven, reported, verdict_of
from tests.safety.node_steps import CAR, SETTINGS, state_at

from safedpa.dynamics import PhysicsModel, Setting
from safedpa.effects import effect
from safedpa.errors import InputError
from safedpa.runtime.robot_session import RobotSession
from safedpa.safety import Status, Verdict
from safedpa.safety.deadlock.escape import TickContext
from safedpa.safety.prediction.command_history import CommandHistory
from safedpa.safety.prediction.dead_time import MAX_PERIODS, ActuatorModel, DeadTime


# whether it stands
@pytest.mark.parametrize("status", [Status.passed, Status.disabled, Status.corrected, Status.relaxed])
def test_what_is_promised_under_the_nominal_action_is_asked_of_the_model_where_the_nominal_action_did_not_go_out(
    monkeypatch: pytest.MonkeyPatch, status: Status
) -> None:
    memory, state = driven(), state_at(0)
    assert memory.decision is not None
    verdict = verdict_of(memory, status=status, nominal=np.array((9.0, 0.1)), action=np.array((0.2, 0.0)))
    memory.decision = memory.decision._replace(verdict=verdict)
    clipped = np.clip((9.0, 0.1), SETTINGS.low, SETTINGS.high)
    promises = list[Any]()
    memory.deadlock_detector.expect = lambda *rows: promises.append(rows)
    path = ((0.3, 0.0, 0.0, 0.5), (0.6, 0.0, 0.0, 0.5))
    memory.watch_deadlock(state, path)
    ((here, nominal_next, expected),) = promises
    assert here == state.values
    assert expected == path[0]
    if status in (Status.passed, Status.disabled):
        assert nominal_next == path[0]
    else:
        assert nominal_next == pytest.approx(
            CAR.rollout_held(np.array(here), clipped, (), CAR.latent, 1, period=0.05)[0][0]
        )


@pytest.mark.parametrize(
    ("nominal", "known", "interrupted"),
    [((1.0, 0.0), True, False), ((1.0, 0.0), False, True), ((0.0, 0.0), True, True)],
)
def test_a_robot_without_a_nominal_action_or_without_a_prediction_is_not_standing_in_vain(nominal, known, interrupted):
    memory = driven()
    assert memory.decision is not None
    verdict = verdict_of(memory, status=Status.corrected, nominal=np.array(nominal))
    memory.decision = memory.decision._replace(verdict=verdict)
    notice = list[str]()
    memory.deadlock_detector.expect = lambda *_: notice.append("promise")
    memory.deadlock_detector.interrupt = lambda: notice.append("interrupted")
    memory._next = lambda *_: ((0.1, 0.0, 0.0, 0.5),) if known else ()
    memory.watch_deadlock(state_at(0), ((0.3, 0.0, 0.0, 0.5),))
    assert notice == ["interrupted" if interrupted else "promise"]


@pytest.mark.parametrize(
    ("status", "failed", "rests", "given_up"),
    [
        (Status.corrected, 1.0, Status.passed, True), (Status.passed, 1.0, Status.passed, False),
        (Status.fallback, 1.0, Status.passed, False), (Status.corrected, 0.0, Status.passed, False),
        (Status.corrected, 1.0, Status.corrected, False), (Status.corrected, 1.0, Status.relaxed, False),
    ],
)  # fmt: skip
def test_a_correction_that_moves_nothing_is_given_up_for_a_rest_that_is_safe(status, failed, rests, given_up):
    memory = driven()
    memory.deadlock_detector.failed_displacement = failed
    verdict, resting = verdict_of(memory, status=status), verdict_of(memory, status=rests, action=np.zeros(2))
    found = memory.rest_in_dead_band(state_at(1), verdict, CAR.latent, lambda: resting)
    if given_up:
        assert (found.status, found.action.tolist()) == (Status.corrected, [0.0, 0.0])
        assert found.nominal is verdict.nominal
        assert "dead band" in found.reason
    else:
        assert found is verdict


@pytest.mark.parametrize(("failed", "known", "rests"), [(0.024, True, False), (0.026, True, True), (1.0, False, False)])
def test_a_correction_that_leads_further_than_what_failed_is_tried(failed: float, known: bool, rests: bool) -> None:
    """At 0.5 m/s a tick of 0.05 s leads 0.025 m further; and of what nothing is foreseen nothing is given up."""
    robot = driven()
    assert robot.decision is not None
    if not known:
        robot._next = lambda *_: ()
    robot.deadlock_detector.failed_displacement = failed
    state, verdict = robot.decision.state, robot.decision.verdict
    correction = replace(verdict, status=Status.corrected, action=np.array((0.5, 0.0)))
    resting = replace(verdict, status=Status.passed, action=np.zeros(2))
    found = robot.rest_in_dead_band(state, correction, CAR.latent, lambda: resting)
    assert tuple(found.action.tolist()) == ((0.0, 0.0) if rests else (0.5, 0.0))


@pytest.mark.parametrize(("h_now", "binds"), [(1.0, False), (0.999, True), (1.001, False)])
def test_a_margin_binds_where_less_is_left_than_it_asks_for(h_now: float, binds: bool) -> None:
    memory, notice = driven(), list[Any]()
    memory.deadlock_detector.reason = lambda *known: notice.append(known) or "why"
    assert memory.stationary_reason(verdict_of(memory, h_now=h_now, margin=SETTINGS.eta)) == "why"
    assert [known[2] for known in notice] == [binds]


@pytest.mark.parametrize("straight", [True, False])
def test_the_next_state_is_one(monkeypatch: pytest.MonkeyPatch, straight: bool) -> None:
    memory, state, action = driven(), state_at(1), np.array((0.5, 0.1))
    wanted = CAR.rollout_held(np.array(state.values), action, (), CAR.latent, 1, period=0.05)[0]
    for _ in range(1000):  # a model that is asked often is recorded
        found = memory.model.scalar_step(0.05)
    assert found is not None
    if not straight:
        monkeypatch.setattr(PhysicsModel, "scalar_step", lambda *_: None)
    rows = memory._next(state, action, CAR.latent)
    assert len(rows) == 1
    np.testing.assert_allclose(rows, wanted, atol=1e-12)


def test_a_next_state_with_a_number_that_is_none_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PhysicsModel, "scalar_step", lambda *_: None)
    monkeypatch.setattr(PhysicsModel, "rollout_held", lambda *_, **__: (np.array(((0.0, 0.0, 0.0, np.nan),)), ()))
    assert driven()._next(state_at(1), np.zeros(2), CAR.latent) == ()


# the escape, and the trial of another model
@pytest.mark.parametrize("quick", [True, False])
def test_for_how_long_it_stood_counts_where_a_robot_is_quick(monkeypatch: pytest.MonkeyPatch, quick: bool) -> None:
    memory, given = driven(), list[float]()
    memory.deadlock_detector.seconds, memory.quick = 7.0, quick
    monkeypatch.setattr(type(memory.escape), "may_replace", lambda *_: True)

    def instead_of(_self: Any, verdict: Verdict, _here: Any, seconds: float) -> Verdict:
        given.append(seconds)
        return verdict

    monkeypatch.setattr(type(memory.escape), "replace_verdict", instead_of)
    memory.escape_boundary_layer(state_at(1), verdict_of(memory, status=Status.relaxed), CAR.latent)
    assert given == [7.0 if quick else 0.0]


@pytest.mark.parametrize("taken", [True, False])
def test_a_way_out_promises_no_more_than_what_is_on_its_way_leaves(monkeypatch: pytest.MonkeyPatch, taken: bool):
    """No one can change what happens before the action acts: the car drives at the obstacle until then."""
    memory = driven(CAR, ticks=3)
    state = state_at(3, (4.0, 0.0, 0.0, 1.0), applied=reported(memory), until_action=0.12)
    memory.observe_state(state)
    begin = memory.filter.tools.prediction.effect_start(
        state.values, tuple(CAR.latent.tolist()), memory.pending._replace(alternatives=())
    )
    assert begin is not None
    assert begin.at_once
    assert not isinstance(memory.barriers, str)
    heights = [h for passed in begin.path for h in memory.barriers.h_floats(passed)]
    assert len(begin.path) > 1
    monkeypatch.setattr(type(memory.escape), "may_replace", lambda *_: True)
    verdict = verdict_of(memory, status=Status.relaxed, h_next=50.0)
    found = replace(verdict, reason="out") if taken else verdict
    monkeypatch.setattr(type(memory.escape), "replace_verdict", lambda *_: found)
    assert min(heights) < max(memory.barriers.h_floats(begin.path[0]))
    result = memory.escape_boundary_layer(state, verdict, CAR.latent)
    assert result.h_next == (pytest.approx(min(heights)) if taken else 50.0)
    low = replace(found, h_next=min(heights) - 1.0)
    monkeypatch.setattr(type(memory.escape), "replace_verdict", lambda *_: low)
    assert memory.escape_boundary_layer(state, verdict, CAR.latent).h_next == pytest.approx(min(heights) - 1.0)


def reported_to_the_escape(robot: RobotSession, monkeypatch: pytest.MonkeyPatch) -> TickContext:
    given = list[TickContext]()

    def instead_of(_: Any, verdict: Verdict, here: TickContext, __: float) -> Verdict:
        given.append(here)
        return verdict

    monkeypatch.setattr(type(robot.escape), "replace_verdict", instead_of)
    assert robot.decision is not None
    state, _, verdict = robot.decision
    robot.escape_boundary_layer(state, replace(verdict, status=Status.relaxed), CAR.latent)
    (here,) = given
    return here


def test_out_of_the_layer_leads_no_action_that_failed_to_move_the_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 0.5 m/s a tick of 0.05 s leads 0.025 m further; what leads nowhere that is known does not move it either."""
    robot = driven()
    here = reported_to_the_escape(robot, monkeypatch)
    for failed, fails in ((0.0, False), (0.024, False), (0.026, True)):
        robot.deadlock_detector.failed_displacement = failed
        assert here.is_inside_dead_band((0.5, 0.0)) is fails
    robot._next = lambda *_: ()
    for failed in (0.0, 0.026):
        robot.deadlock_detector.failed_displacement = failed
        assert here.is_inside_dead_band((0.5, 0.0)) is True


def test_a_kind_of_barrier_without_a_margin_has_no_layer(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = driven()
    kinds = {kind: list(rows) for kind, rows in robot.barriers.rows.items()}
    first, *others = kinds
    assert others
    robot.margin = SimpleNamespace(epsilon={first: 0.25})
    margins = reported_to_the_escape(robot, monkeypatch).margins
    assert {margins[row] for row in kinds[first]} == {0.25}
    assert {margins[row] for kind in others for row in kinds[kind]} == {0.0}


@pytest.mark.parametrize(
    ("status", "barriers", "decided"),
    [
        (Status.passed, True, "nominal"), (Status.corrected, True, "nominal"), (Status.stopped, True, "action"),
        (Status.fallback, True, ""), (Status.passed, False, ""),
    ],
)  # fmt: skip
def test_another_model_is_tried_with_the_nominal_action_or_with_the_action_of_a_stop(
    monkeypatch: pytest.MonkeyPatch, status: Status, barriers: bool, decided: str
) -> None:
    memory, asked_with = driven(), list[Any]()
    assert memory.decision is not None
    verdict = verdict_of(memory, status=status, nominal=np.array((1.0, 0.1)), action=np.array((0.2, 0.0)))

    def decide(_self: Any, _state: Any, nominal: Any, *_: Any, **__: Any) -> Verdict:
        asked_with.append(nominal)
        return verdict_of(memory, status=Status.passed)

    monkeypatch.setattr(type(memory.filter), "decide", decide)
    around = memory.barriers if barriers else "surroundings (none has arrived)"
    memory.check_decision(memory.decision._replace(verdict=verdict), around)
    wanted = {"nominal": [(1.0, 0.1)], "action": [(0.2, 0.0)], "": []}[decided]
    assert [tuple(nominal.tolist()) for nominal in asked_with] == wanted


@pytest.mark.parametrize(
    ("status", "predicted", "refused"),
    [
        (Status.passed, ((0.1, 0.0, 0.0, 0.5),), False),
        (Status.fallback, ((0.1, 0.0, 0.0, 0.5),), True),
        (Status.passed, (), True),
    ],
)
def test_a_model_is_refused_where_it_alone_cannot_decide(status, predicted, refused, monkeypatch):
    memory = driven(ticks=3)
    decided, barriers, answer = decided_of(memory), memory.barriers, verdict_of(memory, status=status)
    memory.filter = SimpleNamespace(decide=lambda *_, **__: answer)
    monkeypatch.setattr(RobotSession, "predicted", lambda *_: (predicted, None))
    memory.check_decision(decided, "no scene")
    memory.check_decision(decided_of(memory, status=Status.fallback), barriers)
    if refused:
        with pytest.raises(InputError, match="the filter cannot decide with it: "):
            memory.check_decision(decided, barriers)
    else:
        memory.check_decision(decided, barriers)


LATENT = tuple(CAR.latent.tolist())
DELAYED = CAR.with_effect(effect("car", "actuator_delay"), {"seconds": Setting(0.15)})


def test_dead_times_are_kept_for_64_latents_that_differ_in_the_third_digit(monkeypatch: pytest.MonkeyPatch) -> None:
    actuators, asked = ActuatorModel(DELAYED), list[tuple[float, ...] | None]()

    def responded(latent: tuple[float, ...] | None) -> DeadTime:
        asked.append(latent)
        return DeadTime(1, 2)

    monkeypatch.setattr(actuators, "_measure_dead_time", responded)
    for number in range(MAX_PERIODS):
        assert tuple(actuators.dead_time_periods((0.002 * number,))) == (1, 2)
    assert (MAX_PERIODS, len(asked)) == (64, 64)
    actuators.dead_time_periods((0.0,))
    actuators.dead_time_periods((0.0004,))
    assert len(asked) == 64, "known, and alike to three digits"
    actuators.dead_time_periods((0.201,))
    actuators.dead_time_periods((0.0,))
    assert len(asked) == 66, "with one more all are forgotten"


def test_the_dead_time_is_that_of_the_decision_before_the_newest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the newest state nothing is decided yet."""
    history, asked = CommandHistory(DELAYED), list[object]()
    memory = DELAYED.initial_memory(np.zeros(2), np.array(LATENT))
    for tick in range(9):
        history.add(tick, (0.05 * tick, 0.0, 0.0, 1.0), (1.0, 0.0), memory)
        history.mark_decided((*LATENT[:-1], float(tick)))

    def reach(latent: object) -> DeadTime:
        asked.append(latent)
        return DeadTime(1, 1)

    monkeypatch.setattr(history._actuators, "dead_time_periods", reach)
    assert history.delayed_prediction(0.0) is not None
    assert asked == [(*LATENT[:-1], 7.0)]
