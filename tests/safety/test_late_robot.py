"""A robot whose commands act late: the filter remembers what is in flight, and predicts past it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from tests.safety.node_steps import CAR, LATE, SETTINGS, asked, latent_at, state_at

from safedpa.bus import VerdictMessage
from safedpa.dynamics import PhysicsModel
from safedpa.safety.node import SafetyFilterNode


class Robot:
    """The model itself behind the filter; in the ticks of ``lost`` the watchdog's action is applied."""

    def __init__(self, model: PhysicsModel, until_action: float = 0.0, lost: tuple[int, ...] = ()) -> None:
        self.model, self.until_action, self.lost = model, until_action, lost
        self.node = SafetyFilterNode(model, SETTINGS)
        self.values = np.array((0.0, 0.0, 0.0, 0.0))
        self.memory: Any = model.initial_memory(np.zeros(2), model.latent)
        self.applied, self.applied_by, self.tick = (0.0, 0.0), "none", 0

    def turn(self, wish: tuple[float, float] = (1.0, 0.0)) -> VerdictMessage:
        told: dict[str, Any] = {"applied": self.applied, "applied_by": self.applied_by}
        state = state_at(self.tick, tuple(self.values.tolist()), until_action=self.until_action, **told)
        verdict = asked(self.node, state, latent_at(state, self.model), wish)
        lost = self.tick in self.lost
        self.applied, self.applied_by = ((0.0, 0.0), "watchdog") if lost else (verdict.action, "filter")
        self.values, self.memory = self.model.advance(
            self.values, np.array(self.applied), self.memory, self.model.latent
        )
        self.tick += 1
        return verdict


@pytest.mark.parametrize("lost", [(), (5,), (5, 6), (4, 8)])
def test_the_watchdogs_actions_come_behind_what_is_in_flight(lost: tuple[int, ...]) -> None:
    """Once they were forgotten: after one lost action the actuators seemed to have settled at the brake."""
    robot = Robot(LATE, lost=lost)
    for tick in range(14):
        truth, start = robot.memory, robot.values
        verdict = robot.turn((0.2 * tick, 0.01 * tick))
        path, _ = LATE.held(start, np.array(verdict.action), truth, LATE.latent, 8, period=0.05)
        np.testing.assert_allclose(verdict.predicted, path[: len(verdict.predicted)], atol=1e-12)


def test_predictions_that_come_true_leave_the_margin_as_it_is() -> None:
    robot = Robot(LATE)
    for _ in range(12):
        verdict = robot.turn()
    np.testing.assert_allclose(verdict.predicted[0], robot.values, atol=1e-12)
    assert verdict.margin == pytest.approx(SETTINGS.epsilon["obstacle"])


@pytest.mark.parametrize("seconds", [-0.01, 1.01, 1e6])
def test_a_state_that_is_too_old_where_its_action_acts_is_refused(seconds: float) -> None:
    verdict = Robot(CAR, seconds).turn()
    assert verdict.status == "fallback"
    assert f"its action acts {seconds:g} s later, wanted 0 to 1 s" in verdict.sentence


@pytest.mark.parametrize("age", [0.1, 0.2])
def test_the_filter_predicts_from_where_the_action_of_an_old_state_acts(age: float) -> None:
    new, old = Robot(CAR), Robot(CAR, age)
    for robot in (new, old):
        robot.values = np.array((3.4, 0.0, 0.0, 1.6))
        robot.applied, robot.applied_by = (2.0, 0.0), "filter"
    assert old.turn((2.0, 0.0)).h_next < new.turn((2.0, 0.0)).h_next - 0.5 * age
