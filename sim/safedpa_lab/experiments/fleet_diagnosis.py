"""A simulated fleet's diagnosis compared with what was hidden in it: right groups, false ones, seconds, memory."""

from __future__ import annotations

import os
import platform
import resource
import time
from collections.abc import Callable, Mapping, Sequence, Set
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from safedpa.fleet import Fleet, Options, diagnose_fleet, robots_in_folder
from safedpa.fleet.workers import in_processes
from safedpa_lab.experiments.statistics import wilson_interval
from safedpa_lab.hidden.fleet import fleet_truth, write_fleet

__all__ = ["fleet_diagnosis_experiment", "judged_fleet", "page_of"]

ReportProgress = Callable[[int, int], None]


def fleet_diagnosis_experiment(
    robots: int,
    seed: int,
    folder: Path,
    *,
    jobs: int = 2,
    hard: bool = True,
    common: bool = False,
    runs: int = 4,
    seconds: float = 40.0,
    report_progress: ReportProgress = lambda _done, _all: None,
) -> dict[str, Any]:
    """Writes a fleet into ``folder``, diagnoses it into ``folder/diagnosis``, opens the truth, and judges.

    What was diagnosed before is not done again, so an interrupted experiment goes on.
    """
    logs = write_fleet(fleet_truth(robots, seed, common), folder, seed, hard=hard, runs=runs, seconds=seconds)
    out = folder / "diagnosis"
    out.mkdir(exist_ok=True)
    begin = time.perf_counter()
    fleet = Fleet(robots_in_folder(logs.recordings), Options(str(logs.model)), out)
    document = diagnose_fleet(fleet, partial(_pool, jobs), report_progress)
    return {
        "experiment": "fleet-diagnosis",
        "format": 1,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {"python": platform.python_version(), **{name: version(name) for name in ("safedpa", "numpy")}},
        "robots": robots,
        "seed": seed,
        "hard": hard,
        "runs": runs,
        "seconds_of_a_run": seconds,
        "jobs": jobs,
        "load": round(os.getloadavg()[0], 1),
        **judged_fleet(document, logs.truth["robots"]),
        **_costs(document, time.perf_counter() - begin),
    }


def _pool(jobs: int, work: Any, items: Sequence[Any], failed: Any) -> Any:
    return in_processes(work, items, min(jobs, max(1, len(items))), failed)


