"""One robot is broken, hostile or in a hurry: the three others drive on, bit for bit."""

import dataclasses
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from safedpa.bus import (
    ACTION,
    NOMINAL,
    STATE,
    AbstractNode,
    ActionMessage,
    Inputs,
    ModelMessage,
    NominalMessage,
    Outputs,
    ReceivedMessage,
    StateMessage,
    encode,
)
from safedpa.errors import BusError
from safedpa.runtime.robot_session import RobotSession
from safedpa_sim.robots import CarRobot

GOOD = ("a", "b", "c")
Make = Callable[..., Any]


def poisoned(state: StateMessage, kind: str) -> bytes:
    """A state message that is wrong in one way."""
    table = {name: getattr(state, name) for name in (f.name for f in dataclasses.fields(state))}
    changes: dict[str, Any] = {
        "values": (float("nan"), 0.0, 0.0, 0.0),
        "more values": (0.0,) * 9,
        "period": 0.0,
        "huge": (1e300, 0.0, 0.0, 0.0),
        "many obstacles": tuple((0.5, 0.01 * index, 0.3) for index in range(900)),
        "field": (1.0, -1.0, 1.0, -1.0),
        "text": "drive",
    }
    if kind == "garbage":
        return b"\xff\x00 garbage"
    if kind == "too large":
        return msgpack.packb({**table, "applied_by": "x" * 70_000})
    where = {"more values": "values", "huge": "values", "many obstacles": "obstacles", "text": "goal"}.get(kind, kind)
    return msgpack.packb({**table, where: changes[kind]})


KINDS = ("garbage", "too large", "values", "more values", "period", "huge", "many obstacles", "field", "text")


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_what_one_robot_sends_changes_nothing_for_the_others(kind: str, stack: Make, undisturbed: dict[str, str]):
    fleet = stack(GOOD)
    strange = CarRobot(fleet.cars["a"].scene, 0.05, lockstep=False, epoch=77)
    ticks = iter(range(10_000))

    def poison() -> None:
        if fleet.clock.now % 0.05 < 0.0025:
            message = dataclasses.replace(strange.state_message(), tick=next(ticks))
            fleet.transport.put("safedpa/test/strange/state", poisoned(message, kind), never_drop=False)

    fleet.drive(2.0, poison)
    assert {name: item.trajectory_hash for name, item in fleet.cars.items()} == undisturbed
    assert fleet.fleet.late == 0
    actions = fleet.bus().inbox((ACTION,), "strange")
    fleet.drive(0.2, poison)
    for item in actions.take(0.0):  # every robot that can be answered is ordered to stand
        assert isinstance(item, ReceivedMessage)
        assert item.message.values == (0.0, 0.0)


@pytest.mark.parametrize("kind", ["period", "values"])
def test_refusals_are_counted_for_the_robot_that_earns_them(kind: str, stack: Make) -> None:
    fleet = stack(GOOD)
    fleet.drive(0.3)
    bad = fleet.cars["b"].state_message()

    def poison() -> None:
        fleet.transport.put("safedpa/test/b/state", poisoned(bad, kind), never_drop=False)
        fleet.turn()

    for _ in range(5):
        poison()
    refused = {name: message.refused for name, message in fleet.health("safety_filter").items()}
    assert refused["b"] == 5
    assert refused["a"] == refused["c"] == 0


class Counting(AbstractNode):
    """A policy that counts its steps."""

    name = "policy"
    inputs = ()
    outputs = (NOMINAL,)
    share = 0.2

    def __init__(self) -> None:
        self.steps: dict[str, int] = {}

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:
        self.steps[robot] = self.steps.get(robot, 0) + 1
        stamp = {"epoch": state.epoch, "tick": state.tick, "robot_time": 0.0, "publish_time": 0.0}
        return {NOMINAL: NominalMessage(**stamp, values=(0.0, 0.0), controller="test")}


