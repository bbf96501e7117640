"""The diagnosis of a simulated fleet compared with the truth: right and false groups, time, memory."""

from __future__ import annotations

import os
import platform
import resource
import tempfile
import time
from collections.abc import Mapping, Sequence, Set
from contextlib import ExitStack
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from safedpa.diagnosis.fit.cross_validation import heldout_of
from safedpa.diagnosis.fit.multiple_shooting import shooting_of
from safedpa.diagnosis.search.initial_model import initial_search
from safedpa.dynamics import load_model
from safedpa.fleet import Fleet, diagnose_fleet, robots_in_folder
from safedpa.fleet import Options as DiagnosisOptions
from safedpa.fleet.workers import in_processes
from safedpa.records import load_run
from safedpa_lab.experiments.common.statistics import wilson_interval
from safedpa_lab.experiments.diagnosis.diagnosing import HORIZON
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent
from safedpa_lab.hidden import CAR_EFFECTS, Case, Log, write_cases
from safedpa_lab.hidden.case import ABSORBED
from safedpa_lab.hidden.fleet import fleet_truth, write_fleet
from safedpa_lab.provenance.record import KEY


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
    report_progress: ReportProgress = silent,
) -> dict[str, Any]:
    """Writes a fleet into ``folder``, diagnoses it into ``folder/diagnosis``, and compares the result with the truth.

    Robots that were diagnosed before are skipped, so an interrupted run continues.
    """
    logs = write_fleet(fleet_truth(robots, seed, common), folder, seed, hard=hard, runs=runs, seconds=seconds)
    out = folder / "diagnosis"
    out.mkdir(exist_ok=True)
    begin = time.perf_counter()
    fleet = Fleet(robots_in_folder(logs.recordings), DiagnosisOptions(str(logs.model)), out)
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
    """Whether every robot is in a group that names its hidden effects, and the groups are the true ones.

    A group names an effect that it holds, or that its robots' data cannot tell from one that it holds. What is hidden
    in all robots has to be named as common; in a robot it counts neither way.
    """
    groups, shared = document["groups"], set.intersection(*(set(own) for own in truth.values()))
    truth = {name: {key: own[key] for key in own if key not in shared} for name, own in truth.items()}
    place = {name: group for group in groups for name in group["robots"]}
    rows = [_robot(name, hidden, place[name], document, shared) for name, hidden in truth.items()]
    healthy = [row for row in rows if not row["hidden"]]
    ill = [row for row in rows if row["hidden"]]
    false = [
        group
        for group in groups
        if group["kind"] in ("missing", "unexplained") and not any(truth[name] for name in group["robots"])
    ]
    deviations = [abs(value) for row in rows for value in row["deviations"].values()]
    return {
        "hidden": _share([row["right"] for row in ill]),
        "healthy": _share([row["right"] for row in healthy]),
        "groups_hidden": len({tuple(row["hidden"]) for row in rows if row["hidden"]}),
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


def _right_groups(rows: Sequence[Mapping[str, Any]], groups: Sequence[Mapping[str, Any]]) -> int:
    """Kinds of hidden effects whose robots form exactly one group."""
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
        ("healthy robots that are reported as healthy", _of(result["healthy"])),
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
    from safedpa.fleet.summary import group_title, numbers_text

    errors = [("" if value is None else f"{value:.3g}") for value in (group["error_before"], group["error_after"])]
    return f"| {group_title(group)} | {len(group['robots'])} | {numbers_text(group)} | {errors[0]} | {errors[1]} |"


def _names(names: Sequence[str]) -> str:
    return " + ".join(names) or "nothing"


def _of(share: Mapping[str, Any] | None) -> str:
    if share is None:
        return ""
    low, high = share["interval_95"]
    return f"{share['hits']} of {share['of']} (95 % interval {100 * low:.0f} to {100 * high:.0f} %)"


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment fleet-diagnosis``, or with ``--screen`` the search by the size of the error."""
    seed, hard = options["seed"], not options["plain"]
    if options["screen"]:
        return fleet_screen(seed, hard=hard, report_progress=report_progress)
    given = {key: options[key] for key in ("jobs", "common", "runs", "seconds")}
    with ExitStack() as stack:
        folder = options["out"] or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="safedpa-fleet-")))
        folder.mkdir(parents=True, exist_ok=True)
        return fleet_diagnosis_experiment(
            options["robots"], seed, folder.resolve(), hard=hard, report_progress=report_progress, **given
        )


def report(result: Result) -> str:
    """The tables of a fleet; of the search by the size of the error, the effects that it would miss."""
    if "missed" not in result:
        return page_of(result, result.get(KEY, {}).get("command") or "safedpa experiment fleet-diagnosis")
    count, quantile = result["effects"], 100 * result["quantile"]
    lines = [
        f"{len(result['missed'])} of {count} effects lie within the errors of {quantile:.0f} % of healthy robots.",
        "",
    ]
    for row in result["rows"]:
        lines.append(f"- {row['effect']}: error {row['error']:.4f}, {row['over_limit']:.3f} of the limit")
    return "\n".join(lines)


_SHARE = {False: 0.2, True: 1.0}
"""Of the ordinary strength, in plain and in hard logs: what the search finds in all cases."""
_LIMIT = 0.95
"""Quantile of the healthy robots' errors above which the screen would send a robot to the search."""


def fleet_screen(
    seed: int, healthy: int = 24, *, hard: bool = False, report_progress: ReportProgress = silent
) -> dict[str, Any]:
    """Errors of healthy cars, and of cars with each effect; how many of these a limit would miss.

    In plain logs effects have a fifth of their ordinary strength, in ``hard`` ones all of it. Healthy cars come with a
    speed servo and with a throttle, as many as there are; each is compared with its own kind.
    """
    weak = [
        Case(
            "screen",
            seed + 1000 + n,
            {name: CAR_EFFECTS[name].drawn(np.random.default_rng(seed + n), _SHARE[hard])},
            drive=CAR_EFFECTS[name].drive,
            hard=hard,
        )
        for n, name in enumerate(CAR_EFFECTS)
        if not (hard and name in ABSORBED)
    ]
    drives = sorted({item.drive for item in weak})
    quiet = [Case("screen", seed + n, {}, drive=drives[n % len(drives)], hard=hard) for n in range(healthy)]
    errors = _errors([*quiet, *weak], report_progress)
    limits = {
        drive: float(np.quantile([e for case, e in zip(quiet, errors, strict=False) if case.drive == drive], _LIMIT))
        for drive in drives
    }
    rows: list[dict[str, Any]] = [
        {"effect": next(iter(case.effects)), "error": error, "over_limit": error / limits[case.drive]}
        for case, error in zip(weak, errors[len(quiet) :], strict=True)
    ]
    return {
        "seed": seed,
        "healthy": healthy,
        "hard": hard,
        "share_of_ordinary_strength": _SHARE[hard],
        "quantile": _LIMIT,
        "limits": limits,
        "effects": len(rows),
        "missed": [str(row["effect"]) for row in rows if float(row["over_limit"]) <= 1.0],
        "rows": sorted(rows, key=lambda row: float(row["over_limit"])),
    }


def _errors(cases: Sequence[Case], report_progress: ReportProgress) -> list[float]:
    """Held-out error of the given model in each case, with its free parameters refitted."""
    found = []
    with tempfile.TemporaryDirectory(prefix="safedpa-screen-") as folder:
        logs = write_cases(cases, [Path(folder) / str(number) for number in range(len(cases))])
        for number, log in enumerate(logs):
            report_progress(number, len(logs))
            found.append(_error(log))
    return found


def _error(log: Log) -> float:
    model = load_model(log.model)
    runs = [load_run(path, model.system) for path in log.runs]
    return initial_search(model, shooting_of(runs, HORIZON), heldout_of(runs, HORIZON)).error.value
