"""Diagnosis against truths that it cannot see: how often it names what is hidden, and nothing else."""

from __future__ import annotations

import json
import multiprocessing
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from safedpa.diagnosis.diagnose import diagnose
from safedpa.dynamics import load_model
from safedpa.errors import InputError, RunError, SafedpaError
from safedpa.records import load_run
from safedpa_lab.experiments.diagnosis.diagnosing import diagnosed, oracle_error
from safedpa_lab.experiments.diagnosis.hidden_report import document_of, read_outcomes, write_document
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent
from safedpa_lab.hidden import SUITES, Case, Log, cases_of, write_case, write_cases
from safedpa_lab.hidden.judge import Outcome, judged
from safedpa_lab.provenance.record import write_result

__all__ = ["ALL", "HORIZONS", "hidden_effects_experiment", "hidden_horizons", "run", "run_cases"]

_AT_ONCE = 4
"""Cases that one process simulates together."""
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def hidden_effects_experiment(
    suites: Sequence[str],
    count: int,
    seed: int = 0,
    processes: int = 2,
    report_progress: ReportProgress = silent,
    record: Path | None = None,
) -> dict[str, Any]:
    """``count`` cases of each suite, diagnosed and judged; one row a suite and effect, and every case.

    ``record``: a file that is written after every few cases; what it holds already is not done again, and its cases
    count as well. Raises InputError where it is something else.
    """
    outcomes, seeds = read_outcomes(record) if record is not None else ([], [])
    known = {item.case for item in outcomes}
    cases = [case for suite in suites for case in cases_of(suite, count, seed) if case.name not in known]
    groups = [cases[start : start + _AT_ONCE] for start in range(0, len(cases), _AT_ONCE)]
    seeds = [*seeds, seed] if cases else seeds
    found = document_of(outcomes, seeds)
    for done in _outcomes(groups, processes):
        outcomes = _in_order([*outcomes, *done])
        found = document_of(outcomes, seeds)
        if record is not None:
            write_document(found, record)
        report_progress(len(outcomes) - len(known), len(cases))
    return found


def _outcomes(groups: Sequence[Sequence[Case]], processes: int) -> Iterator[list[Outcome]]:
    """The outcomes of each group as soon as they are there."""
    if processes == 1:
        yield from map(run_cases, groups)
        return
    with _one_thread_each(), ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        for future in as_completed([pool.submit(run_cases, group) for group in groups]):
            yield future.result()


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes that start within use one thread: more would get into each other's way."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _in_order(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """By suite, independent of the order of the processes."""
    place = {suite: number for number, suite in enumerate(SUITES)}
    return sorted(outcomes, key=lambda item: (place.get(item.suite, len(place)), item.hidden, item.case))


def run_cases(cases: Sequence[Case]) -> list[Outcome]:
    """Writes the cases into a temporary folder, diagnoses each, then opens its truth."""
    with tempfile.TemporaryDirectory(prefix="safedpa-hidden-") as folder:
        logs = write_cases(cases, [Path(folder) / str(number) for number in range(len(cases))])
        return [_outcome(log) for log in logs]


_REFUSED = {
    "verdict": "refused",
    "added": [],
    "stages": [{"heldout_error": "nan"}],
    "candidates": [],
    "unexplained": None,
}
"""The message about a file that cannot be read."""


def _outcome(log: Log) -> Outcome:
    begin, processor = time.perf_counter(), time.process_time()
    try:
        document = diagnosed(log.model, log.runs)
    except RunError as error:
        if log.case.fault is None:
            raise SafedpaError(f"{log.case.name}: {error}") from error
        document = _REFUSED
    except SafedpaError as error:
        raise SafedpaError(f"{log.case.name}: {error}") from error
    seconds, processor = time.perf_counter() - begin, time.process_time() - processor
    truth = json.loads(log.truth.read_text(encoding="utf-8"))
    oracle = oracle_error(log.model, log.runs, truth["effects"], truth["laws"]) if truth["effects"] else None
    return judged(log.case.name, document, truth, oracle, seconds, processor)


ALL = tuple(SUITES)
"""Every suite, in order."""


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment hidden-effects``, or its comparison of horizons. Raises InputError for its page."""
    suites = ALL if "all" in (options["suites"] or ("all",)) else options["suites"]
    cases, seed, out = options["cases"], options["seed"], options["out"]
    if not options["horizons"]:
        return hidden_effects_experiment(suites, cases, seed, options["processes"], report_progress, out)
    if options["page"] is not None:
        raise InputError("--page: got it with --horizons, which has no page; leave it out")
    result = hidden_horizons(suites, cases, seed, report_progress=report_progress)
    if out is not None:
        write_result(out, result)
    return result


HORIZONS = (0.2, 0.35, 0.5, 0.7, 1.0)
"""s."""


def hidden_horizons(
    suites: Sequence[str],
    count: int,
    seed: int = 0,
    horizons: Sequence[float] = HORIZONS,
    report_progress: ReportProgress = silent,
) -> dict[str, Any]:
    """``count`` cases of each suite, each diagnosed once for each of the ``horizons`` [s]: verdict, names, numbers."""
    cases = [case for suite in suites for case in cases_of(suite, count, seed)]
    rows = []
    for case in cases:
        rows.append(_row(case, horizons))
        report_progress(len(rows), len(cases))
    return {
        "experiment": "hidden-horizons",
        "seed": seed,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "horizons": list(horizons),
        "cases": rows,
        "equal": sum(row["equal"] for row in rows),
        "of": len(rows),
    }


def _row(case: Case, horizons: Sequence[float]) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="safedpa-horizons-") as folder:
        notice = [_message(write_case(case, Path(folder)), horizon) for horizon in horizons]
    same = all((own["verdict"], own["added"]) == (notice[0]["verdict"], notice[0]["added"]) for own in notice)
    return {"case": case.name, "hidden": list(case.effects), "equal": same, "notice": notice}


def _message(log: Log, horizon: float) -> dict[str, Any]:
    """What a diagnosis says whose errors are shown after ``horizon`` [s]."""
    model = load_model(log.model)
    report = diagnose(model, [load_run(path, model.system) for path in log.runs], horizon)
    return {
        "horizon": horizon,
        "verdict": report.verdict,
        "added": sorted(report.added),
        "error": round(report.stages[-1].heldout_error, 4),
    }