@pytest.mark.parametrize("period", [0.05, 1e-9])
def test_a_flood_of_states_costs_no_more_than_its_robots_pace(period: float, stack: Make) -> None:
    node = Counting()
    fleet = stack((), (node,))
    template = CarRobot(stack(GOOD).cars["a"].scene, 0.05, lockstep=False, epoch=77).state_message()
    bus = fleet.bus()
    for tick in range(2000):  # a thousand a second
        bus.publish(STATE, "flood", dataclasses.replace(template, tick=tick, period=period))
        if tick % 50 == 0:
            bus.publish(STATE, "good", dataclasses.replace(template, epoch=78, tick=tick // 50))
        fleet.turn()
        fleet.clock.now += 0.001
    assert node.steps["good"] == 40
    assert node.steps["flood"] <= (2.0 * 2.0 / 0.05 + 11 if period == 0.05 else 2000)


def test_a_flood_between_two_turns_is_one_step(stack: Make) -> None:
    node = Counting()
    fleet = stack((), (node,))
    template = CarRobot(stack(GOOD).cars["a"].scene, 0.05, lockstep=True, epoch=77).state_message()
    bus = fleet.bus()
    for turn in range(5):
        for tick in range(1000):
            bus.publish(STATE, "flood", dataclasses.replace(template, tick=1000 * turn + tick))
        fleet.turn()
    assert node.steps == {"flood": 5}


@pytest.mark.long
def test_a_flood_of_models_leaves_the_loop_its_turns(stack: Make, undisturbed: dict[str, str]) -> None:
    fleet = stack(GOOD)
    stamp = {"epoch": 1000, "tick": 0, "robot_time": 0.0, "publish_time": 0.0}
    offer = ModelMessage(**stamp, step="offer", change=1, fingerprint="f", replaces="g", document="no model" * 100)
    payload = encode(offer)

    def flood() -> None:
        for _ in range(25):
            fleet.transport.put("safedpa/test/strange/model", payload, never_drop=True)

    fleet.drive(2.0, flood)
    assert {name: item.trajectory_hash for name, item in fleet.cars.items()} == undisturbed


def broken_for(monkeypatch: pytest.MonkeyPatch, fleet: Any, name: str, error: BaseException) -> None:
    """Makes every decision of one robot raise."""
    epoch = fleet.cars[name].guard.epoch
    original = RobotSession.usable_latent

    def raising(self: RobotSession, state: StateMessage, inputs: Inputs) -> Any:
        if state.epoch == epoch:
            raise error
        return original(self, state, inputs)

    monkeypatch.setattr(RobotSession, "usable_latent", raising)


@pytest.mark.parametrize("error", [RuntimeError("broken"), ZeroDivisionError(), RecursionError(), AssertionError()])
def test_a_decision_that_raises_rests_its_own_robot_alone(error, stack, undisturbed, monkeypatch):
    fleet = stack(GOOD)
    broken_for(monkeypatch, fleet, "b", error)
    fleet.drive(2.0)
    for name in ("a", "c"):
        assert fleet.cars[name].trajectory_hash == undisturbed[name]
    car = fleet.cars["b"]
    assert (car.watchdog_ticks, car.at_rest) == (0, True), "the filter itself brakes, the watchdog need not"
    verdict = fleet.verdicts()["b"]
    assert (verdict.status, verdict.action) == ("fallback", (0.0, 0.0))
    assert type(error).__name__ in verdict.sentence
    health = fleet.health("safety_filter")
    assert health["b"].state == "failing"
    assert health["a"].state == health["c"].state == "running"


def test_a_robot_recovers_when_its_decisions_do_and_the_watch_over_its_margin_goes_on(stack, monkeypatch):
    """A margin that was widened must not fall back; a new watch would know no coverage after so short a time."""
    fleet = stack(GOOD)
    fleet.drive(0.3)
    assert fleet.verdicts()["b"].coverage == -1.0
    fleet.drive(2.2)
    before = fleet.verdicts()["b"]
    assert 0.9 < before.coverage < 1.0
    with monkeypatch.context() as patched:
        broken_for(patched, fleet, "b", RuntimeError("broken"))
        fleet.drive(0.5)
    fleet.drive(0.3)
    after = fleet.verdicts()["b"]
    assert after.status != "fallback"
    assert after.coverage == pytest.approx(before.coverage, abs=0.02)
    assert after.margin == before.margin


@pytest.mark.parametrize("error", [BusError("closed"), MemoryError(), KeyboardInterrupt()])
def test_an_error_of_the_process_itself_ends_it(error: BaseException, stack: Make, monkeypatch: pytest.MonkeyPatch):
    fleet = stack(GOOD)
    broken_for(monkeypatch, fleet, "b", error)
    with pytest.raises(type(error)):
        fleet.drive(0.5)


@pytest.mark.parametrize("method", ["prepare", "afterwards", "hear", "adopt_model"])
def test_an_error_outside_the_step_is_handled_likewise(method, stack, undisturbed, monkeypatch):
    fleet = stack(GOOD)
    node = type(fleet.nodes[2])
    original = getattr(node, method)

    def raising(self: Any, robot: str, *rest: Any) -> Any:
        if robot == "b":
            raise RuntimeError("broken")
        return original(self, robot, *rest)

    monkeypatch.setattr(node, method, raising)
    stamp = {"epoch": 1001, "tick": 0, "robot_time": 0.0, "publish_time": 0.0}
    offer = ModelMessage(**stamp, step="offer", change=1, fingerprint="f", replaces="g")
    fleet.transport.put("safedpa/test/b/model", encode(offer), never_drop=True)
    fleet.drive(2.0)
    for name in ("a", "c"):
        assert fleet.cars[name].trajectory_hash == undisturbed[name]
    assert fleet.cars["b"].watchdog_ticks == 0


def test_a_second_robot_under_each_name_in_use_is_refused(stack: Make, undisturbed: dict[str, str]) -> None:
    fleet = stack(GOOD)
    others = {name: dataclasses.replace(car.state_message(), epoch=5) for name, car in fleet.cars.items()}
    bus, ticks = fleet.bus(), iter(range(100_000))

    def speak() -> None:
        fleet.turn()  # so that the impostor's state does not replace the unread one of the robot
        if fleet.clock.now < 100.1:
            return
        for name, state in others.items():
            bus.publish(STATE, name, dataclasses.replace(state, tick=next(ticks)))

    fleet.drive(2.0, speak)
    assert {name: item.trajectory_hash for name, item in fleet.cars.items()} == undisturbed
    assert all(message.refused > 50 for message in fleet.health("policy").values())


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    bits=st.binary(max_size=300),
    topic=st.sampled_from(("state", "latent", "nominal", "action", "model", "health/policy", "nonsense", "*")),
    robot=st.sampled_from(("strange", "a*", "**", "", "-", "a b")),
)
def test_no_bytes_under_any_foreign_key_end_a_service(bits: bytes, topic: str, robot: str, stack: Make) -> None:
    fleet = stack(("a",))
    fleet.drive(0.15)
    key = f"safedpa/test/{robot}/{topic}"
    for _, _, deliver in tuple(fleet.broker.subscribers):
        deliver(key, bits)
    fleet.drive(0.15)
    assert fleet.fleet.late == 0


def test_actions_of_a_rescue_are_within_the_limits_of_the_robot(stack: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    fleet = stack(("a",))
    broken_for(monkeypatch, fleet, "a", RuntimeError("broken"))
    inbox = fleet.bus().inbox((ACTION,), "a")
    fleet.drive(0.1)
    messages = [item.message for item in inbox.take(0.0) if isinstance(item, ReceivedMessage)]
    assert messages
    for message in messages:
        assert isinstance(message, ActionMessage)
        assert np.array(message.values).tolist() == [0.0, 0.0]
