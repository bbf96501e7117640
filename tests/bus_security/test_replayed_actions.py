"""Recorded actions put back onto a bus that no one guards: the robot's own gate refuses them, anyone who sends them."""

import dataclasses
from collections.abc import Callable, Iterable

import pytest

from safedpa.adaptation import AdaptationNode
from safedpa.bus import ActionMessage, decode, encode
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
        self.state_message, self.scans, self.advance = self.car.state_message, self.car.scans, self.car.advance
        self.recorded: list[ActionMessage] = []
        self._attack, self._before = attack, before

    def receive(self, message: ActionMessage) -> str | None:
        self.recorded.append(message)
        sent = [decode(ActionMessage, encode(forged)) for forged in self._attack(self.car.tick, message)]
        first, last = (sent, []) if self._before else ([], sent)
        answers = [self.car.receive(one) for one in (*first, message, *last)]
        return answers[len(first)]


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
@pytest.mark.parametrize(
    ("epoch", "sent", "refusals"),
    [
        (2, lambda _: slice(None), {"wrong epoch": TICKS * TICKS}),
        (1, lambda tick: slice(0, tick), {"late": TICKS * (TICKS - 1) // 2}),
        (1, lambda tick: slice(tick + 1, None), {"from the future": TICKS * (TICKS - 1) // 2}),
    ],
    ids=["of an earlier drive", "of the same drive and older", "of the same drive and to come"],
)
def test_recorded_actions_change_nothing(recorded, epoch, sent, refusals, before):
    again = driven(epoch, lambda tick, honest: recorded.recorded[sent(tick)], before=before)
    assert again.car.trajectory_hash == recorded.car.trajectory_hash
    assert again.car.guard.refusals == refusals


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
