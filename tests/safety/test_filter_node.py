"""What the filter's service answers a robot, by what is missing, what is around it and which robot it is."""

from __future__ import annotations

from math import cos, pi, sin
from pathlib import Path
from typing import Any

import pytest
from tests.safety.node_steps import ABSENT, CAR, SETTINGS, asked, latent_at, stamp, state_at

from safedpa.bus import (
    LATENT,
    SURROUNDINGS,
    VERDICT,
    WISH,
    Stale,
    StateMessage,
    SurroundingsMessage,
    VerdictMessage,
    WishMessage,
)
from safedpa.dynamics import load_model
from safedpa.safety.node import SafetyFilterNode
from safedpa.safety.orders import Orders
from safedpa.safety.shipped import settings_named

PENDULUM, POINT = load_model("pendulum"), load_model("point_wind")
STANDS_IN = "the resting action stood in for it"
MOVER = (0.75, 0.0, 0.25, 0.0, 0.0, 1.5)
"""Half a metre ahead of the car, and it may come at 1.5 m/s."""


def answered(node: SafetyFilterNode, state: StateMessage, inputs: dict[Any, Any]) -> VerdictMessage:
    node.step("r", state, inputs)
    verdict = node.afterwards("r")[VERDICT]
    assert isinstance(verdict, VerdictMessage)
    return verdict


def pendulum_asked(wish: Any) -> VerdictMessage:
    corridor: dict[str, Any] = {"corridor": (-1.0, 1.0), "obstacles": (), "field": (), "footprint": ()}
    state = state_at(0, (0.0, 0.0), applied=(0.0,), period=PENDULUM.period, **corridor)
    node = SafetyFilterNode(PENDULUM, settings_named("pendulum"))
    return answered(node, state, {LATENT: latent_at(state, PENDULUM), WISH: wish})


def test_without_a_wish_a_robot_that_cannot_stand_is_filtered_all_the_same() -> None:
    verdict = pendulum_asked(Stale(WISH, None))
    assert verdict.status == "corrected"
    assert STANDS_IN in verdict.sentence
    assert verdict.wish == ()
    wish = WishMessage(**stamp(state_at(0)), values=(0.1,), controller="test")
    verdict = pendulum_asked(wish)
    assert (verdict.status, verdict.wish) == ("passed", (0.1,))


def test_without_a_wish_a_robot_that_can_stand_is_stopped() -> None:
    node, state = SafetyFilterNode(CAR, SETTINGS), state_at(0)
    verdict = answered(node, state, {LATENT: latent_at(state), WISH: Stale(WISH, None)})
    assert verdict.status == "fallback"
    assert "the wish (" in verdict.sentence
    assert STANDS_IN not in verdict.sentence


def test_a_robot_whose_speed_is_not_reported_has_none_to_lose() -> None:
    node = SafetyFilterNode(CAR, SETTINGS)
    state = state_at(0, (0.0, 0.0, 0.0))
    assert asked(node, state, latent_at(state)).status == "fallback"
    assert node.at_rest("r")


@pytest.mark.parametrize(("speeds", "still"), [((0.0, 0.5), False), ((0.5, 0.0), False), ((0.0, 0.0), True)])
def test_a_robot_is_at_rest_when_none_of_its_speeds_is_left(speeds: tuple[float, float], still: bool) -> None:
    node = SafetyFilterNode(POINT, settings_named("point"))
    state = state_at(0, (0.0, 0.0, 0.0, *speeds), period=POINT.period, applied=(0.0,) * len(POINT.system.action))
    assert answered(node, state, {LATENT: Stale(LATENT, None), WISH: Stale(WISH, None)}).status == "fallback"
    assert node.at_rest("r") is still


def test_it_decides_half_way_through_a_period_at_the_latest_with_a_latent_of_the_tick_before() -> None:
    """After that the action would come late at the robot, which then brakes; an older latent may be another load's."""
    assert SafetyFilterNode.share == 0.5
    assert dict(SafetyFilterNode.slack) == {LATENT: 1}