def judged_fleet(document: Mapping[str, Any], truth: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Whether every robot stands in a group that names what is hidden in it, and the groups are those of the truth.

    A group names an effect that it holds, or that its robots' data cannot tell from one that it holds. What is hidden
    in all robots has to be named as common; in a robot it counts neither way.
    """
    groups, shared = document["groups"], set.intersection(*(set(own) for own in truth.values()))
    truth = {name: {key: own[key] for key in own if key not in shared} for name, own in truth.items()}
    place = {name: group for group in groups for name in group["robots"]}
    rows = [_robot(name, hidden, place[name], document, shared) for name, hidden in truth.items()]
    healthy = [row for row in rows if not row["hidden"]]
    ill = [row for row in rows if row["hidden"]]
    false = [group for group in groups if group["kind"] in ("missing", "unexplained") and not _any_hidden(group, truth)]
    deviations = [abs(value) for row in rows for value in row["deviations"].values()]
    return {
        "hidden": _share([row["right"] for row in ill]),
        "healthy": _share([row["right"] for row in healthy]),
        "groups_hidden": _kinds(rows),
        "groups_right": _right_groups(rows, groups),
        "groups_false": len(false),
        "within_two_deviations": _share([value <= 2.0 for value in deviations]),
        "largest_deviation": max(deviations, default=None),
        "common_hidden": sorted(shared),
        "common_named": sorted(_common_named(document)),
        "common": document["common"],
        "false_discovery": document["false_discovery"],
        "groups": groups,
        "wrong": [row for row in rows if not row["right"]],
    }


def _common_named(document: Mapping[str, Any]) -> list[str]:
    """Effects that were written into the model of the whole fleet."""
    common = document["common"] or {"effects": []}
    return [item["effect"] for item in common["effects"] if item["confirmed"]["holds"]]


def _robot(
    name: str,
    hidden: Mapping[str, Mapping[str, float]],
    group: Mapping[str, Any],
    document: Mapping[str, Any],
    shared: Set[str],
) -> dict[str, Any]:
    found = next(row for row in document["robots"] if row["robot"] == name)
    named = [{item["effect"], *item["indistinguishable_from"]} for item in group["effects"]]
    named = [each for each in named if not each & shared]
    missing = group["kind"] == "missing"
    nothing = group["kind"] == "nothing" or (missing and not named)
    reported = all(any(effect in each for each in named) for effect in hidden)
    right = reported and len(hidden) == len(named) and not any(each.isdisjoint(hidden) for each in named)
    return {
        "robot": name,
        "hidden": list(hidden),
        "found": [item["effect"] for item in group["effects"]],
        "kind": group["kind"],
        "right": (missing and right) if hidden else nothing,
        "deviations": _deviations(hidden, found["found"]),
    }


def _deviations(hidden: Mapping[str, Mapping[str, float]], found: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """(value - truth) / stated deviation of every number of what was found under its own name."""
    return {
        f"{item['effect']}.{name}": (number["value"] - hidden[item["effect"]][name]) / number["std"]
        for item in found
        if item["effect"] in hidden
        for name, number in item["parameters"].items()
        if number["std"]
    }


def _any_hidden(group: Mapping[str, Any], truth: Mapping[str, Mapping[str, Any]]) -> bool:
    return any(truth[name] for name in group["robots"])


def _kinds(rows: Sequence[Mapping[str, Any]]) -> int:
    return len({tuple(row["hidden"]) for row in rows if row["hidden"]})


def _right_groups(rows: Sequence[Mapping[str, Any]], groups: Sequence[Mapping[str, Any]]) -> int:
    """Kinds of hidden effects whose robots, all of them and no other, make up one group."""
    right = {row["robot"]: row["right"] for row in rows}
    members = [set(group["robots"]) for group in groups if group["kind"] == "missing"]
    count = 0
    for kind in {tuple(row["hidden"]) for row in rows if row["hidden"]}:
        own = {row["robot"] for row in rows if tuple(row["hidden"]) == kind}
        count += own in members and all(right[name] for name in own)
    return count


def _share(hits: Sequence[bool]) -> dict[str, Any] | None:
    if not hits:
        return None
    count = int(sum(hits))
    return {"hits": count, "of": len(hits), "interval_95": [round(end, 4) for end in wilson_interval(count, len(hits))]}


def _costs(document: Mapping[str, Any], seconds: float) -> dict[str, Any]:
    kinds: dict[str, list[float]] = {"nothing": [], "missing": []}
    for robot in document["robots"]:
        kinds.setdefault(robot["kind"], []).append(robot["processor_seconds"])
    every = [value for own in kinds.values() for value in own]
    return {
        "diagnosed_now": document["diagnosed_now"],
        "wall_seconds": round(seconds, 1),
        "processor_seconds_a_robot": {
            "median": float(np.median(every)),
            "largest": float(max(every)),
            **{kind: float(np.median(own)) for kind, own in kinds.items() if own},
        },
        "memory_mebibytes_of_a_worker": max(robot["memory_mebibytes"] for robot in document["robots"]),
        "memory_mebibytes_of_the_command": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
    }


def page_of(result: Mapping[str, Any], command: str) -> str:
    """The result as Markdown."""
    what = f"{result['robots']} robots, seed {result['seed']}, {'hard' if result['hard'] else 'plain'} logs"
    runs = f"{result['runs']} runs of {result['seconds_of_a_run']:g} s each"
    lines = [
        "# A fleet's diagnosis: results",
        "",
        f"{what}, {runs}; {result['date'][:10]}; `{command}`.",
        "",
        "| asked of the truth | |",
        "|---|--:|",
        *(f"| {name} | {value} |" for name, value in _rows(result)),
        "",
        "| group | robots | numbers | error before | after |",
        "|---|--:|---|--:|--:|",
        *map(_group_line, result["groups"]),
    ]
    wrong = [
        f"- `{row['robot']}`: hidden {_names(row['hidden'])}; {row['kind']} {_names(row['found'])}"
        for row in result["wrong"]
    ]
    return "\n".join([*lines, "", "Not right:", "", *(wrong or ["none."])]) + "\n"


def _rows(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    seconds, load = result["processor_seconds_a_robot"], result["load"]
    memory = (result["memory_mebibytes_of_a_worker"], result["memory_mebibytes_of_the_command"])
    kinds = f"{result['groups_right']} of {result['groups_hidden']}"
    clock = f"{result['wall_seconds']:.0f} s with {result['jobs']} processes, load {load:g} on {os.cpu_count()} cores"
    if result["diagnosed_now"] < result["robots"]:
        clock += f"; {result['robots'] - result['diagnosed_now']} robots had been diagnosed before"
    return [
        ("robots with something hidden that stand in a group that names it", _of(result["hidden"])),
        ("kinds of faults of which all robots, and no other, make up one group", kinds),
        ("robots with nothing hidden of which that is said", _of(result["healthy"])),
        ("false groups", str(result["groups_false"])),
        *_common_rows(result),
        ("numbers within two stated deviations of the truth", _of(result["within_two_deviations"])),
        ("seconds of one core a robot: median, largest", f"{seconds['median']:.1f}, {seconds['largest']:.1f}"),
        ("memory of a worker, of the command at most", f"{memory[0]} MiB, {memory[1]} MiB"),
        ("by the clock", clock),
    ]


def _common_rows(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    if not result["common_hidden"] and not result["common_named"]:
        return []
    phrase = [", ".join(result[key]) or "nothing" for key in ("common_hidden", "common_named")]
    return [(f"hidden in all robots: {phrase[0]}; written into the model of all", phrase[1])]


def _group_line(group: Mapping[str, Any]) -> str:
    from safedpa.fleet.story import group_title, numbers_text

    errors = [("" if value is None else f"{value:.3g}") for value in (group["error_before"], group["error_after"])]
    return f"| {group_title(group)} | {len(group['robots'])} | {numbers_text(group)} | {errors[0]} | {errors[1]} |"


def _names(names: Sequence[str]) -> str:
    return " + ".join(names) or "nothing"


def _of(share: Mapping[str, Any] | None) -> str:
    if share is None:
        return ""
    low, high = share["interval_95"]
    return f"{share['hits']} of {share['of']} (95 % interval {100 * low:.0f} to {100 * high:.0f} %)"
