"""How the filter's service answers one robot, tick by tick, and what it remembers in between."""

from dataclasses import replace
from math import cos, pi, sin
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.safety.node_steps import (
    ABSENT,
    CAR,
    LATE,
    SETTINGS,
    answer_to,
    asked,
    latent_at,
    scripted_node,
    stamp,
    state_at,
    surroundings,
)

from safedpa.bus import (
    ACTION,
    LATENT,
    NOMINAL,
    VERDICT,
    NominalMessage,
    Request,
    Stale,
    StateMessage,
    VerdictMessage,
)
from safedpa.dynamics import PhysicsModel, fingerprint, load_model
from safedpa.runtime.node import SafetyFilterNode
from safedpa.runtime.stop_orders import StopOrders
from safedpa.safety.defaults import settings_named

AT_REST = (0.0, 0.0, 0.0, 0.0)


NEAR: dict[str, Any] = {"obstacles": ((0.9, 0.0, 0.1),)}
"""Near enough for an error of h to count."""


def answered(node: SafetyFilterNode, tick: int, model: PhysicsModel = CAR, **changed: Any) -> VerdictMessage:
    state = state_at(tick, **changed)
    return asked(node, state, latent_at(state, model), (1.0, 0.1) if model is LATE else (1.0, 0.0))


def obeyed(node: SafetyFilterNode, ticks: range, model: PhysicsModel = CAR, **changed: Any) -> VerdictMessage:
    """The last verdict, after a robot did for some ticks what the filter decided."""
    verdict = None
    for tick in ticks:
        verdict = answered(node, tick, model, **({"applied": verdict.action} if verdict else {}), **changed)
    assert verdict is not None
    return verdict


# states and latents
@pytest.mark.parametrize(("seconds", "good"), [(0.0, True), (1.0, True), (-1e-9, False), (1.0 + 1e-9, False)])
def test_a_state_may_be_a_second_old_where_its_action_acts(seconds: float, good: bool) -> None:
    verdict = answered(scripted_node(CAR, SETTINGS), 0, until_action=seconds)
    assert (verdict.status == "passed") is good
    assert ("wanted 0 to 1 s" in verdict.sentence) is not good


def test_the_last_latent_stands_in_for_a_second_but_none_of_another_run_or_model() -> None:
    node = scripted_node(CAR, SETTINGS)
    assert answered(node, 0).status == "passed"
    for tick in range(1, 24):
        verdict = asked(node, state_at(tick), ABSENT)
        assert verdict.status == ("passed" if tick <= 20 else "fallback"), tick
        assert ("the latent (none of the last second has arrived)" in verdict.sentence) is (tick > 20)
    node = scripted_node(CAR, SETTINGS)
    answered(node, 0)
    verdict = asked(node, state_at(1, epoch=2), ABSENT)
    assert (verdict.status, "none of the last second" in verdict.sentence) == ("fallback", True)
    verdict = asked(node, state_at(2), replace(latent_at(state_at(2)), model="another"))
    assert verdict.status == "fallback"
    assert f"the latent (of model another, the filter has {fingerprint(CAR)})" in verdict.sentence


# predictions
def test_the_path_is_reported_with_every_fourth_tick_and_the_next_state_with_each() -> None:
    node = scripted_node(CAR, SETTINGS)
    for tick in range(9):
        state = state_at(tick)
        verdict = asked(node, state, latent_at(state))
        wanted, _ = CAR.rollout_held(np.array(state.values), np.array(verdict.action), (), CAR.latent, 8, period=0.05)
        assert len(verdict.predicted) == (8 if tick % 4 == 0 else 1)
        np.testing.assert_allclose(verdict.predicted, wanted[: len(verdict.predicted)], atol=1e-12)


@pytest.mark.parametrize("model", [CAR, LATE])
def test_a_state_of_another_size_is_predicted_instead_and_the_robot_brakes(model: PhysicsModel) -> None:
    node = scripted_node(model, SETTINGS)
    before = obeyed(node, range(3), model)
    verdict = answered(node, 3, model, values=(0.0, 0.0, 0.0), applied=before.action)
    assert (verdict.status, "has 3 entries, wanted 4" in verdict.sentence) == ("fallback", True)
    assert len(verdict.predicted[0]) == 4
    assert asked(node, state_at(4, applied=verdict.action), ABSENT).status == "passed"


