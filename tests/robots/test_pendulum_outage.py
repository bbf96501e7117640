"""A service of the pendulum dies amid a swing: the corridor is kept until it is back."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.adaptation import AdaptationNode
from safedpa.bus import ACTION, LATENT, VERDICT, WISH, Stale, VerdictMessage, WishMessage
from safedpa.dynamics import load_model
from safedpa.safety.node import SafetyFilterNode
from safedpa.safety.shipped import settings_named
from safedpa_sim.robots import PendulumRobot, task_named, wind_towards

DEAD = range(100, 180)
"""Ticks; 0.8 s, in which the supervisor has started it anew."""


def least_room(dead: str, direction: float, end: int = 240) -> tuple[float, PendulumRobot, list[VerdictMessage]]:
    """Random torques at 4 m/s; the service ``dead`` says nothing in ``DEAD``, and its successor knows nothing."""
    model = load_model("pendulum")
    robot = PendulumRobot(task_named("balance"), wind_towards(4.0, direction), seed=1)
    adaptation, keeper = AdaptationNode(model), SafetyFilterNode(model, settings_named("pendulum"))
    random, room, verdicts = np.random.default_rng(2), np.inf, []
    for tick in range(end):
        state, gone = robot.state_message(), tick in DEAD
        if tick == DEAD.stop and dead == "adaptation":
            adaptation = AdaptationNode(model)
        if tick == DEAD.stop and dead == "safety_filter":
            keeper = SafetyFilterNode(model, settings_named("pendulum"))
        latent: object = Stale(LATENT, None)
        if not (gone and dead == "adaptation"):
            latent = adaptation.step("r1", state, {})[LATENT]
            adaptation.afterwards("r1")
        torque = float(random.uniform(-10.0, 10.0))
        wish: object = WishMessage(
            epoch=state.epoch,
            tick=tick,
            robot_time=state.robot_time,
            publish_time=0.0,
            values=(torque,),
            controller="random",
        )
        if gone and dead == "policy":
            wish = Stale(WISH, None)
        if not (gone and dead == "safety_filter"):
            robot.receive(keeper.step("r1", state, {LATENT: latent, WISH: wish})[ACTION])
            verdicts.append(keeper.afterwards("r1")[VERDICT])
        robot.advance()
        room = min(room, np.pi / 4 - abs(robot.values[0]))
    return room, robot, verdicts


@pytest.mark.parametrize("dead", ["policy", "adaptation", "safety_filter"])
@pytest.mark.parametrize("direction", [0.0, 135.0, 270.0])
def test_the_corridor_is_kept(dead: str, direction: float) -> None:
    room, robot, verdicts = least_room(dead, direction)
    assert robot.collisions == []
    assert room > 0.0
    assert (robot.watchdog_ticks > 0) == (dead == "safety_filter")
    assert "fallback" not in {verdict.status for verdict in verdicts}


def test_a_missing_wish_is_said() -> None:
    verdict = least_room("policy", 0.0, DEAD.start + 1)[2][-1]
    assert verdict.wish == ()
    assert verdict.status == "corrected"
    assert "the resting action stood in for it" in verdict.sentence
