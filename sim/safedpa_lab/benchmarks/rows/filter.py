"""One decision of the safety filter, beside programs that solve the same quadratic program."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from safedpa.dynamics import PhysicsModel, load_model
from safedpa.effects import effect
from safedpa.safety import SafetyFilter
from safedpa_lab.benchmarks.filter_problem import FilterProblem, problem_with, wedged
from safedpa_lab.benchmarks.peer_process import ask_peer
from safedpa_lab.benchmarks.results import Curve, Effort, Entry, Row, Target, microseconds, missing
from safedpa_lab.benchmarks.timing import timed

__all__ = ["measure"]

MODELS: Final = {"car_learned": "networks f and g", "car": "physics"}
_LACKS = "no networks, no prediction beyond the tangent, no verdict, no margin"
_PEERS: Final = (
    ("cbfpy, elastiqp", "cbfpy", "elastiqp", "filter_cbfpy", "compiled by jax; never reads whether it converged"),
    ("cbfpy, qpax", "cbfpy", "qpax", "filter_cbfpy", "its default; compiled by jax; never reads whether it converged"),
    ("run-time-assurance", "run_time_assurance", "", "filter_rta", "ASIF; all actions weigh alike; no slack"),
    ("cvxpy, OSQP", "cvxpy", "OSQP", "filter_cvxpy", "stated once, parameters set anew"),
    ("cvxpy, Clarabel", "cvxpy", "CLARABEL", "filter_cvxpy", "stated once, parameters set anew"),
    ("IPOPT (casadi)", "casadi", "", "filter_casadi", "as the authors had it: nearest obstacle, built anew every step"),
)
"""Name, package, its option, script and what it does or does not do."""
_CBFKIT = "no release in the package index; 715 us (p50) and 1100 us (p99) where it was measured from its sources"
_EVERY: Final = "8, all ticks"
_QUICK = ("cbfpy, elastiqp", "cvxpy, Clarabel", "IPOPT (casadi)")
"""Peers that are asked in a quick run: the others take half a minute to compile."""
_EFFECTS = ("quadratic_drag", "rolling_resistance", "steering_offset", "understeer", "viscous_drag", "turning_drag")


def measure(effort: Effort) -> Row:
    """Decisions that need the quadratic program, with 1, 8 and 32 obstacles, and with 8 those of every tick."""
    counts = effort.of((8,), (1, 8, 32))
    problems = {count: problem_with(count) for count in counts}
    calls, seconds = effort.of((300, 0.3), (20_000, 4.0))
    ours = [entry for count in counts for entry in _ours(problems[count], calls, seconds)]
    peers = _peers(problems, effort)
    learned = next(entry for entry in ours if entry.problem == "8 obstacles")
    targets = (
        Target("p50 with networks, 8 obstacles", 50.0, learned.figures["p50"], "us"),
        Target("p99 with networks, 8 obstacles", 100.0, learned.figures["p99"], "us"),
    )
    hopeless = {entry.name: entry.more["wedged"] for entry in peers if entry.more.get("wedged")}
    notes: tuple[str, ...] = (f"a car wedged in, where no action keeps every condition: this filter {_hopeless()}",)
    notes += tuple(f"there {name} {words}" for name, words in hopeless.items())
    curves = (_over_obstacles(problems, peers, effort), _over_effects(problems[8], effort))
    work = "one decision of the safety filter that has to change the wish: model, barriers, QP, verdict"
    return Row("filter", work, "p50", tuple(ours), tuple(peers), targets, curves, notes=notes)


def _ours(problem: FilterProblem, calls: int, seconds: float) -> list[Entry]:
    count = len(problem.obstacles)
    named = _named(count)
    found = []
    for model, what in MODELS.items():
        times = _decisions(problem, load_model(model), calls, seconds)
        found.append(microseconds(f"safedpa, {what}", times, named))
    if count == 8:
        for model, what in MODELS.items():
            times = _decisions(problem, load_model(model), calls, seconds, every=True)
            found.append(microseconds(f"safedpa, {what}", times, _EVERY, "all ticks: also those that need no program"))
    return found


def _named(count: int) -> str:
    return f"{count} obstacles" if count > 1 else "1 obstacle"


def _decisions(
    problem: FilterProblem, model: PhysicsModel, calls: int, seconds: float, *, every: bool = False
) -> dict[str, Any]:
    one, barriers = SafetyFilter.for_model(model, problem.settings), problem.barriers()
    return timed(
        lambda asked: one.decide(asked[0], asked[1], asked[2], barriers=barriers),
        problem.requests(model, every=every),
        calls,
        seconds,
    )


def _hopeless() -> str:
    """What the filter says where no action keeps every condition."""
    model, problem = load_model("car"), wedged()
    one = SafetyFilter.for_model(model, problem.settings, problem.barriers())
    verdict = one.decide(*problem.requests(model)[0])
    shown = ", ".join(f"{value:.3g}" for value in verdict.action)
    return f"returns ({shown}), status {verdict.status.value}, slack {verdict.slack:.3f} m"


def _peers(problems: Mapping[int, FilterProblem], effort: Effort) -> list[Entry]:
    found: list[Entry] = []
    for name, package, backend, script, note in _PEERS:
        told = f"{note}; {_LACKS}"
        calls, seconds = effort.of((100, 0.2), (20_000, 2.0))
        asked = [problem.question(calls, seconds, backend) for problem in problems.values()]
        question = {"problems": [*asked, wedged().question(0, 0.0, backend)]}
        left_out = effort.quick and name not in _QUICK
        reply: dict[str, Any] = (
            {"missing": "left out of a quick run"}
            if left_out
            else ask_peer(script, package, question, effort.interpreters)
        )
        if "missing" in reply:
            found += [missing(name, reply["missing"], _named(count), told) for count in problems]
            continue
        answers, words = reply["answers"][:-1], reply["answers"][-1]["says"]
        for (count, problem), answer in zip(problems.items(), answers, strict=True):
            more = {
                "version": answer["version"],
                "wedged": words,
                "mean_change_from_ours": _difference(problem, answer["actions"]),
            }
            found.append(microseconds(name, answer, _named(count), told, **more))
    return [*found, missing("CBFKit", _CBFKIT, "8 obstacles")]


def _difference(problem: FilterProblem, actions: list[list[float]]) -> float:
    """Mean over states of the largest difference to this filter's action, as a share of the action's range."""
    model = load_model("car")
    one = SafetyFilter.for_model(model, problem.settings, problem.barriers())
    own = np.array([one.decide(*asked).action for asked in problem.requests(model)])
    reach = np.subtract(problem.settings.action_high, problem.settings.action_low)
    return round(float((np.abs(own - np.array(actions)) / reach).max(axis=1).mean()), 4)


def _over_obstacles(problems: Mapping[int, FilterProblem], peers: list[Entry], effort: Effort) -> Curve:
    counts = effort.of((1, 8), (1, 2, 4, 8, 16, 32, 64))
    calls, seconds = effort.of((100, 0.2), (3000, 1.0))
    series: dict[str, tuple[float | None, ...]] = {}
    scenes = [problems.get(count) or problem_with(count) for count in counts]
    for model, what in MODELS.items():
        times = [_decisions(scene, load_model(model), calls, seconds)["wall"]["p50"] for scene in scenes]
        series[f"safedpa, {what}"] = tuple(times)
    for name in dict.fromkeys(entry.name for entry in peers if entry.figures):
        known = {entry.problem: entry.figures["p50"] for entry in peers if entry.name == name and entry.figures}
        series[name] = tuple(known.get(_named(count)) for count in counts)
    return Curve("filter_obstacles", "obstacles", "one decision, p50 [us]", tuple(counts), series)


def _over_effects(problem: FilterProblem, effort: Effort) -> Curve:
    """The physics model with more and more of the library's effects in it."""
    model, times = load_model("car"), []
    calls, seconds = effort.of((100, 0.2), (3000, 1.0))
    names = _EFFECTS[: effort.of(1, len(_EFFECTS))]
    for name in ("", *names):
        model = model.with_effect(effect("car", name), {}) if name else model
        times.append(_decisions(problem, model, calls, seconds)["wall"]["p50"])
    x = tuple(float(1 + number) for number in range(len(times)))
    series: dict[str, tuple[float | None, ...]] = {"safedpa, physics with effects": tuple(times)}
    return Curve("filter_effects", "effects in the model", "one decision, p50 [us]", x, series)
