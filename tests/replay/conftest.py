"""A car with its services in one process, by a clock of the test's own: services stall, die and come back."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import final

import pytest
from tests.messages import STAMP

from safedpa.adaptation import AdaptationNode
from safedpa.bus import (
    ACTION,
    MODEL,
    NO_ROBOT,
    SCAN,
    SETUP,
    STATE,
    TAKEOVER,
    TOPICS,
    AbstractNode,
    ActionMessage,
    Bus,
    MemoryBroker,
    MemoryTransport,
    ModelMessage,
    ReceivedMessage,
    ServiceLoop,
    SetupMessage,
    TakeoverMessage,
)
from safedpa.bus.messages.requests import Request
from safedpa.bus.messages.service_info import setup_message
from safedpa.dynamics import fingerprint, load_model, parse_model, write_model
from safedpa.dynamics.model_offer import model_setup
from safedpa.perception import PerceptionNode, parse_perception
from safedpa.policy import PolicyNode
from safedpa.records import McapRecorder
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import margin_for, settings_named
from safedpa.safety.margins.calibration import margin_text
from safedpa.safety.settings import write_settings
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.sensing.sensor_inputs import SimulatedSensors

PERIOD = 0.05
ROBOT = "r1"
OFFSET = '\n[[effects]]\nname = "steering_offset"\nangle = { value = 0.01, free = true }\n'
SERVICES = ("adaptation", "policy", "safety_filter")


def built(service: str, name: str, controller: str | None, zones: str = "") -> tuple[AbstractNode, SetupMessage]:
    """A service's node and its setup, as its process makes them."""
    model = load_model(name)
    if service == "perception":
        return PerceptionNode(parse_perception(zones)), dataclasses.replace(setup_message(service, {}), settings=zones)
    setup = model_setup(setup_message(service, {"model": name}), model)
    if service == "adaptation":
        return AdaptationNode(model), setup
    if service == "policy":
        return PolicyNode(model, controller=controller), dataclasses.replace(setup, controller=controller or "")
    settings, margin = settings_named("car"), margin_for(model)
    assert margin is not None
    setup = dataclasses.replace(setup, settings=write_settings(settings), margin=margin_text(margin))
    return SafetyFilterNode(model, settings, margin), setup


def offered(name: str, change: int) -> ModelMessage:
    """The model with a steering offset and a margin of its own, as the diagnosis would offer it."""
    model = load_model(name)
    changed = parse_model(write_model(model) + OFFSET)
    margin = margin_for(model)
    assert margin is not None
    return ModelMessage(
        **STAMP,
        step="offer",
        change=change,
        fingerprint=fingerprint(changed),
        replaces=fingerprint(model),
        document=write_model(changed),
        margin=margin_text(dataclasses.replace(margin, fingerprint=fingerprint(changed), date="2026-01-01")),
    )


