"""The largest fleet that holds at 20 Hz, next to services of its own for every robot."""

from __future__ import annotations

import concurrent.futures
from collections.abc import Mapping
from typing import Any, Final

from safedpa.errors import SafedpaError
from safedpa_lab.benchmarks.fleet import LATE_SHARE, FleetTrial, fleet_benchmark, largest_fleet
from safedpa_lab.benchmarks.results import Curve, Effort, Entry, Row, Target, missing

_STACKS = 2
"""The asked number of robots is for two cores."""
_ASKED: Final = 200
_ASKED_ELSEWHERE: Final = 400
"""Robots whose simulation is on another machine."""
_CORES: Final = 2.0
_STEADY_SECONDS: Final = 600.0
_MOST_P99: Final = 25.0
"""ms; half of a period."""
_MOST_GAIN: Final = 0.2
"""MiB a robot: what the margins remember of each, until that is full."""
_MOST_COST: Final = 125.0
"""us of processor that each of the two stacks takes, over all robot-ticks: by both together two cores carry the robots
that are simulated elsewhere."""


def measure(effort: Effort) -> Row:
    """Doubles and bisects twice: two stacks of services that share all robots, and services for every robot.

    In full the asked number drives for ten minutes besides.
    """
    seconds = effort.of(2.0, 20.0, 60.0)
    trials: list[dict[str, Any]] = []
    trial = FleetTrial(effort.of(2, 100), seconds, realtime=True, stacks=_STACKS)
    shared = largest_fleet(trial, trials.append, _shared) if not effort.quick else _once(trial, trials)
    apart_trials: list[dict[str, Any]] = []
    begin = FleetTrial(effort.of(1, 4), seconds, realtime=True)
    apart = (
        largest_fleet(begin, apart_trials.append, _apart) if not effort.quick else _once(begin, apart_trials, _apart)
    )
    ours = [_entry("safedpa, two stacks", shared, trials, "adaptation, policy and filter in one process, twice")]
    note = "adaptation, policy and filter of its own, and a robot's process, for every robot"
    peers = (_entry("services for each robot", apart, apart_trials, note),)
    ordered = sorted(trials, key=lambda found: int(found["robots"]))
    x = tuple(float(found["robots"]) for found in ordered)
    late: dict[str, tuple[float | None, ...]] = {
        f"sense to act, {name}": tuple(_milliseconds(found["sense_to_act_us"][name]) for found in ordered)
        for name in ("p50", "p99")
    }
    curve = Curve("fleet", "robots at 20 Hz", "sense to act [ms]", x, late)
    targets = [Target("robots at 20 Hz", float(_ASKED), float(shared), "robots", "more")]
    retained = next((found for found in trials if found["robots"] == shared), None)
    if effort.full:
        retained = _shared(FleetTrial(_ASKED, _STEADY_SECONDS, realtime=True, stacks=_STACKS))
        ours.append(_steady(retained))
        targets += _steady_targets(ours[-1])
    if retained is not None and (cost := _cost(retained)):
        what = f"processor of a stack, of two, a robot-tick, {retained['robots']} robots"
        targets.append(Target(what, _MOST_COST, round(cost / _STACKS, 1), "us"))
        what = f"cores that the services of {_ASKED_ELSEWHERE} robots simulated elsewhere take by that"
        targets.append(Target(what, _CORES, round(1e-6 * cost * _ASKED_ELSEWHERE * trial.rate, 2), "cores"))
    work = f"the largest fleet at 20 Hz with at most {100.0 * LATE_SHARE:g} % late ticks, {seconds:g} s each"
    return Row("largest-fleet", work, "robots", tuple(ours), peers, tuple(targets), (curve,), better="more")


