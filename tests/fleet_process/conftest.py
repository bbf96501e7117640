"""Cars and the three services over a bus in memory, in real time by a clock that the test moves."""

from collections.abc import Callable, Sequence
from typing import Any

import pytest

from safedpa.adaptation import AdaptationNode
from safedpa.bus import (
    HEALTH,
    VERDICT,
    AbstractNode,
    Bus,
    HealthMessage,
    MemoryBroker,
    MemoryTransport,
    ReceivedMessage,
    ServiceLoop,
    VerdictMessage,
)
from safedpa.bus.transport.memory import JointTransport
from safedpa.dynamics import load_model
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import margin_for, settings_named
from safedpa_sim.robots import CarRobot, Scene
from safedpa_sim.robots.fleet.loop import FleetLoop

PERIOD = 0.05
LOADS = ("none", "box", "chair")
MODEL = load_model("car")


class Clock:
    """Is stationary unless it is moved."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class Stack:
    """A fleet and the services that serve it, turned by hand."""

    def __init__(self, names: Sequence[str], nodes: Sequence[AbstractNode] | None = None, joint: Sequence[str] = ()):
        """The services share a session in which messages of the ``joint`` topics do not leave the process."""
        self.clock, self.broker = Clock(), MemoryBroker()
        self.transport = MemoryTransport(self.broker)
        settings = settings_named("car")
        self.nodes = nodes or (
            AdaptationNode(MODEL),
            PolicyNode(MODEL),
            SafetyFilterNode(MODEL, settings, margin_for(MODEL, "")),
        )
        shared = JointTransport(MemoryTransport(self.broker), frozenset(joint))
        buses = [Bus(shared, "test") if joint else self.bus() for _ in self.nodes]
        self.services = [ServiceLoop(*pair, clock=self.clock) for pair in zip(self.nodes, buses, strict=True)]
        self.cars = {name: car(index, self.clock) for index, name in enumerate(names)}
        self.fleet = FleetLoop(self.cars, self.bus(), clock=self.clock) if names else None
        self._healths = self.bus().inbox((HEALTH,), clock=self.clock)
        self._verdicts = self.bus().inbox((VERDICT,), clock=self.clock)

    def bus(self) -> Bus:
        return Bus(MemoryTransport(self.broker), "test")

    def turn(self) -> None:
        """Everybody once, in the direction of the data."""
        if self.fleet is not None:
            self.fleet.step()
        for service in self.services:
            service.turn(0.0)

    def drive(self, seconds: float, meanwhile: Callable[[], object] = lambda: None) -> None:
        """Turns every 2.5 ms of the clock."""
        for _ in range(round(seconds / 0.0025)):
            meanwhile()
            self.turn()
            self.clock.now += 0.0025

    def health(self, service: str) -> dict[str, HealthMessage]:
        """The newest heartbeat of a service, by robot."""
        self.drive(0.3)
        items = [item.message for item in self._healths.take(0.0) if isinstance(item, ReceivedMessage)]
        found: dict[str, HealthMessage] = {}
        for item in self._last(items, service):
            found[item[0]] = item[1]
        return found

    def _last(self, messages: Sequence[Any], service: str) -> list[tuple[str, HealthMessage]]:
        by_epoch = {car.guard.epoch: name for name, car in self.cars.items()}
        return [(by_epoch.get(m.epoch, "?"), m) for m in messages if m.service == service]

    def verdicts(self) -> dict[str, VerdictMessage]:
        """The newest verdicts since the last call, by robot."""
        items = [item for item in self._verdicts.take(0.0) if isinstance(item, ReceivedMessage)]
        return {item.robot: item.message for item in items if isinstance(item.message, VerdictMessage)}


def car(index: int, clock: Clock) -> CarRobot:
    """The car of a number: its scene, its load and its epoch. Its states are dated by the clock that turns it."""
    scene = Scene.random(index, LOADS[index % len(LOADS)])
    return CarRobot(scene, PERIOD, lockstep=False, epoch=1000 + index, wall_clock=clock)


@pytest.fixture
def stack() -> Callable[..., Stack]:
    """``stack(names, nodes)``."""
    return Stack


@pytest.fixture(scope="session")
def undisturbed() -> dict[str, str]:
    """Trajectories of the cars a, b and c over two seconds without a disturbance."""
    alone = Stack(("a", "b", "c"))
    alone.drive(2.0)
    assert alone.fleet is not None
    assert alone.fleet.late == 0
    return {name: item.trajectory_hash for name, item in alone.cars.items()}