@final
class Fleet:
    """One car, its three services, and a recorder of every message."""

    def __init__(
        self,
        model: str = "car",
        load: str = "box",
        controller: str | None = None,
        seed: int = 3,
        sensor_inputs: Callable[[], SimulatedSensors] | None = None,
        zones: str = "",
    ) -> None:
        self.now = 0.0
        self._sensor_inputs = sensor_inputs
        self._services = SERVICES if sensor_inputs is None else ("perception", *SERVICES)
        self._model, self._controller, self._zones = model, controller, zones
        self._broker = MemoryBroker()
        self._bus = Bus(MemoryTransport(self._broker), "test")
        self._actions = self._bus.inbox((ACTION, TAKEOVER), keep_all=True)
        self._recorded = self._bus.inbox(tuple(TOPICS.values()), keep_all=True, clock=lambda: self.now)
        self.metres = 0.0
        """By how much the reported x is wrong."""
        self.heard: list[ReceivedMessage] = []
        self.takeovers: list[TakeoverMessage] = []
        self._loops: dict[str, tuple[Bus, ServiceLoop]] = {}
        self._nodes: dict[str, AbstractNode] = {}
        self._scene = Scene.random(seed, load)
        self._epoch = 0
        self.start_robot()
        for service in self._services:
            self.start(service)

    def start_robot(self) -> None:
        """The robot starts under a new epoch, after it was silent for long enough."""
        self._epoch += 1
        self.now += 1.0
        self.robot = CarRobot(
            self._scene,
            PERIOD,
            lockstep=False,
            epoch=self._epoch,
            wall_clock=lambda: self.now,
            sensor_inputs=self._sensor_inputs and self._sensor_inputs(),
        )

    def start(self, service: str) -> None:
        """A new process of a service, which says its setup."""
        node, setup = built(service, self._model, self._controller, self._zones)
        self._nodes[service] = node
        bus = Bus(MemoryTransport(self._broker), "test")
        self._loops[service] = (bus, ServiceLoop(node, bus, clock=lambda: self.now))
        bus.publish(SETUP, NO_ROBOT, setup, service)

    def kill(self, service: str) -> None:
        """Ends a service in the middle of whatever it did."""
        if service in self._loops:
            self._loops.pop(service)[0].close()

    def order(self, *switches: str, who: str) -> None:
        """Switches sources and zones of perception."""
        node = self._nodes["perception"]
        assert isinstance(node, PerceptionNode)
        assert node.switches.answer(ROBOT, Request(do="switch", switches=switches, who=who)).ok

    def stop_order(self, do: str) -> None:
        """An order of a person to the safety filter, or a confirmation."""
        node = self._nodes["safety_filter"]
        assert isinstance(node, SafetyFilterNode)
        assert node.orders.answer(ROBOT, Request(do=do, who="a test")).ok

    def send(self, message: ModelMessage) -> None:
        """One step of a change of the model, as the diagnosis would say it."""
        stamp = {"epoch": self._epoch, "tick": self.robot.tick, "robot_time": self.robot.tick * PERIOD}
        self._bus.publish(MODEL, ROBOT, dataclasses.replace(message, **stamp))

    def tick(self, stalled: frozenset[str] = frozenset()) -> None:
        """One period in real time; stalled services do nothing in it."""
        begin = self.now
        for scan in self.robot.scans():
            self._bus.publish(SCAN, ROBOT, scan)
        state = self.robot.state_message()
        x, *others = state.values
        self._bus.publish(STATE, ROBOT, dataclasses.replace(state, values=(x + self.metres, *others)))
        for share in (0.01, 0.25, 0.6, 0.75):
            self.now = begin + share * PERIOD
            for service in self._services:
                if service in self._loops and service not in stalled:
                    self._loops[service][1].turn(0.0)
        for item in self._actions.take(0.0):
            message = item.message if isinstance(item, ReceivedMessage) else None
            if isinstance(message, ActionMessage):
                self.robot.receive(message)
            elif isinstance(message, TakeoverMessage):
                self.takeovers.append(message)
        self.robot.advance()
        self.now = begin + PERIOD
        self.heard += [item for item in self._recorded.take(0.0) if isinstance(item, ReceivedMessage)]

    def record(self, path: Path, keep: Callable[[ReceivedMessage], bool] = lambda _: True) -> Path:
        """Writes what was heard, or what a recorder would have got of it."""
        with McapRecorder(path) as recorder:
            for item in self.heard:
                if keep(item):
                    at = round(1e9 * (1_700_000_000 + item.at))
                    recorder.write(item.key, item.payload, at, at)
        return path


def driven(fleet: Fleet, ticks: int, events: Sequence[tuple[int, str, str, int]] = ()) -> Fleet:
    """Drives through a story: (tick, what, service, for how many ticks)."""
    stalls: dict[str, int] = {}
    dead: dict[str, int] = {}
    for tick in range(ticks):
        for at, what, service, length in events:
            if at != tick:
                continue
            if what == "stall":
                stalls[service] = tick + length
            elif what == "robot":
                fleet.start_robot()
            else:
                fleet.kill(service)
                dead[service] = tick + (length if what == "kill" else 0)
        for service in [name for name, until in dead.items() if tick >= until]:
            fleet.start(service)
            del dead[service]
        fleet.tick(frozenset(name for name, until in stalls.items() if tick < until))
    return fleet


@pytest.fixture(scope="session")
def fleet_of() -> type[Fleet]:
    return Fleet


@pytest.fixture(scope="session")
def offer_of() -> Callable[[str, int], ModelMessage]:
    return offered
