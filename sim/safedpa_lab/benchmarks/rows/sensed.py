"""One decision among what a laser sees, next to eight circles and the program alone; and the chain from scan to action.

All of them in turn within one run, so that what else the machine does is shared by all.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from safedpa.adaptation import AdaptationNode
from safedpa.arrays import FloatArray
from safedpa.bus import (
    ACTION,
    LATENT,
    NOMINAL,
    SURROUNDINGS,
    ActionMessage,
    ScanMessage,
    StateMessage,
    SurroundingsMessage,
    decode,
    encode,
)
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.native.library import why_not_compiled
from safedpa.perception import PerceptionNode
from safedpa.policy import PolicyNode
from safedpa.robots.car.scenes.perceived import CarScene
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety import SafetyFilter, Status
from safedpa.safety.defaults import margin_for, settings_named
from safedpa_lab.benchmarks.filter_problem import car_message, first_program, problem_with
from safedpa_lab.benchmarks.results import Effort, Entry, Row, Target, microseconds
from safedpa_lab.benchmarks.timing import in_turn, percentiles
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.sensing import Laser, LaserSettings
from safedpa_sim.sensing.people import walkers
from safedpa_sim.sensing.sensor_inputs import SimulatedSensors

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


_COUNTS: Final = (64, 256, 1080)
_HALF: Final = 4.0
"""m; half an edge of the room."""
_PILLARS: Final = ((1.5, 1.2, 0.3), (-1.4, 1.6, 0.25), (-1.2, -1.5, 0.35), (1.8, -1.6, 0.2))
_RADIUS: Final = 0.05
"""m of a point."""
_NOMINAL: Final = (1.6, 0.1)
_STATES: Final = 48
_FOOTPRINT: Final = (0.08, 0.4, 0.12)


def measure(effort: Effort) -> Row:
    """Decisions that need the program, from the message to the verdict, with 64, 256 and 1,080 points."""
    counts = effort.of((64, 256), _COUNTS)
    calls, seconds = effort.of((100, 1.0), (4000, 30.0))
    asked: dict[str, tuple[Callable[[Any], Any], Sequence[Any]]] = {
        f"{count} points": sensed(count) for count in counts
    }
    asked["8 circles"] = _reported()
    asked["the program alone, 256 points"] = _alone(256)
    times = in_turn(asked, calls, seconds)
    built = "decided by Python" if why_not_compiled() else "compiled decisions"
    ours = [microseconds("safedpa, physics", found, name, built) for name, found in times.items()]
    chains = {
        rays: tuple(map(percentiles, chain_times(rays, effort.of(60, 400)))) for rays in effort.of((360,), (360, 1080))
    }
    note = "the nodes of one robot in turn"
    ours += [
        Entry("safedpa, scan to action", wall, "us", processor, problem=f"{rays} rays", note=note)
        for rays, (wall, processor) in chains.items()
    ]
    targets = (
        Target("p50 with 256 points", 60.0, times["256 points"]["wall"]["p50"], "us"),
        *(
            Target(f"p99 from scan to action, {rays} rays", 6000.0, found[0]["p99"], "us")
            for rays, found in chains.items()
        ),
    )
    work = "one decision among what a laser sees: message to barriers, model, QP, verdict"
    return Row("sensed", work, "p50", tuple(ours), targets=targets)


def places_seen(count: int) -> FloatArray:
    """(count, 2) m; evenly over four walls and four pillars around a car in their middle."""
    edge = 8.0 * _HALF
    begins = np.cumsum([edge, *(2.0 * np.pi * radius for _, _, radius in _PILLARS)])
    found = []
    for way in (np.arange(count) + 0.5) * begins[-1] / count:
        which = int(np.searchsorted(begins, way))
        if which > 0:
            x, y, radius = _PILLARS[which - 1]
            turn = (way - begins[which - 1]) / radius
            found.append((x + radius * np.cos(turn), y + radius * np.sin(turn)))
        else:
            side, along = divmod(way, 2.0 * _HALF)
            cosine, sine = np.cos(side * np.pi / 2.0), np.sin(side * np.pi / 2.0)
            found.append((cosine * (along - _HALF) + sine * _HALF, sine * (along - _HALF) - cosine * _HALF))
    return np.array(found)


def sensed(count: int) -> tuple[Callable[[Any], Any], list[tuple[StateMessage, SurroundingsMessage]]]:
    """What decides, and states in which it has to solve its program, with the ``count`` points that are seen there."""
    places = places_seen(count)
    model, settings = load_model("car"), settings_named("car")
    one, scene = SafetyFilter.for_model(model, settings), CarScene(settings)
    epsilon = _margins(model)
    points = tuple((x, y, _RADIUS) for x, y in places.tolist())

    def decided(asked: tuple[StateMessage, SurroundingsMessage]) -> Any:
        state, seen = asked
        barriers = scene.around(state, seen, epsilon)
        assert not isinstance(barriers, str), barriers
        return one.decide(state.values, _NOMINAL, model.latent, barriers=barriers, epsilon=epsilon)

    draw, found = np.random.default_rng([7, 256]), list[tuple[StateMessage, SurroundingsMessage]]()
    while len(found) < _STATES:
        values = (
            *draw.uniform(-3.0, 3.0, 2).tolist(),
            float(draw.uniform(-np.pi, np.pi)),
            float(draw.uniform(0.2, 1.5)),
        )
        state = replace(car_message(len(found), np.zeros((0, 3)), values), sources=("laser",))
        seen = _message(state, points)
        verdict = decided((state, seen))
        if verdict.status is Status.corrected and verdict.solver == "solved":
            found.append((state, seen))
    return decided, found


def _margins(model: PhysicsModel) -> dict[str, float]:
    """By kind of barrier, of those that the model was calibrated for."""
    known = margin_for(model)
    return {} if known is None else dict(known.epsilon)


def _message(state: StateMessage, points: tuple[tuple[float, ...], ...]) -> SurroundingsMessage:
    return SurroundingsMessage(
        epoch=state.epoch,
        tick=state.tick,
        robot_time=state.robot_time,
        publish_time=state.publish_time,
        points=points,
        movers=(),
        hidden=(),
        ages=(0.05,),
    )


def _reported() -> tuple[Callable[[Any], Any], list[StateMessage]]:
    """The same of a car that is given eight circles and a field."""
    model, problem = load_model("car"), problem_with(8)
    one, scene = SafetyFilter.for_model(model, problem.settings), CarScene(problem.settings)
    epsilon = _margins(model)

    def decided(state: StateMessage) -> Any:
        barriers = scene.of(state)
        assert not isinstance(barriers, str), barriers
        return one.decide(state.values, _NOMINAL, model.latent, barriers=barriers, epsilon=epsilon)

    states = enumerate(problem.states.tolist())
    return decided, [car_message(tick, problem.obstacles, tuple(values)) for tick, values in states]


def _alone(count: int) -> tuple[Callable[[Any], Any], list[tuple[Any, Any]]]:
    """The first quadratic program of each of the same decisions."""
    model, settings = load_model("car"), settings_named("car")
    one, scene = SafetyFilter.for_model(model, settings), CarScene(settings)
    solve, posed = one.tools.program.solve, []
    latent, margins = tuple(model.latent.tolist()), _margins(model)
    for state, seen in sensed(count)[1]:
        barriers = scene.around(state, seen, margins)
        assert not isinstance(barriers, str), barriers
        posed.append(first_program(one, barriers, state.values, _NOMINAL, latent, margins))
    return lambda rows: solve(rows[0], rows[1], _NOMINAL), posed
