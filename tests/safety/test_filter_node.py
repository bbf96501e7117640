"""Which of the filter's answers a robot gets from its service, by what is missing and by what robot it is."""

from __future__ import annotations

from typing import Any

import pytest
from tests.safety.node_steps import CAR, SETTINGS, asked, latent_at, memory_of, stamp, state_at

from safedpa.bus import (
    LATENT,
    SURROUNDINGS,
    VERDICT,
    WISH,
    LatentMessage,
    Stale,
    StateMessage,
    VerdictMessage,
    WishMessage,
)
from safedpa.dynamics import fingerprint, load_model
from safedpa.safety.filtered_robot import FilteredRobot
from safedpa.safety.node import SafetyFilterNode
from safedpa.safety.shipped import settings_named

PENDULUM = load_model("pendulum")
STANDS_IN = "the resting action stood in for it"


def pendulum_at(tick: int) -> StateMessage:
    corridor: dict[str, Any] = {"corridor": (-1.0, 1.0), "obstacles": (), "field": (), "footprint": ()}
    applied = (0.0,) * len(PENDULUM.system.action)
    return state_at(tick, (0.0,) * len(PENDULUM.system.state), applied=applied, period=PENDULUM.period, **corridor)


def pendulum_asked(wish: Any) -> VerdictMessage:
    node, state = SafetyFilterNode(PENDULUM, settings_named("pendulum")), pendulum_at(0)
    values = tuple(PENDULUM.latent.tolist())
    latent = LatentMessage(**stamp(state), model=fingerprint(PENDULUM), values=values, deviations=values)
    node.step("r", state, {LATENT: latent, WISH: wish})
    verdict = node.afterwards("r")[VERDICT]
    assert isinstance(verdict, VerdictMessage)
    return verdict


def test_without_a_wish_a_robot_that_has_no_stand_is_filtered_all_the_same() -> None:
    verdict = pendulum_asked(Stale(WISH, None))
    assert verdict.status == "corrected"
    assert STANDS_IN in verdict.sentence
    assert verdict.wish == ()
    wish = WishMessage(**stamp(pendulum_at(0)), values=(0.1,), controller="test")
    verdict = pendulum_asked(wish)
    assert (verdict.status, verdict.wish) == ("passed", (0.1,))


def test_without_a_wish_a_robot_that_can_stand_is_brought_to_its_stand() -> None:
    node, state = SafetyFilterNode(CAR, SETTINGS), state_at(0)
    node.step("r", state, {LATENT: latent_at(state), WISH: Stale(WISH, None)})
    verdict = node.afterwards("r")[VERDICT]
    assert isinstance(verdict, VerdictMessage)
    assert verdict.status == "fallback"
    assert "the wish (" in verdict.sentence
    assert STANDS_IN not in verdict.sentence


@pytest.mark.parametrize(
    ("somebody", "latent", "status"),
    [("mover a may be at the robot", True, "stopped"), ("mover a may be at the robot", False, "fallback"),
     ("", True, "passed")],
)  # fmt: skip
def test_who_may_be_at_the_robot_stops_it_where_nothing_is_missing(
    monkeypatch: pytest.MonkeyPatch, somebody: str, latent: bool, status: str
) -> None:
    """With something missing the verdict says so: a stop of the filter's own would hide that it decides blindly."""

    def see(self: FilteredRobot, state: StateMessage, seen: Any) -> None:
        del seen
        self.barriers = self.scene.of(state)
        self.scene.yields_to = somebody

    monkeypatch.setattr(FilteredRobot, "see", see)
    node, state = SafetyFilterNode(CAR, SETTINGS), state_at(0, sources=("laser",))
    inputs: dict[Any, Any] = {
        LATENT: latent_at(state) if latent else Stale(LATENT, None),
        WISH: WishMessage(**stamp(state), values=(1.0, 0.0), controller="test"),
        SURROUNDINGS: Stale(SURROUNDINGS, None),
    }
    node.step("r", state, inputs)
    verdict = node.afterwards("r")[VERDICT]
    assert isinstance(verdict, VerdictMessage)
    assert verdict.status == status, verdict.sentence
    assert (somebody in verdict.sentence) is (status == "stopped" or not somebody)


def test_a_robot_whose_speed_is_not_told_has_none_to_lose() -> None:
    node = SafetyFilterNode(CAR, SETTINGS)
    state = state_at(0, (0.0, 0.0, 0.0))
    assert asked(node, state, latent_at(state)).status == "fallback"
    assert node.at_rest("r")


def test_a_robot_is_at_rest_when_none_of_its_speeds_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FilteredRobot, "speeds", property(lambda _: (2, 3)))
    node = SafetyFilterNode(CAR, SETTINGS)
    for speeds, still in (((0.0, 0.5), False), ((0.5, 0.0), False), ((0.0, 0.0), True)):
        state = state_at(0, (0.0, 0.0, *speeds))
        node.step("r", state, {LATENT: Stale(LATENT, None), WISH: Stale(WISH, None)})
        assert node.at_rest("r") is still


def test_that_commands_act_later_than_told_is_said_where_it_is_acted_upon_and_nowhere_else() -> None:
    node = SafetyFilterNode(CAR, SETTINGS)
    state = state_at(0, until_action=0.05)
    assert "later than told" not in asked(node, state, latent_at(state)).sentence
    memory_of(node).delay.periods = 5
    state = state_at(1, until_action=0.05)
    assert "later than told" in asked(node, state, latent_at(state)).sentence


def test_a_last_resort_promises_nothing() -> None:
    verdict = SafetyFilterNode(CAR, SETTINGS).rescue("r", state_at(0), "the filter raised")[VERDICT]
    assert isinstance(verdict, VerdictMessage)
    assert (verdict.coverage, verdict.promised) == (-1.0, -1.0)


def test_it_decides_half_way_through_a_period_at_the_latest_with_a_latent_of_the_tick_before() -> None:
    """After that the action would come late at the robot, which then brakes; an older latent may be another load's."""
    assert SafetyFilterNode.share == 0.5
    assert dict(SafetyFilterNode.slack) == {LATENT: 1}
