"""A decision of the filter, and what no decision can do without: the networks, and the quadratic program."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from safedpa.dynamics import LearnedBase, PhysicsModel, load_model
from safedpa.safety import SafetyFilter, Status
from safedpa.safety.decision import Decision, FilterInput
from safedpa.safety.solver.constraints import Constraints
from safedpa_lab.benchmarks.filter_problem import FilterProblem
from safedpa_lab.benchmarks.timing import timed

__all__ = [
    "BOTH",
    "FLOORS",
    "MODELS",
    "NETWORKS",
    "PROGRAM",
    "decided",
    "decisions",
    "each_part_once",
    "first_program",
    "networks_alone",
    "once",
    "program_alone",
    "with_floors",
]

MODELS: Final = {"car_learned": "networks f and g", "car": "physics"}
NETWORKS: Final = "the networks alone"
PROGRAM: Final = "the program alone"
BOTH: Final = "the networks and the program"
FLOORS: Final = (NETWORKS, PROGRAM, BOTH)
"""Parts that no decision with networks can do without; with physics, the program."""


def once(what: str) -> str:
    """The name of ``each_part_once`` with one of ``MODELS``."""
    return f"each part of a decision once, {what}"


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
    asked |= {once(what): each_part_once(problem, load_model(name)) for name, what in MODELS.items()}
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


def each_part_once(problem: FilterProblem, model: PhysicsModel) -> Asked:
    """Inputs, conditions, nominal action, slopes, one program, what its action comes to, verdict: without a search, a
    check of other actions or a way back towards the nominal action, so that many of these actions are not the best, nor
    all of them safe.
    """
    one, barriers = SafetyFilter.for_model(model, problem.settings), problem.barriers()
    tools = one.tools

    def through(request: FilterInput) -> Any:
        decision = Decision(tools, request)
        conditions, nominal = decision._build_constraints(), tuple(request.nominal)
        about = conditions.evaluate(nominal)
        A, b = conditions.linearize(about).at(about.residual, nominal, 0.0)
        came = conditions.evaluate(tuple(tools.program.solve(A, b, nominal).action))
        return decision._verdict(Status.corrected, came, "", "solved")

    return through, [FilterInput(*asked, None, barriers, {}, ()) for asked in problem.requests(model)]


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
