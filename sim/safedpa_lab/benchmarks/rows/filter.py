"""One decision of the safety filter, next to programs that solve the same quadratic program, and how its cost grows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from safedpa.dynamics import load_model
from safedpa.effects import effect
from safedpa.safety import SafetyFilter
from safedpa_lab.benchmarks.filter_problem import (
    FLOORS,
    MODELS,
    NETWORKS,
    FilterProblem,
    decisions,
    problem_with,
    wedged,
    with_floors,
)
from safedpa_lab.benchmarks.peer_process import ask_peer
from safedpa_lab.benchmarks.python_source import without_compiler
from safedpa_lab.benchmarks.results import Curve, Effort, Entry, Floor, Row, Target, microseconds, missing

_COUNTS: Final = (1, 4, 16, 64, 256, 1024)
_PATIENCE_SECONDS: Final = 60.0
"""Of a peer on one scene: compiling, a few decisions, and the answer."""
_EFFECTS: Final = (
    "quadratic_drag",
    "rolling_resistance",
    "steering_offset",
    "understeer",
    "viscous_drag",
    "turning_drag",
)
Peer = tuple[str, str, str, str]
"""Name, package, its option, and script."""
Times = tuple[float | None, ...]


def over_obstacles(peers: Sequence[Peer], effort: Effort) -> Curve:
    """p50 of a decision with 1 to 1,024 obstacles, of this project and of ``peers``; None where a peer does not answer.

    A peer that gives no answer in time is not asked about more obstacles.
    """
    counts = effort.of((1, 8), _COUNTS)
    calls, seconds = effort.of((100, 0.2), (2000, 1.0))
    scenes = [problem_with(count) for count in counts]
    series: dict[str, Times] = {}
    for model, what in MODELS.items():
        times = [decisions(scene, load_model(model), calls, seconds)["wall"]["p50"] for scene in scenes]
        series[f"safedpa, {what}"] = tuple(times)
    for peer in peers:
        times_of_peer = _of_peer(peer, scenes, calls, seconds, effort.interpreters)
        if any(value is not None for value in times_of_peer):
            series[peer[0]] = times_of_peer
    return Curve("filter_obstacles", "obstacles", "one decision, p50 [us]", tuple(map(float, counts)), series)


def _of_peer(
    peer: Peer, scenes: Sequence[FilterProblem], calls: int, seconds: float, interpreters: Sequence[str]
) -> Times:
    _, package, backend, script = peer
    found: list[float | None] = []
    for scene in scenes:
        question = {"problems": [scene.question(calls, seconds, backend)]}
        reply = ask_peer(script, package, question, interpreters, _PATIENCE_SECONDS)
        if "missing" in reply:
            break
        found.append(float(reply["answers"][0]["wall"]["p50"]))
    return (*found, *[None] * (len(scenes) - len(found)))


def over_effects(problem: FilterProblem, effort: Effort) -> Curve:
    """The physics model with more and more of the library's effects in it."""
    model: Any = load_model("car")
    times = []
    calls, seconds = effort.of((100, 0.2), (3000, 1.0))
    names = _EFFECTS[: effort.of(1, len(_EFFECTS))]
    for name in ("", *names):
        model = model.with_effect(effect("car", name), {}) if name else model
        times.append(decisions(problem, model, calls, seconds)["wall"]["p50"])
    x = tuple(float(1 + number) for number in range(len(times)))
    series: dict[str, Times] = {"safedpa, physics with effects": tuple(times)}
    return Curve("filter_effects", "effects in the model", "one decision, p50 [us]", x, series)


