"""Everything that compiled decisions are to reach, in one run of eight minutes: a row of targets.

The parts are those of other rows, shorter. Run it on an idle machine; the load average is below its table.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any, Final

from safedpa.dynamics import load_model
from safedpa.errors import SafedpaError
from safedpa_lab.benchmarks.filter_problem import MODELS, decided, problem_with, wedged
from safedpa_lab.benchmarks.fleet import FleetTrial, fleet_benchmark
from safedpa_lab.benchmarks.latency import latency_benchmark
from safedpa_lab.benchmarks.peer_process import ask_peer
from safedpa_lab.benchmarks.python_source import without_compiler
from safedpa_lab.benchmarks.results import Effort, Entry, Row, Target, microseconds, missing
from safedpa_lab.benchmarks.rows.own_models import made_cold
from safedpa_lab.benchmarks.rows.sensed import chain_times, sensed
from safedpa_lab.benchmarks.timing import in_turn, percentiles
from safedpa_lab.benchmarks.users_models import ROBOTS

_AHEAD: Final = {1: 1.5, 8: 3.0, 32: 6.0}
"""How many times faster than cbfpy with elastiqp, by the number of obstacles."""
_FIGURES: Final = ("p50", "p99")
_WITHOUT: Final = "physics, 8 obstacles, no compiler"
_MOST: Final = {
    "physics, 8 obstacles": (8.0, 20.0),
    _WITHOUT: (250.0, 400.0),
    "physics, no feasible action": (60.0, 150.0),
}
"""us of a decision at p50 and p99."""
_SEED: Final = 4811
_STACK: Final = 100
"""Robots of which the processor time of the services is taken."""
_ROBOTS: Final = 300
_FIRST: Final = """
import json, time
from safedpa.dynamics import load_model
from safedpa.safety import SafetyFilter
from safedpa_lab.benchmarks.filter_problem import problem_with
found, problem = {}, problem_with(1)
for name in ("car", "car_learned"):
    model = load_model(name)
    one = SafetyFilter.for_model(model, problem.settings, tuple(problem.barriers().parts))
    times = []
    for asked in problem.requests(model):
        began = time.perf_counter()
        one.decide(*asked)
        times.append(1e6 * (time.perf_counter() - began))
    found[name] = times[0], sorted(times)[len(times) // 2]
print(json.dumps(found))
"""
Part = tuple[list[Entry], list[Target]]


def measure(effort: Effort) -> Row:
    """Decisions next to cbfpy, own models, scans, the first decision, the loop and the fleet."""
    parts: list[Callable[[Effort], Part]] = [_decisions, _own_models, _scans, _first]
    parts += [] if effort.quick else [_loop, _fleet]
    entries, targets = list[Entry](), list[Target]()
    for part in parts:
        try:
            found, wanted = part(effort)
        except SafedpaError as error:
            found, wanted = [missing(part.__name__.strip("_"), str(error))], []
        entries += found
        targets += wanted
    peers = tuple(entry for entry in entries if not entry.name.startswith("safedpa"))
    ours = tuple(entry for entry in entries if entry.name.startswith("safedpa"))
    return Row("kernel", "what compiled decisions are to reach", "p50", ours, peers, tuple(targets))


def _decisions(effort: Effort) -> Part:
    """Decisions of all models and scenes in turn; then cbfpy in its own process."""
    counts, (calls, seconds) = tuple(_AHEAD), effort.of((200, 2.0), (10_000, 25.0))
    problems = {count: problem_with(count) for count in counts}
    asked = {
        f"{what}, {_obstacles(count)}": decided(problem, load_model(model))
        for count, problem in problems.items()
        for model, what in MODELS.items()
    }
    asked["physics, no feasible action"] = decided(wedged(), load_model("car"))
    found = in_turn(asked, calls, seconds)
    plain = without_compiler(*effort.of((100, 1.0), (5000, 10.0)))
    entries = [microseconds("safedpa", times, name) for name, times in found.items()]
    if "missing" in plain:
        entries.append(missing("safedpa", plain["missing"], _WITHOUT))
    else:
        found[_WITHOUT] = plain
        entries.append(microseconds("safedpa", plain, _WITHOUT))
    about = (*effort.of((100, 0.2), (20_000, 4.0)), "elastiqp")
    question = {"problems": [problem.question(*about) for problem in problems.values()]}
    reply = ask_peer("filters:cbfpy", "cbfpy", question, effort.interpreters)
    targets = [
        Target(f"{figure} of {name}", most, found[name]["wall"][figure], "us")
        for name, limits in _MOST.items()
        if name in found
        for figure, most in zip(_FIGURES, limits, strict=True)
    ]
    if "missing" in reply:
        return [*entries, missing("cbfpy, elastiqp", reply["missing"])], targets
    for count, answer in zip(counts, reply["answers"], strict=True):
        entries.append(microseconds("cbfpy, elastiqp", answer, _obstacles(count)))
        targets += _ratios(found, answer, count)
    return entries, targets


def _ratios(found: dict[str, Any], answer: dict[str, Any], count: int) -> Iterator[Target]:
    for what in MODELS.values():
        for figure in _FIGURES:
            ratio = answer["wall"][figure] / found[f"{what}, {_obstacles(count)}"]["wall"][figure]
            name = f"cbfpy with elastiqp over {what}, {_obstacles(count)}, {figure}"
            yield Target(name, _AHEAD[count], round(ratio, 2), "", "more")


def _own_models(effort: Effort) -> Part:
    entries, targets = list[Entry](), list[Target]()
    for name, robot in ROBOTS.items():
        asked = robot.requests(effort.of(40, 300), _SEED)
        try:
            decide, cold = made_cold(name, robot)
        except SafedpaError as error:
            entries.append(missing("safedpa, own model", str(error), name))
            continue
        times = in_turn({name: (decide, asked)}, *effort.of((40, 1.0), (3000, 12.0)))[name]
        entries.append(microseconds("safedpa, own model", times, name))
        targets.append(Target(f"p99 of a RolloutBarrier, {name}", 2000.0, times["wall"]["p99"], "us"))
        targets.append(Target(f"compiled without a cache, {name}", 3.0, round(cold, 2), "s"))
    return entries, targets


def _scans(effort: Effort) -> Part:
    times = in_turn({"256 points": sensed(256)}, *effort.of((40, 1.0), (4000, 10.0)))["256 points"]
    wall, processor = map(percentiles, chain_times(1080, effort.of(20, 300)))
    entries = [
        microseconds("safedpa, decision", times, "256 points of a scan"),
        Entry("safedpa, scan to action", wall, "us", processor, "1,080 rays"),
    ]
    targets = [
        Target("p50 with 256 points of a scan", 60.0, times["wall"]["p50"], "us"),
        Target("p99 from a scan of 1,080 rays to the action", 6000.0, wall["p99"], "us"),
    ]
    return entries, targets


def _first(effort: Effort) -> Part:
    """The first decision of a filter in a new process, and the median of the next ones."""
    done = subprocess.run([sys.executable, "-c", _FIRST], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SafedpaError((done.stderr.strip().splitlines() or ["no output"])[-1])
    entries, targets = list[Entry](), list[Target]()
    for name, (first, later) in json.loads(done.stdout).items():
        entries.append(Entry("safedpa, the first decision", {"p50": first}, problem=name, note=f"later {later:.0f} us"))
        targets.append(Target(f"the first decision of a filter, {name}", 1000.0, round(first, 1), "us"))
    return entries, targets


def _loop(effort: Effort) -> Part:
    entries, targets = list[Entry](), list[Target]()
    for rate in (20.0, 200.0):
        found, at = latency_benchmark(effort.of(2.0, 40.0, 600.0), rate), f"{rate:g} Hz"
        loop, bare = found["real_loop_us"], found["bare_chain_us"]
        entries += [Entry("safedpa, loop", loop, problem=at), Entry("bare Zenoh chain", bare, problem=at)]
        targets.append(Target(f"p99 of the loop over the bare chain, {at}", 1.2, found["ratio_p99"], ""))
        late = round(bare["late_share"] * rate * found["seconds"])
        targets.append(Target(f"late ticks, {at}", late, loop["watchdog_ticks"], ""))
    return entries, targets


def _fleet(effort: Effort) -> Part:
    """The services' processor time, and a fleet with its simulation; one that does not come up is reported as that."""
    seconds = effort.of(2.0, 40.0, 600.0)
    entries: list[Entry] = []
    targets: list[Target] = []
    name, problem = "safedpa, services", f"{_STACK} robots"
    try:
        process = fleet_benchmark(FleetTrial(_STACK, seconds, realtime=True, stacks=1))["processes"]["stack_1"]
        cost = float(process["us_per_robot_tick"]) if process else float("nan")
        entries.append(Entry(name, {"us_a_robot_tick": cost}, problem=problem))
        targets.append(Target("processor time of the services, a robot-tick", 60.0, cost, "us"))
    except SafedpaError as error:
        entries.append(missing(name, str(error), problem))
    name, problem = "safedpa, fleet", f"{_ROBOTS} robots with their simulation"
    try:
        crowd = fleet_benchmark(FleetTrial(_ROBOTS, seconds, realtime=True, stacks=2))
        late = round(100.0 * crowd["late_share"], 3)
        entries.append(Entry(name, {"late_percent": late}, problem=problem))
    except SafedpaError as error:
        late = 100.0
        entries.append(missing(name, str(error), problem))
    targets.append(Target(f"late ticks of {problem}", 0.1, late, "%"))
    return entries, targets


def _obstacles(count: int) -> str:
    return f"{count} obstacles" if count > 1 else "1 obstacle"
