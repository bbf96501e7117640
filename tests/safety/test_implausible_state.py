"""The filter's service brakes on a state that it cannot believe, and stays so until a person lets the robot go."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from tests.safety.node_steps import CAR, SETTINGS, asked, latent_at, state_at

from safedpa.bus import Request, StateMessage, VerdictMessage
from safedpa.runtime.node import SafetyFilterNode
from safedpa.runtime.stop_orders import StopOrders
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene


def moved(state: StateMessage, metres: float) -> StateMessage:
    return replace(state, values=(state.values[0] + metres, *state.values[1:]))


class Driven:
    """A simulated car behind the filter's node; ``metres`` is what its odometry is wrong by."""

    def __init__(self, orders: StopOrders) -> None:
        self.node = SafetyFilterNode(CAR, SETTINGS, orders=orders)
        self.robot, self.metres = CarRobot(Scene.random(11)), 0.0

    def ticks(self, count: int) -> VerdictMessage:
        for _ in range(count):
            state = moved(self.robot.state_message(), self.metres)
            verdict = asked(self.node, state, latent_at(state), (0.8, 0.0))
            self.robot.receive(_action(verdict))
            self.robot.advance()
        return verdict


def _action(verdict: VerdictMessage) -> Any:
    from safedpa.bus import ActionMessage

    shared = {name: getattr(verdict, name) for name in ("epoch", "tick", "robot_time", "publish_time")}
    return ActionMessage(**shared, values=verdict.action)


def test_a_jump_brakes_the_car_until_go_and_a_restarted_filter_keeps_it_stopped(tmp_path: Path) -> None:
    orders = StopOrders(tmp_path / "orders.json")
    car = Driven(orders)
    assert car.ticks(12).status in ("passed", "corrected")
    car.metres = 0.8
    verdict = car.ticks(1)
    assert verdict.status == "fallback"
    assert "the state is implausible, it jumped by 0.8" in verdict.sentence
    car.ticks(20)
    assert abs(car.robot.values[3]) < 0.02, "it has stopped"
    assert "state is implausible: it jumped by 0.8" in StopOrders(tmp_path / "orders.json").reason("r")
    assert orders.answer("r", Request(do="go")).ok
    car.ticks(1)
    assert car.ticks(10).status in ("passed", "corrected"), "the state of now is believed"
    assert car.robot.values[3] > 0.1


def test_a_robot_that_restarts_with_a_state_elsewhere_is_another_drive() -> None:
    node = SafetyFilterNode(CAR, SETTINGS)
    before = state_at(0)
    asked(node, before, latent_at(before))
    node.forget("r")
    again = state_at(0, (3.0, 1.0, 0.0, 0.0), epoch=2)
    assert asked(node, again, latent_at(again)).status == "passed"


@pytest.mark.parametrize("lockstep", [True, False])
def test_the_stamps_of_a_robot_in_lockstep_have_no_rate(lockstep: bool) -> None:
    node = SafetyFilterNode(CAR, SETTINGS)
    for tick in range(20):
        state = state_at(tick, (0.0, 0.0, 0.0, 0.0), lockstep=lockstep, publish_time=tick * 0.05 / 3.0)
        verdict = asked(node, state, latent_at(state), (0.0, 0.0))
    assert ("stamps advance 3 times as fast" in verdict.sentence) is not lockstep
