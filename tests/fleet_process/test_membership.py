"""Robots come and go: what they needed is given back, and there is room for a thousand of them."""

import dataclasses
from collections.abc import Callable
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from safedpa.bus import HEALTH, STATE, AbstractNode, Bus, MemoryBroker, ServiceLoop
from safedpa.bus.service.service_loop import TimerQueue
from safedpa.bus.transport.memory import MemoryTransport
from safedpa_sim.robots import CarRobot, Scene

Make = Callable[..., Any]
SCENE = Scene.random(0)


def test_robots_beyond_a_thousand_are_refused_and_the_others_are_served_on(stack: Make) -> None:
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
    assert len(set(node.served)) == 1000
    assert node.served.count("first") == 2
    healths = fleet.bus().inbox((HEALTH,), "first", clock=fleet.clock)
    fleet.drive(0.3)
    assert [item.message.refused for item in healths.take(0.0)] == [201]


def test_what_sending_needed_is_given_back_when_a_robot_leaves() -> None:
    released: list[str] = []

    class Transport(MemoryTransport):  # type: ignore[misc]  # final, but for a test that listens
        def release(self, prefix: str) -> None:
            released.append(prefix)

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
def test_a_timer_queue_returns_each_robot_once_when_it_is_due(moments: list[tuple[float, str]], now: float) -> None:
    timers = TimerQueue()
    for when, robot in moments:
        timers.at(when, robot)
    timers.at(float("inf"), "never")
    due = timers.due(now)
    assert sorted(due) == sorted({robot for when, robot in moments if when <= now})
    assert timers.next() == min((when for when, _ in moments if when > now), default=float("inf"))


@given(
    moments=st.lists(st.tuples(st.floats(0.0, 10.0), st.sampled_from("abc")), max_size=30),
    awaited=st.sets(st.sampled_from("abc")),
)
def test_robots_that_are_not_awaited_have_no_moment(moments: list[tuple[float, str]], awaited: set[str]) -> None:
    timers = TimerQueue()
    for when, robot in moments:
        timers.at(when, robot)
    first = min((when for when, robot in moments if robot in awaited), default=float("inf"))
    assert timers.next(awaited.__contains__) == first
    assert len(timers) == sum(when >= first for when, _ in moments), "what came before is taken back, and no more"
    assert set(timers.due(10.0)) == {robot for when, robot in moments if when >= first}


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
