"""Many robots through adaptation, policy and filter in one process."""

from __future__ import annotations

import time
from typing import Any, Final, Protocol, final

import numpy as np

from safedpa.adaptation import AdaptationNode
from safedpa.adaptation.batch_history_estimator import BatchHistoryEstimator
from safedpa.bus import ACTION, LATENT, NOMINAL, ActionMessage
from safedpa.dynamics import LearnedBase, load_model
from safedpa.policy import LearnedPolicy, PolicyNode
from safedpa.robots.car.barriers.batch import barriers_of_cars
from safedpa.robots.car.observation import FAR_AWAY, OBSTACLES, observe
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.batch.filter import BatchFilter
from safedpa.safety.defaults import settings_named
from safedpa_lab.benchmarks.results import Curve, Effort, Entry, Row, Target
from safedpa_lab.benchmarks.timing import percentiles

_MODEL: Final = "car_learned"
_LOADS: Final = ("none", "box", "chair", "large_chair")
_WARM = 10
"""Turns before the counting begins."""


class _Chain(Protocol):
    """From the states of all robots to their actions: ``gathered`` is not counted, ``run`` is."""

    def gathered(self, states: list[Any]) -> Any:
        """What ``run`` takes, of the robots' messages."""

    def run(self, gathered: Any) -> Any:
        """The actions (robots, 2)."""


def measure(effort: Effort) -> Row:
    """Simulated cars with loads in turn, driven by what comes out; only the services' work is counted."""
    sizes = effort.of((1, 8), (1, 10, 100, 1000))
    turns = effort.of(6, 20)
    singly = {size: _per_robot(_OneByOne(), size, turns) for size in sizes}
    together = {size: _per_robot(_Together(size), size, turns) for size in sizes}
    largest = sizes[-1]
    ours = (
        _entry("safedpa, all at once", together[largest], "states and surroundings as arrays, no messages"),
        _entry("safedpa, one at a time", singly[largest], "the services' nodes: state message in, action message out"),
    )
    targets = (Target(f"a robot of {largest}", 20.0, ours[0].figures["p50"], "us"),)
    series: dict[str, tuple[float | None, ...]] = {
        name: tuple(own["wall"]["p50"] for own in found.values())
        for name, found in (("all at once", together), ("one at a time", singly))
    }
    curve = Curve("batch", "robots", "a robot, p50 [us]", tuple(map(float, sizes)), series)
    times = singly[largest]["wall"]["p50"] / together[largest]["wall"]["p50"]
    notes = (f"all at once takes 1/{times:.0f} of the time; percentiles are over turns of all robots",)
    work = f"{largest} robots through adaptation, policy and filter (networks) in one process, a robot-tick"
    return Row("batch", work, "p50", ours, targets=targets, curves=(curve,), notes=notes)


def _entry(name: str, found: dict[str, Any], note: str) -> Entry:
    return Entry(name, found["wall"], "us", found["processor"], note=note)


def _per_robot(chain: _Chain, count: int, turns: int) -> dict[str, Any]:
    """Microseconds a robot of each turn: percentiles over turns."""
    robots = _robots(count)
    wall: list[float] = []
    processor: list[float] = []
    for turn in range(_WARM + turns):
        states = [robot.state_message() for robot in robots]
        gathered = chain.gathered(states)
        used, began = time.process_time(), time.perf_counter()
        actions = chain.run(gathered)
        elapsed, spent = time.perf_counter() - began, time.process_time() - used
        for robot, state, action in zip(robots, states, np.asarray(actions).tolist(), strict=True):
            robot.receive(_action(state, action))
            robot.advance()
        if turn >= _WARM:
            wall.append(1e6 * elapsed / count)
            processor.append(1e6 * spent / count)
    return {"wall": percentiles(wall), "processor": percentiles(processor)}


def _action(state: Any, values: list[float]) -> ActionMessage:
    now = state.robot_time
    return ActionMessage(
        epoch=state.epoch, tick=state.tick, robot_time=now, publish_time=state.publish_time, values=tuple(values)
    )


def _robots(count: int) -> list[Any]:
    from safedpa_sim.robots.car.robot import CarRobot
    from safedpa_sim.robots.car.scene import Scene

    return [CarRobot(Scene.random(index, _LOADS[index % len(_LOADS)])) for index in range(count)]


@final
class _OneByOne:
    """The three nodes as their services run them, each robot's step after the other's."""

    def __init__(self) -> None:
        model = load_model(_MODEL)
        self._nodes = (AdaptationNode(model), PolicyNode(model), SafetyFilterNode(model, settings_named("car")))
        self._known: set[str] = set()

    def gathered(self, states: list[Any]) -> list[Any]:
        return states

    def run(self, gathered: list[Any]) -> list[tuple[float, ...]]:
        return [self._step(f"car{index}", state).values for index, state in enumerate(gathered)]

    def _step(self, robot: str, state: Any) -> Any:
        adaptation, policy, safety = self._nodes
        if robot not in self._known:
            self._known.add(robot)
            for node in self._nodes:
                node.adopt_model(robot, None)
        inputs: dict[Any, Any] = {LATENT: adaptation.step(robot, state, {})[LATENT]}
        safety.prepare(robot, state)
        inputs[NOMINAL] = policy.step(robot, state, inputs)[NOMINAL]
        action = safety.step(robot, state, inputs)[ACTION]
        for node in self._nodes:
            node.afterwards(robot)
        return action


@final
class _Together:
    """All robots in one pass: histories, policy and filter over arrays with the robots first; no one backs off."""

    def __init__(self, count: int) -> None:
        model = load_model(_MODEL)
        assert isinstance(model.base, LearnedBase)
        self._histories = BatchHistoryEstimator(model.base.weights, count)
        self._policy = LearnedPolicy(model.base.weights)
        self._filter = BatchFilter(model, settings_named("car"))

    def gathered(self, states: list[Any]) -> tuple[Any, ...]:
        most = max(OBSTACLES, *(len(state.obstacles) for state in states))
        obstacles = np.full((len(states), most, 3), FAR_AWAY)
        for row, state in zip(obstacles, states, strict=True):
            row[: len(state.obstacles)] = state.obstacles
        goal, field, footprint, values, applied = (
            np.array([getattr(state, name) for state in states])
            for name in ("goal", "field", "footprint", "values", "applied")
        )
        return values, applied, goal, obstacles, field, footprint

    def run(self, gathered: tuple[Any, ...]) -> Any:
        state, applied, goal, obstacles, field, footprint = gathered
        self._histories.acted(applied)
        latent = self._histories.see(state)
        nominal = self._policy.act(observe(state, applied, goal, obstacles, field, footprint, latent))
        barriers = barriers_of_cars(self._filter.settings, obstacles, footprint, field)
        return self._filter.decide(state, nominal, latent, barriers=barriers).action