def test_a_first_action_of_another_size_teaches_nothing() -> None:
    node = scripted_node(CAR, SETTINGS)
    assert "later than reported" not in answered(node, 0, applied=(0.1,)).sentence


def at_rest_with(applied: tuple[float, float], verdict: VerdictMessage) -> Any:
    """The path of a late car whose actuators have settled at ``applied`` when the verdict's action is sent."""
    memory, start = LATE.initial_memory(np.array(applied)), np.array((0.0, 0.0, 0.0, 0.5))
    return LATE.rollout_held(start, np.array(verdict.action), memory, LATE.latent, 8, period=0.05)[0]


@pytest.mark.parametrize(("last", "epoch", "tick"), [(5, 1, 8), (5, 1, 4), (7, 2, 8), (5, 2, 0)])
def test_after_lost_ticks_or_a_restart_the_actuators_count_as_settled_at_what_is_applied(last, epoch, tick):
    node = scripted_node(LATE, SETTINGS)
    obeyed(node, range(last - 4, last + 1), LATE)
    verdict = answered(node, tick, LATE, applied=(0.25, -0.1), epoch=epoch)
    np.testing.assert_allclose(verdict.predicted, at_rest_with((0.25, -0.1), verdict), atol=1e-12)


def test_after_a_tick_that_taught_nothing_the_actuators_count_as_settled_at_the_watchdogs_action() -> None:
    node = scripted_node(LATE, SETTINGS)
    verdict = answered(node, 3, LATE, applied=(0.1,))
    assert (verdict.status, verdict.predicted) == ("fallback", ())
    verdict = answered(node, 4, LATE, applied=(0.25, -0.1), applied_by="watchdog")
    np.testing.assert_allclose(verdict.predicted, at_rest_with((0.25, -0.1), verdict), atol=1e-12)


# the watch over the margin
@pytest.mark.parametrize(
    ("changed", "compared"),
    [({}, True), ({"applied_by": "watchdog"}, False), ({"applied_by": "none"}, False)]
    + [({"tick": tick}, False) for tick in (2, 3, 5)],
    ids=str,
)
def test_a_prediction_is_compared_only_with_the_next_tick_of_the_filters_own_action(changed, compared):
    node = scripted_node(CAR, SETTINGS)
    before = answered(node, 3, values=AT_REST, **NEAR)
    assert before.coverage == -1.0
    verdict = answered(node, **{"tick": 4, "applied": before.action, "values": AT_REST, **NEAR, **changed})
    assert (verdict.coverage == 1.0) is compared
    assert (verdict.coverage == -1.0) is not compared


def closer(node: SafetyFilterNode, ticks: range) -> VerdictMessage:
    """The last verdict of a car that creeps up to an obstacle though its nominal action is to rest."""
    for tick in ticks:
        state = state_at(tick, (0.012 * tick, 0.0, 0.0, 0.0), **NEAR)
        verdict = asked(node, state, latent_at(state), (0.0, 0.0))
    return verdict


def test_misses_widen_the_margin_and_a_failure_does_not_narrow_it_again() -> None:
    node = scripted_node(CAR, SETTINGS)
    widened = closer(node, range(10))
    assert 0.0 < widened.coverage < 0.7
    assert widened.margin > SETTINGS.epsilon["obstacle"]
    node.rescue("r", state_at(10), "x")
    after = closer(node, range(12, 13))
    assert (after.margin, after.coverage) == (widened.margin, widened.coverage), "no prediction reaches over the gap"
    node.leave("r")
    assert closer(node, range(13, 14)).coverage == -1.0