_LACKS = "no networks, no prediction beyond the tangent, no verdict, no margin"
_PEERS: Final = (
    ("cbfpy, elastiqp", "cbfpy", "elastiqp", "filters:cbfpy", "compiled by jax; never reads whether it converged"),
    ("cbfpy, qpax", "cbfpy", "qpax", "filters:cbfpy", "its default; compiled by jax; never reads whether it converged"),
    (
        "run-time-assurance",
        "run_time_assurance",
        "",
        "filters:run_time_assurance",
        "ASIF; all actions weigh alike; no slack",
    ),
    ("cvxpy, OSQP", "cvxpy", "OSQP", "filters:cvxpy", "stated once, parameters set again"),
    ("cvxpy, Clarabel", "cvxpy", "CLARABEL", "filters:cvxpy", "stated once, parameters set again"),
    (
        "IPOPT (casadi)",
        "casadi",
        "",
        "filters:casadi",
        "as the authors had it: nearest obstacle, built again every step",
    ),
)
"""Name, package, its option, script and what it does or does not do."""
_CBFKIT = "no release in the package index; 715 us (p50) and 1100 us (p99) where it was measured from its sources"
_EVERY: Final = "8, all ticks"
_QUICK = ("cbfpy, elastiqp", "cvxpy, Clarabel", "IPOPT (casadi)")
"""Peers that are asked in a quick run: the others take half a minute to compile."""
_GROWING: Final = ("cbfpy, elastiqp", "cbfpy, qpax", "run-time-assurance", "cvxpy, Clarabel")
"""Peers whose cost is shown over the number of obstacles."""
_BEST: Final = "cbfpy"
_AHEAD: Final = {1: 1.5, 8: 3.0, 32: 6.0}
"""By the number of obstacles: how many times faster than the best cbfpy backend, at least."""
_PHYSICS: Final = {"p50": 8.0, "p99": 20.0}
_NOT_COMPILED: Final = {"p50": 250.0, "p99": 400.0}
_INFEASIBLE: Final = {"p50": 60.0, "p99": 150.0}
"""us of a decision at most: with physics and eight obstacles, the same without a compiler, and where no action is
feasible."""
_WITHOUT: Final = "8, no compiler"
_WEDGED: Final = "no feasible action"


def measure(effort: Effort) -> Row:
    """Decisions that need the quadratic program, with 1, 8 and 32 obstacles, and with 8 those of every tick.

    f and g alone, the program in Python alone, and both are timed as the decisions are.
    """
    counts = effort.of((8,), (1, 8, 32))
    problems = {count: problem_with(count) for count in counts}
    calls, seconds = effort.of((300, 0.3), (20_000, 4.0))
    ours = [entry for count in counts for entry in _ours(problems[count], calls, seconds)]
    infeasible = decisions(wedged(), load_model("car"), calls, seconds)
    ours += [microseconds("safedpa, physics", infeasible, _WEDGED), _without_compiler(calls, seconds)]
    peers = _peers(problems, effort)
    targets, without_target = _targets(ours, peers, counts)
    hopeless = {entry.name: entry.more["wedged"] for entry in peers if entry.more.get("wedged")}
    notes: tuple[str, ...] = (f"a car wedged in, where no action satisfies every condition: this filter {_hopeless()}",)
    notes += tuple(f"there {name} {phrase}" for name, phrase in hopeless.items())
    growing = [peer[:4] for peer in _PEERS if peer[0] in _GROWING and (not effort.quick or peer[0] in _QUICK)]
    curves = (over_obstacles(growing, effort), over_effects(problems[8], effort))
    work = "one decision of the safety filter that has to change the nominal action: model, barriers, QP, verdict"
    own, notes = tuple(ours), (*notes, *without_target)
    return Row("filter", work, "p50", own, tuple(peers), tuple(targets), curves, notes=notes)


def _ours(problem: FilterProblem, calls: int, seconds: float) -> list[Entry]:
    count = len(problem.obstacles)
    named = _named(count)
    times = with_floors(problem, calls, seconds)
    found = [microseconds(f"safedpa, {what}", times[what], named) for what in MODELS.values()]
    for model, what in MODELS.items() if count == 8 else ():
        all_ticks = decisions(problem, load_model(model), calls, seconds, every=True)
        found.append(microseconds(f"safedpa, {what}", all_ticks, _EVERY, "all ticks: also those that need no program"))
    note = "no decision can do without"
    found += [microseconds(f"safedpa, {name}", times[name], f"{named}, floor", note) for name in FLOORS]
    return found


def _without_compiler(calls: int, seconds: float) -> Entry:
    """Decisions with physics and eight obstacles by Python, in a process of its own."""
    name, found = "safedpa, physics", without_compiler(calls, seconds)
    if "missing" in found:
        return missing(name, found["missing"], _WITHOUT)
    return microseconds(name, found, _WITHOUT, "Python decides: compiling is forbidden, in a process of its own")


