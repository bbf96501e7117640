"""How long the nodes of one robot take from a scan to an action, one after the other in one process."""

from __future__ import annotations

import time
from typing import Any

from safedpa.adaptation import AdaptationNode
from safedpa.bus import (
    ACTION,
    LATENT,
    NOMINAL,
    SURROUNDINGS,
    ActionMessage,
    ScanMessage,
    SurroundingsMessage,
    decode,
    encode,
)
from safedpa.dynamics import load_model
from safedpa.perception import PerceptionNode
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import margin_for, settings_named
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.sensing import Laser, LaserSettings
from safedpa_sim.sensing.people import walkers
from safedpa_sim.sensing.sensor_inputs import SimulatedSensors

__all__ = ["chain_times"]

_NAME, _PEOPLE, _WARM, _SEED = "r1", 3, 20, 0


def chain_times(rays: int, scans: int) -> tuple[list[float], list[float]]:
    """Microseconds, by the clock and of the processor, of each tick that a scan came before, from its bytes to the
    action's; ``scans`` of them.

    A car drives among pillars and people; what adaptation, perception, policy and filter need is counted, the
    simulation and the network are not.
    """
    model, scene = load_model("car"), Scene.random(_SEED)
    robot = CarRobot(
        scene, sensor_inputs=SimulatedSensors((Laser(LaserSettings(rays=rays), _SEED),), walkers(scene, _PEOPLE))
    )
    adaptation, perception = AdaptationNode(model), PerceptionNode()
    policy, safety = PolicyNode(model), SafetyFilterNode(model, settings_named("car"), margin_for(model))
    nodes = (adaptation, perception, policy, safety)
    for node in nodes:
        node.adopt_model(_NAME, None)
    wall: list[float] = []
    processor: list[float] = []
    while len(wall) < _WARM + scans:
        state, reported = robot.state_message(), [encode(scan) for scan in robot.scans()]
        used, began = time.process_time(), time.perf_counter()
        for data in reported:
            perception.hear(_NAME, decode(ScanMessage, data))
        inputs: dict[Any, Any] = {LATENT: adaptation.step(_NAME, state, {})[LATENT]}
        inputs[SURROUNDINGS] = decode(SurroundingsMessage, encode(perception.step(_NAME, state, {})[SURROUNDINGS]))
        inputs[NOMINAL] = policy.step(_NAME, state, inputs)[NOMINAL]
        action = safety.step(_NAME, state, inputs)[ACTION]
        heard = encode(action)
        elapsed, spent = time.perf_counter() - began, time.process_time() - used
        for node in nodes:
            node.afterwards(_NAME)
        robot.receive(decode(ActionMessage, heard))
        robot.advance()
        if reported:
            wall.append(1e6 * elapsed)
            processor.append(1e6 * spent)
    return wall[_WARM:], processor[_WARM:]