def test_over_a_shorter_period_the_margin_stays_and_predictions_are_shorter() -> None:
    node = scripted_node(CAR, SETTINGS)
    widened = closer(node, range(10))
    state = state_at(10, (0.0, 0.0, 0.0, 0.5), period=0.025)
    verdict = asked(node, state, latent_at(state))
    assert (verdict.margin, verdict.coverage) == (widened.margin, widened.coverage)
    wanted, _ = CAR.rollout_held(np.array(state.values), np.array(verdict.action), (), CAR.latent, 1, period=0.025)
    np.testing.assert_allclose(verdict.predicted[0], wanted[0], atol=1e-12)


# standing
@pytest.mark.parametrize(
    ("changed", "nominal", "status", "stationary_for"),
    [
        ({}, (1.0, 0.0), "passed", 0.2),
        ({"obstacle": 0.9}, (1.0, 0.0), "corrected", 0.2),
        ({"enabled": False}, (1.0, 0.0), "disabled", 0.2),
        ({}, (0.0, 0.0), "passed", 0.0),
        ({"order": "stop"}, (1.0, 0.0), "stopped", 0.0),
    ],
)
def test_a_robot_stands_only_while_a_nominal_action_should_move_it(changed, nominal, status, stationary_for):
    orders = StopOrders()
    if "order" in changed:
        orders.answer("r", Request(do=changed["order"], who="me"))
    node = scripted_node(CAR, replace(SETTINGS, enabled=changed.get("enabled", True)), orders=orders)
    for tick in range(5):
        state = state_at(tick, AT_REST, obstacles=((changed.get("obstacle", 6.0), 0.0, 0.1),))
        verdict = asked(node, state, latent_at(state), nominal)
    assert (verdict.status, verdict.stationary_for) == (status, pytest.approx(stationary_for))
    orders.answer("r", Request(do="stop", who="me"))
    verdict = answered(node, 5, values=AT_REST)
    assert (verdict.status, verdict.stationary_for) == ("stopped", 0.0), "an order to stop ends a stand"


def test_a_standing_robot_is_reported_with_a_reason_after_five_seconds() -> None:
    node, sentences = scripted_node(CAR, SETTINGS), []
    for tick in range(140):
        verdict = answered(node, tick, values=AT_REST, obstacles=((0.85, 0.0, 0.3),))
        sentences.append(verdict.sentence)
        if tick < 80:
            assert verdict.stationary_reason == ""
    assert verdict.stationary_for == pytest.approx(6.95, abs=0.11)
    assert verdict.stationary_reason
    assert (
        f"The robot has been stationary for {verdict.stationary_for:.1f} s. {verdict.stationary_reason}."
        in sentences[-1]
    )
    assert "has stood" not in sentences[20]


def test_after_half_a_second_a_correction_that_moves_nothing_is_replaced_by_rest() -> None:
    node, verdict, rests = scripted_node(CAR, SETTINGS), None, list[int]()
    for tick in range(24):
        applied = verdict.action if verdict else (0.0, 0.0)
        verdict = answered(node, tick, values=AT_REST, applied=applied, obstacles=((0.8, 0.0, 0.1),))
        if "dead band" in verdict.sentence:
            assert (verdict.status, verdict.action) == ("corrected", (0.0, 0.0))
            rests.append(tick)
    assert 10 <= rests[0] <= 14
    assert len(rests) >= 8


@pytest.mark.parametrize(("speed", "still"), [(0.02, True), (-0.02, True), (0.021, False), (-0.021, False)])
def test_a_braked_robot_is_at_rest_below_two_centimetres_a_second(speed: float, still: bool) -> None:
    node, state = scripted_node(CAR, SETTINGS), state_at(0, (0.0, 0.0, 0.0, speed))
    assert not node.at_rest("r")
    asked(node, state, latent_at(state))
    assert not node.at_rest("r"), "the filter did not stop it"
    asked(node, replace(state, tick=1), replace(latent_at(state), model="another"))
    assert node.at_rest("r") is still, "the backup brakes it as well"