def test_the_end_of_the_filter_stops_every_robot_until_the_next_one_starts(tmp_path: Path) -> None:
    orders = Orders(tmp_path / "orders.json")
    node, state = SafetyFilterNode(CAR, SETTINGS, orders=orders), state_at(0)
    assert asked(node, state, latent_at(state)).status == "passed"
    node.wind_up()
    verdict = asked(node, state_at(1), latent_at(state_at(1)))
    assert (verdict.status, verdict.action) == ("stopped", (0.0, 0.0))
    again = SafetyFilterNode(CAR, SETTINGS, orders=Orders(tmp_path / "orders.json"))
    assert asked(again, state, latent_at(state)).status == "passed"


# a robot that names sources


def sensing(**changed: Any) -> StateMessage:
    return state_at(0, (0.0, 0.0, 0.0, 0.0), **{"sources": ("laser",), "obstacles": (), **changed})


def sees(node: SafetyFilterNode, state: StateMessage, *, latent: bool = True, **seen: Any) -> VerdictMessage:
    around = {"points": (), "movers": (), "hidden": (), "ages": (0.05,), **seen}
    inputs = {
        LATENT: latent_at(state) if latent else ABSENT,
        WISH: WishMessage(**stamp(state), values=(0.2, 0.0), controller="test"),
        SURROUNDINGS: SurroundingsMessage(**stamp(state), **around),
    }
    return answered(node, state, inputs)


def ring(count: int) -> tuple[tuple[float, ...], ...]:
    """Points (x, y, radius) in m on a circle around the car, near enough to matter and far enough to be safe."""
    angles = [2.0 * pi * number / count for number in range(count)]
    return tuple((0.7 * cos(angle), 0.7 * sin(angle), 0.01) for angle in angles)


@pytest.mark.parametrize(
    ("movers", "latent", "status"), [((MOVER,), True, "stopped"), ((MOVER,), False, "fallback"), ((), True, "passed")]
)
def test_a_mover_that_may_reach_the_robot_stops_it_where_nothing_is_missing(
    movers: Any, latent: bool, status: str
) -> None:
    """With something missing the verdict says so: a stop for the mover would hide that the filter decides blindly."""
    verdict = sees(SafetyFilterNode(CAR, SETTINGS), sensing(), latent=latent, movers=movers)
    assert verdict.status == status
    assert ("mover 0" in verdict.sentence) is (status == "stopped")


@pytest.mark.parametrize(("age", "old"), [(-1e-6, False), (1.0, False), (-2e-6, True), (1.0 + 1e-9, True)])
def test_a_source_may_be_a_second_old(age: float, old: bool) -> None:
    verdict = sees(SafetyFilterNode(CAR, SETTINGS), sensing(), ages=(age,))
    assert verdict.status == ("fallback" if old else "passed")
    assert ("a source is" in verdict.sentence) is old


@pytest.mark.parametrize(("points", "remark"), [(64, ""), (65, "Of 65 points near it"), (70, "Of 70 points near it")])
def test_points_beyond_sixty_four_are_reported_as_not_looked_at(points: int, remark: str) -> None:
    verdict = sees(SafetyFilterNode(CAR, SETTINGS), sensing(), points=ring(points))
    assert ("near it, those with the least h were looked at." in verdict.sentence) is bool(remark)
    assert remark in verdict.sentence
    assert verdict.sentence == verdict.sentence.strip()


@pytest.mark.parametrize("seen", [{"movers": (MOVER,)}, {"points": ring(70)}], ids=["mover", "points"])
def test_a_robot_that_starts_again_without_sources_is_not_judged_by_what_it_saw(seen: dict[str, Any]) -> None:
    node = SafetyFilterNode(CAR, SETTINGS)
    sees(node, sensing(), **seen)
    again = sees(node, sensing(sources=(), epoch=2))
    assert (again.status, again.action) == ("passed", (0.2, 0.0))
    assert "near it" not in again.sentence


@pytest.mark.parametrize("known", [True, False])
def test_a_robot_with_sources_is_rescued_like_one_without(known: bool) -> None:
    node, state = SafetyFilterNode(CAR, SETTINGS), sensing()
    if known:
        sees(node, state, points=ring(70))
    verdict = node.rescue("r", state, "the step raised")[VERDICT]
    assert isinstance(verdict, VerdictMessage)
    assert verdict.status == "fallback"
    assert "the step raised" in verdict.sentence
    assert "near it" not in verdict.sentence
