"""Where the time of a decision goes: inputs, model, barriers, program, search and verdict, each by itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from safedpa.dynamics import LearnedBase, PhysicsModel, load_model
from safedpa.safety import SafetyFilter, Status
from safedpa.safety.decision import Decision, FilterInput
from safedpa.safety.solver.sqp import backtrack_towards, solve_sqp
from safedpa_lab.benchmarks.filter_problem import MODELS, Asked, FilterProblem, decided, networks_alone, problem_with
from safedpa_lab.benchmarks.results import Effort, Row, microseconds
from safedpa_lab.benchmarks.timing import in_turn

WHOLE: Final = "the whole decision"


def measure(effort: Effort) -> Row:
    """Decisions with 8 obstacles that need the program, and their parts; of either model, all parts in turn."""
    calls, seconds = effort.of((100, 0.3), (4000, 20.0))
    problem = problem_with(8)
    found = []
    for name, what in MODELS.items():
        for part, times in in_turn(parts(problem, load_model(name)), calls, seconds).items():
            found.append(microseconds(part, times, what))
    notes = (
        "an outcome: model and barriers at one action, and what its conditions miss; a decision needs six on average",
        "the conditions linearised: slopes of model and barriers, and rows of the program; the program is posed twice",
        "the search: program, outcomes and slopes until all conditions are satisfied; then back to the nominal action",
        "parts are asked one by one from Python, whose calls they pay: their sum is more than the whole",
    )
    return Row(
        "decision-parts", "where the time of one decision with 8 obstacles goes", "p50", tuple(found), notes=notes
    )


def parts(problem: FilterProblem, model: PhysicsModel) -> dict[str, Asked]:
    """The parts by name, each with what it is asked about: state by state, so that nothing is remembered."""
    one, barriers = SafetyFilter.for_model(model, problem.settings), problem.barriers()
    tools, rounds = one.tools, problem.settings.relinearisations + 1
    nominal = tuple(problem.requests(model)[0][1].tolist())
    requests = [FilterInput(*asked, None, barriers, {}, ()) for asked in problem.requests(model)]
    decisions = [Decision(tools, request) for request in requests]
    posed = [decision._build_constraints() for decision in decisions]
    about = [(conditions, conditions.evaluate(nominal)) for conditions in posed]
    rows = [conditions.linearize(one).at(one.residual, nominal, 0.0) for conditions, one in about]
    found = [solve_sqp(conditions, tools.program, nominal, one, rounds)[0] for conditions, one in about]
    asked: dict[str, tuple[Callable[[Any], Any], Any]] = {
        WHOLE: decided(problem, model),
        "inputs": (lambda request: Decision(tools, request), requests),
        "the conditions at the state": (lambda decision: decision._build_constraints(), decisions),
        "an outcome": (lambda conditions: conditions.evaluate(nominal), posed),
        "the conditions linearised": (
            lambda pair: pair[0].linearize(pair[1]).at(pair[1].residual, nominal, 0.0),
            about,
        ),
        "the program": (lambda pair: tools.program.solve(pair[0], pair[1], nominal), rows),
        "the search": (lambda pair: solve_sqp(pair[0], tools.program, nominal, pair[1], rounds), about),
        "back towards the nominal action": (
            lambda pair: backtrack_towards(pair[0], tools.program.sides, nominal, pair[1]),
            list(zip(posed, found, strict=True)),
        ),
        "the verdict": (
            lambda pair: pair[0]._verdict(Status.corrected, pair[1], "", "solved"),
            list(zip(decisions, found, strict=True)),
        ),
    }
    if isinstance(model.base, LearnedBase):
        asked["the networks, within the conditions"] = networks_alone(problem, model)
    return asked