# failures and farewells
def test_a_rescue_sends_an_action_and_a_verdict_that_promises_nothing() -> None:
    node, state = scripted_node(CAR, SETTINGS), state_at(0)
    for known in (False, True, True):
        if known:
            asked(node, state, latent_at(state))
        outputs = node.rescue("r", state, "the filter raised")
        verdict = outputs[VERDICT]
        assert isinstance(verdict, VerdictMessage)
        assert outputs[ACTION].values == verdict.action == (0.0, 0.0)
        assert (verdict.status, "the filter raised" in verdict.sentence) == ("fallback", True)
        assert (verdict.predicted, verdict.model, verdict.stationary_for) == ((), "", 0.0)
        assert (verdict.coverage, verdict.promised) == (-1.0, -1.0)


def test_the_newest_state_and_model_are_known_until_the_robot_leaves() -> None:
    node, state = scripted_node(CAR, SETTINGS), state_at(0)
    assert node.newest("r") is None
    asked(node, state, latent_at(state))
    assert node.newest("r") == state
    assert node.model_of("r") == fingerprint(CAR)
    node.leave("r")
    assert node.newest("r") is None


PENDULUM, POINT = load_model("pendulum"), load_model("point_wind")
IS_STATIONARY_IN = "the resting action stood in for it"


MOVER = (0.75, 0.0, 0.25, 0.0, 0.0, 1.5)
"""Half a metre ahead of the car, and it may come at 1.5 m/s."""


def pendulum_asked(nominal: Any) -> VerdictMessage:
    corridor: dict[str, Any] = {"corridor": (-1.0, 1.0), "obstacles": (), "field": (), "footprint": ()}
    state = state_at(0, (0.0, 0.0), applied=(0.0,), period=PENDULUM.period, **corridor)
    node = scripted_node(PENDULUM, settings_named("pendulum"))
    return answer_to(node, state, {LATENT: latent_at(state, PENDULUM), NOMINAL: nominal})


def test_without_a_nominal_action_a_robot_that_can_stand_is_stopped_and_another_one_filtered() -> None:
    verdict = pendulum_asked(Stale(NOMINAL, None))
    assert verdict.status == "corrected"
    assert IS_STATIONARY_IN in verdict.sentence
    assert verdict.nominal == ()
    nominal = NominalMessage(**stamp(state_at(0)), values=(0.1,), controller="test")
    verdict = pendulum_asked(nominal)
    assert (verdict.status, verdict.nominal) == ("passed", (0.1,))
    node, state = scripted_node(CAR, SETTINGS), state_at(0)
    verdict = answer_to(node, state, {LATENT: latent_at(state), NOMINAL: Stale(NOMINAL, None)})
    assert verdict.status == "fallback"
    assert "the nominal action (" in verdict.sentence
    assert IS_STATIONARY_IN not in verdict.sentence


def test_a_robot_whose_speed_is_not_reported_has_none_to_lose() -> None:
    node = scripted_node(CAR, SETTINGS)
    state = state_at(0, (0.0, 0.0, 0.0))
    assert asked(node, state, latent_at(state)).status == "fallback"
    assert node.at_rest("r")


@pytest.mark.parametrize(("speeds", "still"), [((0.0, 0.5), False), ((0.5, 0.0), False), ((0.0, 0.0), True)])
def test_a_robot_is_at_rest_when_none_of_its_speeds_is_left(speeds: tuple[float, float], still: bool) -> None:
    node = scripted_node(POINT, settings_named("point"))
    state = state_at(0, (0.0, 0.0, 0.0, *speeds), period=POINT.period, applied=(0.0,) * len(POINT.system.action))
    assert answer_to(node, state, {LATENT: Stale(LATENT, None), NOMINAL: Stale(NOMINAL, None)}).status == "fallback"
    assert node.at_rest("r") is still


def test_it_decides_half_way_through_a_period_at_the_latest_with_a_latent_of_the_tick_before() -> None:
    """After that the action would come late at the robot, which then brakes; an older latent may be another load's."""
    assert SafetyFilterNode.share == 0.5
    assert dict(SafetyFilterNode.slack) == {LATENT: 1}


