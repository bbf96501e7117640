"""What the filter's service remembers of a robot whose commands are late."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safedpa.bus import ACTION, LATENT, VERDICT, WISH, LatentMessage, StateMessage, VerdictMessage, WishMessage
from safedpa.dynamics import PhysicsModel, Setting, fingerprint, load_model
from safedpa.effects import effect
from safedpa.safety.node import SafetyFilterNode
from safedpa.safety.on_its_way import Pending
from safedpa.safety.shipped import settings_named

CAR = load_model("car")
LATE = CAR.with_effect(effect("car", "actuator_delay"), {"seconds": Setting(0.2)})


class Robot:
    """The model itself behind the filter; ``wishes`` a tick, the watchdog's action in the ticks of ``lost``."""

    def __init__(self, model: PhysicsModel, until_action: float = 0.0, lost: tuple[int, ...] = ()) -> None:
        self.model, self.until_action, self.lost = model, until_action, lost
        self.node = SafetyFilterNode(model, settings_named("car"))
        self.values = np.array((0.0, 0.0, 0.0, 0.0))
        self.memory: Any = model.initial_memory(np.zeros(2), model.latent)
        self.applied, self.applied_by, self.tick = (0.0, 0.0), "none", 0

    def turn(self, wish: tuple[float, float] = (1.0, 0.0)) -> VerdictMessage:
        stamp = {"epoch": 1, "tick": self.tick, "robot_time": self.tick * 0.05, "publish_time": 0.0}
        state = StateMessage(
            **stamp,
            values=tuple(self.values.tolist()),
            applied=self.applied,
            applied_by=self.applied_by,
            period=0.05,
            lockstep=True,
            goal=(5.0, 0.0),
            obstacles=((6.0, 0.0, 0.3),),
            field=(-20.0, 20.0, -20.0, 20.0),
            footprint=(0.08, 0.40, 0.12),
            until_action=self.until_action,
        )
        latent = tuple(self.model.latent.tolist())
        inputs = {
            LATENT: LatentMessage(**stamp, model=fingerprint(self.model), values=latent, deviations=latent),
            WISH: WishMessage(**stamp, values=wish, controller="test"),
        }
        outputs = dict(self.node.step("r1", state, inputs))
        outputs.update(self.node.afterwards("r1"))
        lost = self.tick in self.lost
        self.applied, self.applied_by = ((0.0, 0.0), "watchdog") if lost else (outputs[ACTION].values, "filter")
        self.values, self.memory = self.model.advance(
            self.values, np.array(self.applied), self.memory, self.model.latent
        )
        self.tick += 1
        verdict = outputs[VERDICT]
        assert isinstance(verdict, VerdictMessage)
        return verdict

    @property
    def pending(self) -> Any:
        return self.node._robots["r1"].pending


def test_what_the_watchdog_did_is_on_its_way_with_what_was_sent_before() -> None:
    """It was forgotten: after one lost action the actuators seemed to have settled at the brake."""
    robot = Robot(LATE, lost=(5,))
    for tick in range(7):
        truth, before = robot.memory, robot.applied
        robot.turn((0.2 * tick, 0.01 * tick))
        assert isinstance(robot.pending, Pending)
        assert robot.pending.memory == truth
        assert robot.pending.held == before


def test_the_next_state_comes_as_expected() -> None:
    robot = Robot(LATE)
    for _ in range(12):
        verdict = robot.turn()
    np.testing.assert_allclose(verdict.predicted[0], robot.values, atol=1e-12)
    watched = robot.node._robots["r1"].margin
    assert max(watched.epsilon.values()) == pytest.approx(max(settings_named("car").epsilon.values()))


def test_a_model_without_memory_has_nothing_pending() -> None:
    robot = Robot(CAR)
    robot.turn()
    assert robot.pending == ()


@pytest.mark.parametrize("seconds", [-0.01, 1.01, 1e6])
def test_a_state_that_is_too_old_where_its_action_acts_is_none(seconds: float) -> None:
    verdict = Robot(CAR, seconds).turn()
    assert verdict.status == "fallback"
    assert f"its action acts {seconds:g} s later, wanted 0 to 1 s" in verdict.sentence


def test_a_state_of_some_age_is_looked_past() -> None:
    fresh, aged = Robot(CAR), Robot(CAR, 0.2)
    for robot in (fresh, aged):
        robot.values = np.array((3.4, 0.0, 0.0, 1.6))
        robot.applied, robot.applied_by = (2.0, 0.0), "filter"
    assert aged.turn((2.0, 0.0)).h_next < fresh.turn((2.0, 0.0)).h_next - 0.1
