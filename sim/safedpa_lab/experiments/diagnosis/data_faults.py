"""Which faults of the data of five robots are noticed, which become physics, and what is found in good logs."""

from __future__ import annotations

import multiprocessing
import re
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, Final

from safedpa.dynamics import load_model
from safedpa.dynamics.user_files import load_user_file_everywhere
from safedpa.errors import InputError
from safedpa.records import load_run
from safedpa_lab.experiments.diagnosis.diagnosing import diagnosed
from safedpa_lab.experiments.diagnosis.hidden_effects import one_thread_each
from safedpa_lab.experiments.record import Options, ReportProgress, Result
from safedpa_lab.experiments.report import markdown_table
from safedpa_lab.own_robots import models
from safedpa_lab.own_robots.cases import OwnCase, write_case
from safedpa_lab.own_robots.data_faults import FAULTS, GOOD, Truth, faulty_log, good_log
from safedpa_lab.own_robots.plants import PLANTS

__all__ = ["ROBOTS", "report", "run", "run_case"]

ROBOTS: Final = ("own_servo", "own_joint", "own_boat", "own_omni", "own_quadrotor")
"""Robots on which faults are planted unless others are named; good logs are of all ten."""
HARMLESS: Final = ("held", "constant_input", "irregular_sampling", "cut", "thinned")
"""Findings that state a fact about a good log; they name no fault."""
_NEAR: Final = 0.05
"""Share of the log within which a finding names the time,"""
_SIZE: Final = 0.3
"""and share of the true size within which it names the size."""
Task = tuple[str, str, str, int, bool]


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment data-faults``."""
    robots, first = options["robots"] or ROBOTS, options["first_seed"]
    tasks: list[Task] = [
        ("fault", name, robot, first + number, options["diagnose"])
        for number in range(options["seeds"])
        for name in options["faults"] or FAULTS
        for robot in robots
    ]
    tasks += [
        ("good", kind, robot, first + 1000 + number, False)
        for number in range(options["good"])
        for kind in GOOD
        for robot in PLANTS
    ]
    rows = []
    load_user_file_everywhere(Path(models.__file__))
    context = multiprocessing.get_context("spawn")
    with one_thread_each(), ProcessPoolExecutor(options["processes"], mp_context=context) as pool:
        for row in pool.map(run_case, tasks):
            rows.append(row)
            report_progress(len(rows), len(tasks))
    return {"rows": rows, "totals": _totals(rows)}


def run_case(task: Task) -> dict[str, Any]:
    """Writes one log, reads and on request diagnoses it, and compares the findings with the truth."""
    group, name, robot, seed, with_diagnosis = task
    load_user_file_everywhere(Path(models.__file__))
    plant = PLANTS[robot]
    log, truth = (good_log(name, robot, seed), None) if group == "good" else faulty_log(FAULTS[name], robot, seed)
    added: list[str] = []
    with tempfile.TemporaryDirectory(prefix="safedpa-data-faults-") as folder:
        model, (path,), _ = write_case(
            OwnCase("own_none", robot, seed, {}, 1), Path(folder), [(log.t, log.states, log.actions)]
        )
        findings: list[dict[str, Any]] = []
        try:
            findings = [vars(item) for item in load_run(path, load_model(model).system).findings]
            if with_diagnosis:
                document = diagnosed(model, [path])
                findings, added = document["data_quality"], list(document["added"])
        except InputError as error:
            findings += [{"kind": "refused", "message": str(error).replace(folder, ""), "start_t": None}]
    reported = [item for item in findings if item["kind"] not in HARMLESS]
    found = None if truth is None else _noticed(reported, truth, float(log.t[-1] - log.t[0]))
    return {
        "group": group, "name": name, "robot": robot, "seed": seed, "period": plant.period,
        "truth": None if truth is None else vars(truth), "noticed": found, "physics": added,
        "findings": [[item["kind"], item["message"], item["start_t"]] for item in reported],
    }  # fmt: skip


def _noticed(findings: Sequence[Mapping[str, Any]], truth: Truth, duration: float) -> dict[str, bool]:
    """Whether one finding names channel, channel and time, and channel, time and size."""
    found = {"channel": False, "time": False, "size": False}
    for item in findings:
        if not set(truth.channels) & set(re.findall(r"\w+", item["message"])):
            continue
        start = item["start_t"]
        time = truth.time is None or (start is not None and abs(start - truth.time) <= max(1.0, _NEAR * duration))
        numbers = [float(text) for text in re.findall(r"-?\d+\.?\d*(?:e-?\d+)?", item["message"])]
        size = time and any(abs(abs(one) - abs(truth.size)) <= _SIZE * abs(truth.size) for one in numbers)
        found = {"channel": True, "time": found["time"] or time, "size": found["size"] or size}
    return found


def _totals(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    faults, good = ([row for row in rows if row["group"] == group] for group in ("fault", "good"))
    return {
        "faulty": len(faults),
        "noticed": sum(row["noticed"]["time"] for row in faults),
        "sized": sum(row["noticed"]["size"] for row in faults),
        "as_physics": sum(bool(row["physics"]) for row in faults),
        "good": len(good),
        "good_with_findings": sum(bool(row["findings"]) for row in good),
    }


def report(result: Result) -> str:
    """The table of faults, and the findings in good logs."""
    totals, rows = result["totals"], result["rows"]
    faults = [row for row in rows if row["group"] == "fault"]
    lines = []
    for name in dict.fromkeys(row["name"] for row in faults):
        own = [row for row in faults if row["name"] == name]
        counts = " | ".join(str(sum(row["noticed"][what] for row in own)) for what in ("channel", "time", "size"))
        missed = sorted({row["robot"] for row in own if not row["noticed"]["time"]})
        physics = sum(bool(row["physics"]) for row in own)
        lines.append(
            f"{name} | {FAULTS[name].meaning} | {len(own)} | {counts} | {physics} | {', '.join(missed) or '-'}"
        )
    wrong = [row for row in rows if row["group"] == "good" and row["findings"]]
    below = "\n".join(
        f"- {row['name']}, {row['robot']}, seed {row['seed']}: {row['findings'][0][1]}" for row in wrong[:40]
    )
    above = (
        f"{totals['noticed']} of {totals['faulty']} faulty logs were noticed with channel and time, {totals['sized']} "
        f"with their size as well; {totals['as_physics']} were diagnosed as physics. {totals['good_with_findings']} of "
        f"{totals['good']} good logs got a finding."
    )
    head = "fault | meaning | logs | channel | and time | and size | physics | missed on"
    return markdown_table(head, lines, above=above) + (f"\nFindings in good logs:\n\n{below}\n" if below else "")
