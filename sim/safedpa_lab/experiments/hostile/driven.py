"""A car and its three services over a bus in memory, to which someone with every key sends mutated messages."""

from __future__ import annotations

import random
import time
from typing import final

from safedpa.adaptation import AdaptationNode
from safedpa.bus import Bus, MemoryBroker, MemoryTransport, ServiceLoop
from safedpa.bus.messages.topics import TOPICS, key_of
from safedpa.dynamics import load_model
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import margin_for, settings_named
from safedpa_lab.experiments.hostile.mutations import mutated
from safedpa_lab.experiments.hostile.targets import messages
from safedpa_sim.robots import CarRobot, Scene
from safedpa_sim.robots.fleet.loop import FleetLoop

_TURN_SECONDS = 0.0025
_MESSAGES = 4
"""Hostile ones a turn."""
_NAMES = ("r1", "r2", "\x1b[2J", "x" * 200, "-", "+")


@final
class DrivenLoop:
    """Turned by hand; its clock moves as it is turned."""

    def __init__(self) -> None:
        self._now = 100.0
        self._broker = MemoryBroker()
        model = load_model("car")
        nodes = (
            AdaptationNode(model),
            PolicyNode(model),
            SafetyFilterNode(model, settings_named("car"), margin_for(model)),
        )
        self._services = [ServiceLoop(node, self._bus(), clock=self._clock) for node in nodes]
        car = CarRobot(Scene.random(0, "none"), 0.05, lockstep=False, epoch=1)
        self._robots = FleetLoop({"r1": car}, self._bus(), clock=self._clock)
        self._stranger = MemoryTransport(self._broker)
        self._seeds = tuple(payload for _, payload in messages())
        for _ in range(400):
            self._turn()

    @property
    def refused(self) -> int:
        """Messages that no service took."""
        return sum(loop._unserved.refused for loop in self._services)

    def attacked(self, chance: random.Random) -> tuple[float, str]:
        """s of processor time that the slowest service took for one turn under attack, and what it raised."""
        for _ in range(_MESSAGES):
            topic = chance.choice(list(TOPICS.values()))
            key = f"safedpa/test/{chance.choice(_NAMES)}/{topic.name}" + ("/policy" if topic.per_service else "")
            if chance.random() < 0.7:
                key = key_of("test", "r1", topic, "policy")
            self._stranger.put(key, mutated(chance, self._seeds), never_drop=topic.delivery == "all")
        worst, hole = 0.0, ""
        self._now += _TURN_SECONDS
        self._robots.step()
        for service in self._services:
            began = time.thread_time()
            try:
                service.turn(0.0)
            except Exception as error:  # noqa: BLE001  this is what is looked for
                hole = f"{type(error).__name__}: {error}"[:200]
            worst = max(worst, time.thread_time() - began)
        return worst, hole

    def _turn(self) -> None:
        self._now += _TURN_SECONDS
        self._robots.step()
        for service in self._services:
            service.turn(0.0)

    def _clock(self) -> float:
        return self._now

    def _bus(self) -> Bus:
        return Bus(MemoryTransport(self._broker), "test")
