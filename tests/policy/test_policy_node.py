"""The policy's step: stamped wishes, with or without a latent."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from safedpa.bus import LATENT, WISH, LatentMessage, Stale, StateMessage, WishMessage
from safedpa.dynamics import fingerprint, load_model
from safedpa.errors import MessageError
from safedpa.policy import PolicyNode
from safedpa.robots.car.goal_seeker import GoalSeekerSettings

MODEL = load_model("car")
LIMITS = GoalSeekerSettings()
STATE = StateMessage(
    epoch=5,
    tick=7,
    robot_time=0.35,
    publish_time=0.0,
    values=(0.0, 0.0, 0.0, 0.5),
    applied=(0.5, 0.0),
    applied_by="filter",
    period=0.05,
    lockstep=True,
    goal=(1.0, 0.5),
    obstacles=(),
    field=(-4.0, 4.0, -4.0, 4.0),
    footprint=(0.08, 0.4, 0.12),
)


def latent(mass_ratio: float, **changes: Any) -> LatentMessage:
    values = list(MODEL.latent)
    values[MODEL.latent_names.index("towed_load.mass_ratio")] = mass_ratio
    made = LatentMessage(
        epoch=5,
        tick=7,
        robot_time=0.35,
        publish_time=0.0,
        model=fingerprint(MODEL),
        values=tuple(values),
        deviations=(0.1,) * len(values),
    )
    return dataclasses.replace(made, **changes)


def wish(state: StateMessage, known: LatentMessage | Stale) -> WishMessage:
    message = PolicyNode(MODEL).step("r", state, {LATENT: known})[WISH]
    assert isinstance(message, WishMessage)
    return dataclasses.replace(message, publish_time=0.0)


def test_the_wish_carries_the_stamp_of_its_state() -> None:
    message = wish(STATE, Stale(LATENT, 3))
    assert (message.epoch, message.tick, message.robot_time) == (5, 7, 0.35)
    assert message.controller == "goal_seeker:seek"
    assert message == wish(STATE, Stale(LATENT, 3))


def test_with_a_heavier_load_it_asks_for_more_speed() -> None:
    without, light, heavy = (wish(STATE, known).values for known in (Stale(LATENT, None), latent(0.0), latent(0.8)))
    assert light == pytest.approx(without, abs=1e-6), "at the values of the model's file nothing is to be made up for"
    assert heavy[0] > light[0]
    assert heavy[1] == light[1]


@pytest.mark.parametrize("mass_ratio", [0.0, 1.0, 5.0])
@pytest.mark.parametrize("speed", [-0.5, 0.0, 2.0])
def test_made_up_or_not_it_stays_within_the_limits_of_the_actuators(mass_ratio: float, speed: float) -> None:
    for goal in ((3.0, 0.0), (-3.0, 1.0), (0.2, 0.6)):
        state = dataclasses.replace(STATE, values=(0.0, 0.0, 0.0, speed), goal=goal)
        target, steer = wish(state, latent(mass_ratio)).values
        assert LIMITS.slowest_target <= target <= LIMITS.fastest_target
        assert abs(steer) <= LIMITS.steer_limit


@pytest.mark.parametrize("change", [{"model": "another"}, {"values": (0.5,) * 9}, {"values": ()}])
def test_a_latent_that_does_not_fit_is_left_aside(change: dict[str, Any]) -> None:
    assert wish(STATE, latent(0.8, **change)) == wish(STATE, Stale(LATENT, None))


@pytest.mark.parametrize(
    "change", [{"values": (0.0,) * 3}, {"goal": (1.0,)}, {"goal": (1.0, 2.0, 3.0)}, {"values": ()}]
)
def test_a_state_of_the_wrong_length_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(MessageError, match="wanted 4 and 2"):
        wish(dataclasses.replace(STATE, **change), Stale(LATENT, None))


def test_robots_are_kept_apart_and_forgotten() -> None:
    node = PolicyNode(MODEL)
    for tick in range(60):
        state = dataclasses.replace(STATE, tick=tick, robot_time=0.05 * tick)
        held = node.step("held", state, {LATENT: Stale(LATENT, None)})[WISH]
    assert isinstance(held, WishMessage)
    assert held.controller != "goal_seeker:seek"
    assert node.step("new", STATE, {LATENT: Stale(LATENT, None)})[WISH].controller == "goal_seeker:seek"  # type: ignore[attr-defined]
    node.forget("held")
    assert node.step("held", STATE, {LATENT: Stale(LATENT, None)})[WISH].controller == "goal_seeker:seek"  # type: ignore[attr-defined]
