"""Robots come and go: what they needed is given back, whatever the order."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from safedpa.bus import STATE, AbstractNode, Bus, MemoryBroker, ModelMessage, ServiceLoop, encode
from safedpa.bus.loop.turning import Agenda
from safedpa.bus.transport.in_process import MemoryTransport
from safedpa_sim.robots import CarRobot, Scene

Make = Callable[..., Any]
SCENE = Scene.random(0)


def remembered(stack: Any) -> dict[str, int]:
    """How much the services remember of robots, by where."""
    found = {}
    for node, service in zip(stack.nodes, stack.services, strict=True):
        for owner, what in (
            (node, "node"),
            (service, "loop"),
            (node._versions, "versions"),
            (service._greeting, "met"),
        ):
            for name, value in vars(owner).items():
                if isinstance(value, (dict, set)) and name not in ("_listens",):
                    found[f"{node.name}.{what}.{name}"] = len(value)
    return found


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(events=st.lists(st.tuples(st.sampled_from("abcdef"), st.integers(1, 6), st.booleans()), min_size=1, max_size=10))
def test_when_all_have_left_nothing_is_remembered(events: list[tuple[str, int, bool]], stack: Make) -> None:
    fleet = stack(())
    empty = remembered(fleet)
    bus, epochs = fleet.bus(), iter(range(1, 1000))
    stamp = {"epoch": 1, "tick": 0, "robot_time": 0.0, "publish_time": 0.0}
    offer = encode(ModelMessage(**stamp, step="offer", change=1, fingerprint="f", replaces="g", document="none"))
    for name, ticks, offered in events:
        robot = CarRobot(SCENE, 0.05, lockstep=False, epoch=next(epochs))
        for tick in range(ticks):
            bus.publish(STATE, name, dataclasses.replace(robot.state_message(), tick=tick))
            if offered:
                fleet.transport.put(f"safedpa/test/{name}/model", offer, never_drop=True)
            fleet.drive(0.05)
        fleet.clock.now += 0.4
    assert remembered(fleet) != empty
    fleet.clock.now += 31.0
    fleet.drive(0.3)
    fleet.clock.now += 31.0
    fleet.drive(0.3)
    assert remembered(fleet) == empty
    assert all(len(service._agenda) == 0 for service in fleet.services)


def test_a_thousand_names_that_come_and_go_leave_no_more_behind_than_ten(stack: Make) -> None:
    fleet = stack((), (Silent(),))
    bus = fleet.bus()
    state = CarRobot(SCENE, 0.05, lockstep=False, epoch=1).state_message()
    sizes = []
    for index in range(1000):
        bus.publish(STATE, f"robot{index}", state)
        fleet.turn()
        fleet.clock.now += 1.0
        sizes.append(len(fleet.services[0]._slots) + len(fleet.services[0]._agenda) + len(fleet.services[0]._spoken_of))
    assert max(sizes[100:]) <= max(sizes[:100]) + 1


def test_names_beyond_the_most_are_refused_and_those_who_were_there_are_served_on(stack: Make) -> None:
    node = Silent()
    fleet = stack((), (node,))
    bus = fleet.bus()
    state = CarRobot(SCENE, 0.05, lockstep=False, epoch=1).state_message()
    bus.publish(STATE, "first", state)
    for index in range(1200):
        bus.publish(STATE, f"made_up{index}", state)
    fleet.turn()
    bus.publish(STATE, "first", dataclasses.replace(state, tick=1))
    fleet.turn()
    assert len(fleet.services[0]._slots) == 1000
    assert node.served.count("first") == 2
    assert fleet.services[0]._strangers.refused == 201


def test_what_sending_needed_is_given_back_when_a_robot_leaves() -> None:
    released: list[str] = []

    class Transport(MemoryTransport):  # type: ignore[misc]  # final, but for a test that listens
        def release(self, beginning: str) -> None:
            released.append(beginning)

    now = [0.0]
    broker = MemoryBroker()
    loop = ServiceLoop(Silent(), Bus(Transport(broker), "test"), clock=lambda: now[0])
    state = CarRobot(SCENE, 0.05, lockstep=False, epoch=1).state_message()
    Bus(MemoryTransport(broker), "test").publish(STATE, "r", state)
    loop.turn(0.0)
    assert released == []
    now[0] = 31.0
    loop.turn(0.0)
    assert released == ["safedpa/test/r/"]


@given(moments=st.lists(st.tuples(st.floats(0.0, 10.0), st.sampled_from("abc")), max_size=30), now=st.floats(0.0, 10.0))
def test_an_agenda_gives_each_robot_once_when_its_moment_has_come(moments: list[tuple[float, str]], now: float) -> None:
    agenda = Agenda()
    for when, robot in moments:
        agenda.at(when, robot)
    agenda.at(float("inf"), "never")
    due = agenda.due(now)
    assert sorted(due) == sorted({robot for when, robot in moments if when <= now})
    assert agenda.next() == min((when for when, _ in moments if when > now), default=float("inf"))


@given(
    moments=st.lists(st.tuples(st.floats(0.0, 10.0), st.sampled_from("abc")), max_size=30),
    awaited=st.sets(st.sampled_from("abc")),
)
def test_nobody_wakes_up_for_robots_that_are_not_awaited(moments: list[tuple[float, str]], awaited: set[str]) -> None:
    agenda = Agenda()
    for when, robot in moments:
        agenda.at(when, robot)
    first = min((when for when, robot in moments if robot in awaited), default=float("inf"))
    assert agenda.next(awaited.__contains__) == first
    assert len(agenda) == sum(when >= first for when, _ in moments), "what came before is taken back, and no more"
    assert set(agenda.due(10.0)) == {robot for when, robot in moments if when >= first}


class Silent(AbstractNode):
    """Answers nothing, and notes whom it served."""

    name = "policy"
    inputs = ()
    outputs = ()
    share = 0.0

    def __init__(self) -> None:
        self.served: list[str] = []

    def step(self, robot: str, state: Any, inputs: Any) -> Any:
        del state, inputs
        self.served.append(robot)
        return {}
