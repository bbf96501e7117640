"""Recorded actions put back onto a bus that no one guards: the robot's own gate refuses them, anyone who sends them."""

import dataclasses
from collections.abc import Callable, Iterable

import pytest

from safedpa.adaptation import AdaptationNode
from safedpa.bus import ActionMessage, decode, encode
from safedpa.bus.messages.messages import StateMessage
from safedpa.dynamics import load_model
from safedpa.errors import MessageError
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import margin_for, settings_named
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene

TICKS = 60
Attack = Callable[[int, ActionMessage], Iterable[ActionMessage]]


class Attacked:
    """A car that is sent an attacker's actions, too; the attacker is faster than the filter where ``before``."""

    def __init__(self, epoch: int, attack: Attack, *, before: bool = True) -> None:
        self.car = CarRobot(Scene.random(5, "none"), epoch=epoch)
        self.recorded: list[ActionMessage] = []
        self._attack, self._before = attack, before

    def state_message(self) -> StateMessage:
        return self.car.state_message()

    def receive(self, message: ActionMessage) -> str | None:
        self.recorded.append(message)
        sent = [decode(ActionMessage, encode(forged)) for forged in self._attack(self.car.tick, message)]
        if self._before:
            for forged in sent:
                self.car.receive(forged)
            return self.car.receive(message)
        answer = self.car.receive(message)
        for forged in sent:
            self.car.receive(forged)
        return answer

    def advance(self) -> None:
        self.car.advance()


def driven(epoch: int = 1, attack: Attack = lambda tick, honest: (), *, before: bool = True) -> Attacked:
    model = load_model("car")
    filtering = SafetyFilterNode(model, settings_named("car"), margin_for(model, ""))
    robot = Attacked(epoch, attack, before=before)
    for _ in drive(robot, (AdaptationNode(model), PolicyNode(model), filtering), TICKS):
        pass
    return robot


@pytest.fixture(scope="module")
def recorded() -> Attacked:
    """A drive that an attacker has recorded to the last byte."""
    return driven()


@pytest.mark.parametrize("before", [True, False])
def test_of_an_earlier_drive(recorded: Attacked, before: bool) -> None:
    again = driven(2, lambda tick, honest: recorded.recorded, before=before)
    assert again.car.trajectory_hash == recorded.car.trajectory_hash
    assert again.car.guard.refusals == {"wrong epoch": TICKS * TICKS}


@pytest.mark.parametrize("before", [True, False])
def test_of_the_same_drive_and_older(recorded: Attacked, before: bool) -> None:
    again = driven(1, lambda tick, honest: recorded.recorded[:tick], before=before)
    assert again.car.trajectory_hash == recorded.car.trajectory_hash
    assert again.car.guard.refusals == {"late": TICKS * (TICKS - 1) // 2}


@pytest.mark.parametrize("before", [True, False])
def test_of_the_same_drive_and_to_come(recorded: Attacked, before: bool) -> None:
    again = driven(1, lambda tick, honest: recorded.recorded[tick + 1 :], before=before)
    assert again.car.trajectory_hash == recorded.car.trajectory_hash
    assert again.car.guard.refusals == {"from the future": TICKS * (TICKS - 1) // 2}


@pytest.mark.parametrize("values", [(9.0, 0.0), (0.0, -9.0), (1.0,), (1.0, 0.0, 0.0), ()])
def test_of_this_tick_but_beyond_the_actuators(recorded: Attacked, values: tuple[float, ...]) -> None:
    again = driven(1, lambda tick, honest: [dataclasses.replace(honest, values=values)])
    assert again.car.trajectory_hash == recorded.car.trajectory_hash
    assert sum(again.car.guard.refusals.values()) == TICKS


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e13])
def test_what_is_no_number_does_not_become_a_message(recorded: Attacked, value: float) -> None:
    with pytest.raises(MessageError, match=r"ActionMessage\.values"):
        decode(ActionMessage, encode(dataclasses.replace(recorded.recorded[0], values=(value, 0.0))))


def test_a_twin_of_the_filter_that_is_slower_changes_nothing_and_is_counted(recorded: Attacked) -> None:
    again = driven(1, lambda tick, honest: [dataclasses.replace(honest, values=(1.0, 0.3))], before=False)
    assert again.car.trajectory_hash == recorded.car.trajectory_hash
    assert again.car.guard.refusals == {"repeated": TICKS}


def test_a_twin_of_the_filter_that_is_faster_drives_and_is_only_counted(recorded: Attacked) -> None:
    """What does not hold: who has the filter's key is the filter. The threat model says so."""
    again = driven(1, lambda tick, honest: [dataclasses.replace(honest, values=(1.0, 0.3))])
    assert again.car.trajectory_hash != recorded.car.trajectory_hash
    assert again.car.guard.refusals == {"repeated": TICKS}
