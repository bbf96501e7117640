"""Many robots through adaptation, policy and filter in one process."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Final, final

from safedpa.adaptation import AdaptationNode
from safedpa.bus import ACTION, LATENT, WISH
from safedpa.dynamics import load_model
from safedpa.policy import PolicyNode
from safedpa.safety.node import SafetyFilterNode
from safedpa.safety.shipped import settings_named
from safedpa_services.benchmarks.results import Curve, Effort, Entry, Row, Target
from safedpa_services.benchmarks.timing import percentiles

__all__ = ["measure"]

_LOADS: Final = ("none", "box", "chair", "large_chair")
_WARM = 4
"""Turns before the counting begins."""

Chain = Callable[[list[Any]], list[Any]]
"""From the states of all robots to their actions."""


def measure(effort: Effort) -> Row:
    """Simulated cars with loads in turn, driven by what comes out; only the services' work is counted."""
    sizes = effort.of((1, 8), (1, 10, 100, 1000))
    turns = effort.of(6, 40)
    singly = {size: _per_robot(_OneByOne("car_learned"), size, turns) for size in sizes}
    largest = sizes[-1]
    note = "step after step through the nodes that the services run: state message in, action message out"
    ours = (_entry(f"safedpa, {largest} robots, one at a time", singly[largest], f"{largest} robots", note),)
    targets = (Target(f"a robot of {largest}", 20.0, ours[0].figures["p50"], "us"),)
    series: dict[str, tuple[float | None, ...]] = {
        "safedpa, one at a time": tuple(found["wall"]["p50"] for found in singly.values())
    }
    curve = Curve("batch", "robots", "a robot, p50 [us]", tuple(map(float, sizes)), series)
    work = f"{largest} robots through adaptation, policy and filter (networks) in one process, a robot-tick"
    return Row("batch", work, "p50", ours, targets=targets, curves=(curve,))


def _entry(name: str, found: dict[str, Any], problem: str, note: str) -> Entry:
    return Entry(name, found["wall"], "us", found["processor"], problem, note)


def _per_robot(chain: Chain, count: int, turns: int) -> dict[str, Any]:
    """Microseconds a robot of each turn: percentiles over turns."""
    robots = _robots(count)
    wall: list[float] = []
    processor: list[float] = []
    for turn in range(_WARM + turns):
        states = [robot.state_message() for robot in robots]
        used, began = time.process_time(), time.perf_counter()
        actions = chain(states)
        elapsed, spent = time.perf_counter() - began, time.process_time() - used
        for robot, action in zip(robots, actions, strict=True):
            robot.receive(action)
            robot.advance()
        if turn >= _WARM:
            wall.append(1e6 * elapsed / count)
            processor.append(1e6 * spent / count)
    return {"wall": percentiles(wall), "processor": percentiles(processor)}


def _robots(count: int) -> list[Any]:
    from safedpa_sim.robots.core import CarRobot
    from safedpa_sim.robots.scene import Scene

    return [CarRobot(Scene.random(index, _LOADS[index % len(_LOADS)])) for index in range(count)]


@final
class _OneByOne:
    """The three nodes as their services run them, each robot's step after the other's."""

    def __init__(self, name: str) -> None:
        model = load_model(name)
        self._nodes = (AdaptationNode(model), PolicyNode(model), SafetyFilterNode(model, settings_named("car")))
        self._known: set[str] = set()

    def __call__(self, states: list[Any]) -> list[Any]:
        return [self._step(f"car{index}", state) for index, state in enumerate(states)]

    def _step(self, robot: str, state: Any) -> Any:
        adaptation, policy, safety = self._nodes
        if robot not in self._known:
            self._known.add(robot)
            for node in self._nodes:
                node.welcome(robot, None)
        inputs: dict[Any, Any] = {LATENT: adaptation.step(robot, state, {})[LATENT]}
        safety.prepare(robot, state)
        inputs[WISH] = policy.step(robot, state, inputs)[WISH]
        action = safety.step(robot, state, inputs)[ACTION]
        for node in self._nodes:
            node.afterwards(robot)
        return action
