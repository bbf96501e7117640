"""The scenes in which decisions are timed, the same for everyone; a decision, and what no decision can do without.

The states are those where the filter has to change the nominal action; the floors are the networks and the program.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import cos, sin
from typing import Any, Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.bus import StateMessage
from safedpa.dynamics import LearnedBase, PhysicsModel, load_model
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.robots.car.scenes.perceived import CarScene
from safedpa.runtime.scene import MOST_OBSTACLES
from safedpa.safety import FilterSettings, SafetyFilter, Status
from safedpa.safety.barriers.base import CachingBarrierSet
from safedpa.safety.barriers.stack import make_barrier_set
from safedpa.safety.defaults import settings_named
from safedpa.safety.solver.constraints import Constraints
from safedpa_lab.benchmarks.timing import timed

_FOOTPRINT: Final = (0.08, 0.4, 0.12)
"""m; about the pymunk car's."""
_FIELD: Final = (-20.0, 20.0, -20.0, 20.0)
_STATES: Final = 64
_TICKS: Final = 30
"""Of each drive."""
_NOMINAL: Final = (2.0, 0.0)
"""Straight on at full speed."""
_PENALTY: Final = 1e4
"""Price of a metre of slack, for peers that have slack."""
_EPSILON: Final = 0.01
"""m; margin of every obstacle in the comparison."""


@final
@dataclass(frozen=True, eq=False)
class FilterProblem:
    """One scene, states that the shipped physics and the shipped networks both have to correct, and the settings."""

    obstacles: FloatArray
    """(m, 3) x, y, radius [m]."""
    states: FloatArray
    """(n, 4)."""
    settings: FilterSettings
    passed_by: FloatArray
    """(n, 4): all states of the same drives, as they came."""

    def barriers(self) -> Any:
        """As the service builds them for a scene: obstacles, four walls far away, two limits of speed.

        A robot may tell the service no more than ``MOST_OBSTACLES``; of more they are built without its scene.
        """
        if len(self.obstacles) > MOST_OBSTACLES:
            reported = self.obstacles.tolist()
            return CachingBarrierSet(make_barrier_set(car_barriers(self.settings, _FOOTPRINT, reported, _FIELD, None)))
        found = CarScene(self.settings).of(car_message(0, self.obstacles, (0.0, 0.0, 0.0, 0.0)))
        assert not isinstance(found, str), found
        return found

    def requests(self, model: PhysicsModel, *, every: bool = False) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
        """State, nominal action and latent of each decision; of ``every`` state of the drives, or of those with a
        program."""
        return [(state, np.array(_NOMINAL), model.latent) for state in (self.passed_by if every else self.states)]

    def question(self, calls: int, seconds: float, backend: str) -> dict[str, Any]:
        """What a peer is given."""
        settings = self.settings
        return {
            "obstacles": self.obstacles.tolist(),
            "states": self.states.tolist(),
            "nominal_actions": [list(_NOMINAL)] * len(self.states),
            "footprint": list(_FOOTPRINT),
            "clearance": settings.barrier("clearance"),
            "braking": [settings.barrier("braking_deceleration"), settings.barrier("braking_gain")],
            "wheelbase": 0.32,
            "speed_gain": 5.0,
            "low": list(settings.action_low),
            "high": list(settings.action_high),
            "weights": settings.weight_vector.tolist(),
            "eta": settings.eta,
            "epsilon": _EPSILON,
            "period": 0.05,
            "penalty": _PENALTY,
            "calls": calls,
            "seconds": seconds,
            "backend": backend,
        }


def car_message(
    tick: int, obstacles: FloatArray, state: tuple[float, ...], goal: tuple[float, float] = (3.0, 0.0)
) -> Any:
    """What a car says of itself in a scene."""
    return StateMessage(
        epoch=1,
        tick=tick,
        robot_time=0.05 * tick,
        publish_time=0.05 * tick,
        values=state,
        applied=(0.5, 0.0),
        applied_by="filter",
        period=0.05,
        lockstep=False,
        goal=goal,
        obstacles=tuple(tuple(row) for row in obstacles.tolist()),
        field=_FIELD,
        footprint=_FOOTPRINT,
    )


def problem_with(count: int) -> FilterProblem:
    """The scene of ``count`` obstacles: one stands in the way, the others further off all around; always the same.

    Cars drive at it from all sides, requesting full speed ahead, under the filter with the networks. Kept are states
    of these drives in which the filter has to solve its program, with the networks and with the physics.
    """
    random = np.random.default_rng([5, count])
    bearing = random.uniform(-np.pi, np.pi, count)
    away = random.uniform(4.0, 6.0, count)
    obstacles = np.stack([away * np.cos(bearing), away * np.sin(bearing), random.uniform(0.2, 0.35, count)], axis=1)
    obstacles[0] = (0.0, 0.0, 0.3)
    settings = settings_named("car")
    models = [load_model(name) for name in ("car_learned", "car")]
    filters = [SafetyFilter.for_model(model, settings) for model in models]
    nowhere = np.zeros((0, 4))
    problem = FilterProblem(obstacles, nowhere, settings, nowhere)
    barriers, nominal = problem.barriers(), np.array(_NOMINAL)
    retained: list[FloatArray] = []
    every: list[FloatArray] = []
    state, tick = _towards(obstacles[0], random), 0
    while len(retained) < _STATES:
        verdicts = [
            one.decide(state, nominal, model.latent, barriers=barriers)
            for one, model in zip(filters, models, strict=True)
        ]
        every.append(state)
        if all(verdict.status is Status.corrected and verdict.solver == "solved" for verdict in verdicts):
            retained.append(state)
        moved, _ = models[0].advance(state, verdicts[0].action, models[0].initial_memory(nominal), models[0].latent)
        tick += 1
        state = np.asarray(moved, dtype=np.float64)
        if tick == _TICKS:
            state, tick = _towards(obstacles[0], random), 0
    return FilterProblem(obstacles, np.array(retained), settings, np.array(every))