def _targets(ours: Sequence[Entry], peers: Sequence[Entry], counts: Sequence[int]) -> tuple[list[Target], list[str]]:
    """Shares of the best cbfpy backend's times of the same run, and why there is none where that is not there."""
    targets, notes = list[Target](), list[str]()
    for count in counts:
        named = _named(count)
        known = [entry for entry in peers if entry.name.startswith(_BEST) and entry.problem == named and entry.figures]
        if not known:
            notes.append(f"no target with {named}: it is a share of {_BEST}'s time, which is not there")
            continue
        for model, what in MODELS.items():
            entry = _of(ours, f"safedpa, {what}", named)
            floor = _of(ours, f"safedpa, {NETWORKS}", f"{named}, floor") if model == "car_learned" else None
            targets += [_share(figure, entry, known, floor, _AHEAD[count]) for figure in ("p50", "p99")]
    physics = f"safedpa, {MODELS['car']}"
    for problem, limits in (("8 obstacles", _PHYSICS), (_WITHOUT, _NOT_COMPILED), (_WEDGED, _INFEASIBLE)):
        found = _of(ours, physics, problem)
        for figure, most in limits.items() if found.figures else ():
            targets.append(Target(f"{figure} of physics, {problem}", most, found.figures[figure], "us"))
    return targets, notes


def _of(entries: Sequence[Entry], name: str, problem: str) -> Entry:
    return next(entry for entry in entries if entry.name == name and entry.problem == problem)


def _share(figure: str, entry: Entry, known: Sequence[Entry], floor: Entry | None, ahead: float) -> Target:
    """A share of what the best of ``known`` takes, next to the floor of a decision."""
    best = min(known, key=lambda peer: peer.figures[figure])
    name = entry.name.removeprefix("safedpa, ")
    what = f"{figure} of {name}, {entry.problem}, {ahead:g} times faster than {best.name}"
    wanted = round(best.figures[figure] / ahead, 2)
    part = None if floor is None else Floor(floor.name.removeprefix("safedpa, "), floor.figures[figure])
    return Target(what, wanted, entry.figures[figure], "us", floor=part)


def _named(count: int) -> str:
    return f"{count} obstacles" if count > 1 else "1 obstacle"


def _hopeless() -> str:
    """What the filter says where no action satisfies every condition."""
    model, problem = load_model("car"), wedged()
    one = SafetyFilter.for_model(model, problem.settings, problem.barriers())
    verdict = one.decide(*problem.requests(model)[0])
    shown = ", ".join(f"{value:.3g}" for value in verdict.action)
    return f"returns ({shown}), status {verdict.status.value}, slack {verdict.slack:.3f} m"


def _peers(problems: Mapping[int, FilterProblem], effort: Effort) -> list[Entry]:
    found: list[Entry] = []
    for name, package, backend, script, note in _PEERS:
        reported = f"{note}; {_LACKS}"
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
            found += [missing(name, reply["missing"], _named(count), reported) for count in problems]
            continue
        answers, phrase = reply["answers"][:-1], reply["answers"][-1]["reports"]
        for (count, problem), answer in zip(problems.items(), answers, strict=True):
            more = {
                "version": answer["version"],
                "wedged": phrase,
                "mean_change_from_ours": _difference(problem, answer["actions"]),
            }
            found.append(microseconds(name, answer, _named(count), reported, **more))
    return [*found, missing("CBFKit", _CBFKIT, "8 obstacles")]


def _difference(problem: FilterProblem, actions: list[list[float]]) -> float:
    """Mean over states of the largest difference to this filter's action, as a share of the action's range."""
    model = load_model("car")
    one = SafetyFilter.for_model(model, problem.settings, problem.barriers())
    own = np.array([one.decide(*asked).action for asked in problem.requests(model)])
    reach = np.subtract(problem.settings.action_high, problem.settings.action_low)
    return round(float((np.abs(own - np.array(actions)) / reach).max(axis=1).mean()), 4)
