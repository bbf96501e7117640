"""What services remember of robots: nothing once they have left, in whatever order they come and go."""

import dataclasses
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fleet_process.conftest import Stack
from tests.fleet_process.test_membership import SCENE, Silent

from safedpa.bus import STATE, ModelMessage, encode
from safedpa_sim.robots import CarRobot


def cached(stack: Any) -> dict[str, int]:
    """How much the services remember of robots, by where."""
    found = {}
    for node, service in zip(stack.nodes, stack.services, strict=True):
        owners = {"node": node, "loop": service, "versions": node._versions, "met": service._handshake}
        for what, owner in owners.items():
            for name, value in vars(owner).items():
                if isinstance(value, (dict, set)) and name != "_listens":
                    found[f"{node.name}.{what}.{name}"] = len(value)
    return found


@settings(max_examples=8, deadline=None)
@given(events=st.lists(st.tuples(st.sampled_from("abcdef"), st.integers(1, 6), st.booleans()), min_size=1, max_size=10))
def test_when_all_robots_have_left_nothing_is_remembered(events: list[tuple[str, int, bool]]) -> None:
    fleet = Stack(())
    empty = cached(fleet)
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
    assert cached(fleet) != empty
    for _ in range(2):
        fleet.clock.now += 31.0
        fleet.drive(0.3)
    assert cached(fleet) == empty
    assert all(len(service._timers) == 0 for service in fleet.services)


def test_a_thousand_names_that_come_and_go_leave_no_more_behind_than_ten() -> None:
    fleet = Stack((), (Silent(),))
    bus, (service,) = fleet.bus(), fleet.services
    state = CarRobot(SCENE, 0.05, lockstep=False, epoch=1).state_message()
    sizes = []
    for index in range(1000):
        bus.publish(STATE, f"robot{index}", state)
        fleet.turn()
        fleet.clock.now += 1.0
        sizes.append(len(service._slots) + len(service._timers) + len(service._mentioned))
    assert max(sizes[100:]) <= max(sizes[:100]) + 1


def test_the_simulation_does_not_wake_up_for_an_action_that_came() -> None:
    fleet = Stack(tuple(f"car{index}" for index in range(5)))
    fleet.drive(0.5)
    loop: Any = fleet.fleet
    for _ in range(100):
        moment = loop._next_moment()
        live = [
            when
            for when, name, tick, sensor_inputs in loop._events
            if sensor_inputs or loop._scheduled[name].robot.tick == tick
        ]
        assert moment == min(live)
        fleet.drive(0.0025)