def _steady(found: Mapping[str, Any]) -> Entry:
    """The asked number of robots for ten minutes: late share, sense to act, memory and what it gains."""
    name, problem = f"safedpa, {_ASKED} robots, two stacks", f"{_STEADY_SECONDS:g} s"
    if "failed" in found:
        return missing(name, found["failed"], problem)
    used = [each for each in found["processes"].values() if each]
    figures = {
        "robots": float(_ASKED),
        "mib": round(sum(each["mib_end"] for each in used), 1),
        "late_percent": 100.0 * found["late_ticks"] / max(found["robot_ticks"], 1),
        "p99_ms": _milliseconds(found["sense_to_act_us"]["p99"]) or 0.0,
        "mib_gained": round(sum(each["mib_end"] - each["mib_begin"] for each in used), 1),
        "us_a_robot_tick": _cost(found),
    }
    about = {name: found.get(name) for name in (*_RETAINED, "load_average")}
    note = "adaptation, policy and filter in one process, twice; memory of all processes, the simulation's too"
    return Entry(name, figures, "", problem=problem, note=note, more=about)


def _steady_targets(entry: Entry) -> list[Target]:
    """What a fleet that breaks down does not tell is none of them, but all of its ticks count as late."""
    what = f"{_ASKED} robots for {_STEADY_SECONDS:g} s"
    late = Target(f"late ticks of {what}", 100.0 * LATE_SHARE, entry.figures.get("late_percent", 100.0), "%")
    if entry.missing:
        return [late]
    p99, gained = entry.figures["p99_ms"], entry.figures["mib_gained"]
    return [
        late,
        Target(f"p99 of {what}", _MOST_P99, p99, "ms"),
        Target(f"memory gained by {what}", _MOST_GAIN * _ASKED, gained, "MiB"),
    ]


def _cost(found: Mapping[str, Any]) -> float:
    """us of processor a robot-tick, of the services without the simulation; 0 where the system does not tell."""
    reported = [each for name, each in found["processes"].items() if each and name != "robots"]
    return round(float(sum(each.get("us_per_robot_tick", 0.0) for each in reported)), 1)


def _once(trial: FleetTrial, trials: list[dict[str, Any]], measure_one: Any = None) -> int:
    """One fleet, without a search."""
    trials.append((measure_one or _shared)(trial))
    return trial.robots if trials[-1]["holds"] else 0


def _entry(name: str, robots: int, trials: list[dict[str, Any]], note: str = "") -> Entry:
    retained = next((found for found in trials if found["robots"] == robots), None)
    more = {"trials": [{key: found.get(key) for key in _RETAINED} for found in trials]}
    memory = sum(used["mib_end"] for used in retained["processes"].values() if used) if retained else 0.0
    figures = {"robots": float(robots)} | ({"mib": round(memory, 1)} if retained else {})
    return Entry(name, figures, "", note=note, more=more)


_RETAINED = (
    "robots",
    "robot_ticks",
    "late_ticks",
    "late_while_held_up",
    "sense_to_act_us",
    "processes",
    "holds",
    "collisions",
    "failed",
)


def _apart(trial: FleetTrial) -> dict[str, Any]:
    """So many loops of one robot each, all at once."""
    one = FleetTrial(1, trial.seconds, trial.rate, realtime=trial.realtime)
    with concurrent.futures.ThreadPoolExecutor(trial.robots) as pool:
        found = list(pool.map(_shared, [one] * trial.robots))
    ticks, late = (sum(int(each[key]) for each in found) for key in ("robot_ticks", "late_ticks"))
    worst = {name: max((each["sense_to_act_us"][name] or 0) for each in found) for name in ("p50", "p99")}
    processes = {
        f"{name} {number}": used for number, each in enumerate(found) for name, used in each["processes"].items()
    }
    return {
        "robots": trial.robots,
        "robot_ticks": ticks,
        "late_ticks": late,
        "sense_to_act_us": worst,
        "processes": processes,
        "holds": all("failed" not in each for each in found) and late <= LATE_SHARE * max(ticks, 1),
    }


def _shared(trial: FleetTrial) -> dict[str, Any]:
    """One fleet; one that does not come up, or breaks down, does not hold."""
    try:
        return fleet_benchmark(trial)
    except SafedpaError as error:
        nothing = {"robot_ticks": 0, "late_ticks": 0, "sense_to_act_us": {"p50": None, "p99": None}, "processes": {}}
        return {"robots": trial.robots, **nothing, "holds": False, "failed": str(error)}


def _milliseconds(microseconds: float | None) -> float | None:
    return None if microseconds is None else 1e-3 * microseconds