def wedged() -> FilterProblem:
    """A standing car between two obstacles that both reach into it: no action satisfies both conditions."""
    rear, front, _ = _FOOTPRINT
    obstacles = np.array([(front + 0.2, 0.0, 0.3), (-rear - 0.2, 0.0, 0.3)])
    return FilterProblem(obstacles, np.zeros((1, 4)), settings_named("car"), np.zeros((1, 4)))


def _towards(obstacle: FloatArray, random: np.random.Generator) -> FloatArray:
    """A state (4,) far enough before an obstacle that nothing has to be done yet, driving at it."""
    heading, aside = random.uniform(-np.pi, np.pi), random.uniform(-0.3, 0.3)
    distance, speed = random.uniform(1.8, 2.6), random.uniform(0.3, 1.5)
    x = obstacle[0] - distance * cos(heading) - aside * sin(heading)
    y = obstacle[1] - distance * sin(heading) + aside * cos(heading)
    return np.array([x, y, heading, speed])


MODELS: Final = {"car_learned": "networks f and g", "car": "physics"}
NETWORKS: Final = "the networks alone"
PROGRAM: Final = "the program alone"
BOTH: Final = "the networks and the program"
FLOORS: Final = (NETWORKS, PROGRAM, BOTH)
"""Parts that no decision with networks can do without; with physics, the program."""


Asked = tuple[Callable[[Any], Any], Sequence[Any]]
"""A call and its inputs."""


def decided(problem: FilterProblem, model: PhysicsModel, *, every: bool = False) -> Asked:
    """What decides, and about what: states with a program, or ``every`` state of the same drives."""
    one, barriers = SafetyFilter.for_model(model, problem.settings), problem.barriers()
    decide: Callable[[Any], Any] = lambda asked: one.decide(asked[0], asked[1], asked[2], barriers=barriers)  # noqa: E731
    return decide, problem.requests(model, every=every)


def decisions(
    problem: FilterProblem, model: PhysicsModel, calls: int, seconds: float, *, every: bool = False
) -> dict[str, Any]:
    """Microseconds of ``decided``, as ``timed`` reports them."""
    decide, requests = decided(problem, model, every=every)
    return timed(decide, requests, calls, seconds)


def with_floors(problem: FilterProblem, calls: int, seconds: float) -> dict[str, dict[str, Any]]:
    """Decisions of both models, and the ``FLOORS``; each by its name, and each alone, as the peers are timed."""
    model = load_model("car_learned")
    asked = {what: decided(problem, load_model(name)) for name, what in MODELS.items()}
    (networks, known), (solve, posed) = networks_alone(problem, model), program_alone(problem, model)
    asked |= {NETWORKS: (networks, known), PROGRAM: (solve, posed)}
    asked[BOTH] = (lambda pair: (networks(pair[0]), solve(pair[1])), list(zip(known, posed, strict=True)))
    return {name: timed(call, inputs, calls, seconds) for name, (call, inputs) in asked.items()}


def networks_alone(problem: FilterProblem, model: PhysicsModel) -> Asked:
    """f (states,) and g (states, actions) of one state and latent as the filter asks for them: once a decision."""
    base = model.base
    assert isinstance(base, LearnedBase)
    networks = base.networks  # behind ``known_at``, which would return what it gave the decision before
    states = [(tuple(state.tolist()), tuple(latent.tolist())) for state, _, latent in problem.requests(model)]
    return lambda known: networks.row_of_one(known[0], known[1]), states


def program_alone(problem: FilterProblem, model: PhysicsModel) -> Asked:
    """The first program of each of the decisions: the closed form where there is one, else PIQP."""
    one, barriers = SafetyFilter.for_model(model, problem.settings), problem.barriers()
    solve, posed = one.tools.program.solve, []
    for state, nominal, latent in problem.requests(model):
        plain = tuple(nominal.tolist())
        A, b = first_program(one, barriers, tuple(state.tolist()), plain, tuple(latent.tolist()), {})
        posed.append((A, b, plain))
    return lambda rows: solve(rows[0], rows[1], rows[2]), posed


def first_program(
    one: SafetyFilter,
    barriers: Any,
    state: tuple[float, ...],
    nominal: tuple[float, ...],
    latent: tuple[float, ...],
    epsilon: Mapping[str, float],
) -> tuple[list[list[float]], list[float]]:
    """A (rows, actions) and b (rows,) of A a >= b: the conditions tangent about the nominal action, as a decision poses
    them."""
    tools = one.tools
    stack = tools.barrier_sets.get(barriers, len(state))
    margins, _ = tools.margins.resolve(stack, dict(epsilon))
    sides = tools.program.sides
    conditions = Constraints(stack, tools.prediction, state, latent, None, tools.settings.eta, margins, sides)
    about = conditions.evaluate(nominal)
    return conditions.linearize(about).at(about.residual, nominal, 0.0)