def test_the_end_of_the_filter_stops_every_robot_until_the_next_one_starts(tmp_path: Path) -> None:
    orders = StopOrders(tmp_path / "orders.json")
    node, state = scripted_node(CAR, SETTINGS, orders=orders), state_at(0)
    assert asked(node, state, latent_at(state)).status == "passed"
    node.begin_shutdown()
    verdict = asked(node, state_at(1), latent_at(state_at(1)))
    assert (verdict.status, verdict.action) == ("stopped", (0.0, 0.0))
    again = scripted_node(CAR, SETTINGS, orders=StopOrders(tmp_path / "orders.json"))
    assert asked(again, state, latent_at(state)).status == "passed"


# a robot that names sources
def sensing(**changed: Any) -> StateMessage:
    return state_at(0, (0.0, 0.0, 0.0, 0.0), **{"sources": ("laser",), "obstacles": (), **changed})


def sees(node: SafetyFilterNode, state: StateMessage, *, latent: bool = True, **seen: Any) -> VerdictMessage:
    return asked(node, state, latent_at(state) if latent else ABSENT, (0.2, 0.0), surroundings(state, **seen))


def ring(count: int) -> tuple[tuple[float, ...], ...]:
    """Points (x, y, radius) in m on a circle around the car, near enough to matter and far enough to be safe."""
    angles = [2.0 * pi * number / count for number in range(count)]
    return tuple((0.7 * cos(angle), 0.7 * sin(angle), 0.01) for angle in angles)


@pytest.mark.parametrize(
    ("movers", "latent", "status"), [((MOVER,), True, "stopped"), ((MOVER,), False, "fallback"), ((), True, "passed")]
)
def test_a_mover_that_may_reach_the_robot_stops_it_where_nothing_is_missing(movers: Any, latent: bool, status: str):
    """With something missing the verdict says so: a stop for the mover would hide that the filter decides blindly."""
    verdict = sees(scripted_node(CAR, SETTINGS), sensing(), latent=latent, movers=movers)
    assert verdict.status == status
    assert ("mover 0" in verdict.sentence) is (status == "stopped")


@pytest.mark.parametrize(("age", "old"), [(-1e-6, False), (1.0, False), (-2e-6, True), (1.0 + 1e-9, True)])
def test_a_source_may_be_a_second_old(age: float, old: bool) -> None:
    verdict = sees(scripted_node(CAR, SETTINGS), sensing(), ages=(age,))
    assert verdict.status == ("fallback" if old else "passed")
    assert ("a source is" in verdict.sentence) is old


@pytest.mark.parametrize(("points", "remark"), [(64, ""), (65, "Of 65 points near it"), (70, "Of 70 points near it")])
def test_points_beyond_sixty_four_are_reported_as_not_looked_at(points: int, remark: str) -> None:
    verdict = sees(scripted_node(CAR, SETTINGS), sensing(), points=ring(points))
    assert ("near it, those with the least h were looked at." in verdict.sentence) is bool(remark)
    assert remark in verdict.sentence
    assert verdict.sentence == verdict.sentence.strip()


@pytest.mark.parametrize("seen", [{"movers": (MOVER,)}, {"points": ring(70)}], ids=["mover", "points"])
def test_a_robot_that_starts_again_without_sources_is_not_judged_by_what_it_saw(seen: dict[str, Any]) -> None:
    node = scripted_node(CAR, SETTINGS)
    sees(node, sensing(), **seen)
    again = sees(node, sensing(sources=(), epoch=2))
    assert (again.status, again.action) == ("passed", (0.2, 0.0))
    assert "near it" not in again.sentence


@pytest.mark.parametrize("known", [True, False])
def test_a_robot_with_sources_is_rescued_like_one_without(known: bool) -> None:
    node, state = scripted_node(CAR, SETTINGS), sensing()
    if known:
        sees(node, state, points=ring(70))
    verdict = node.rescue("r", state, "the step raised")[VERDICT]
    assert isinstance(verdict, VerdictMessage)
    assert verdict.status == "fallback"
    assert "the step raised" in verdict.sentence
    assert "near it" not in verdict.sentence
