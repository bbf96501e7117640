"""Diagnosis of ten robots that do not ship, with models as a user writes them, against truths that it cannot see."""

from __future__ import annotations

import json
import multiprocessing
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from safedpa.comparison.rollout_error import error_of
from safedpa.diagnosis.fit.cross_validation import heldout_of
from safedpa.dynamics import load_model
from safedpa.dynamics.user_files import load_user_file_everywhere
from safedpa.records import load_run
from safedpa_lab.experiments.diagnosis.diagnosing import HORIZON, diagnosed, oracle_error
from safedpa_lab.experiments.diagnosis.hidden_effects import document_of, one_thread_each, page_of, read_outcomes
from safedpa_lab.experiments.record import Options, ReportProgress, Result
from safedpa_lab.hidden.judge import Outcome, judged
from safedpa_lab.own_robots import models
from safedpa_lab.own_robots.cases import SUITES, OwnCase, cases_of, write_case
from safedpa_lab.own_robots.plants import PLANTS, predicted
from safedpa_lab.provenance.record import write_result

__all__ = ["report", "run", "run_case", "truth_error"]

_NAME = "own-robots"


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment own-robots``. A case that the record holds is not repeated."""
    record: Path | None = options["out"]
    outcomes, seeds = read_outcomes(record, _NAME) if record is not None else ([], [])
    known = {item.case for item in outcomes}
    wanted = [
        case for suite in options["suites"] or SUITES for case in cases_of(suite, options["cases"], options["seed"])
    ]
    cases = [case for case in wanted if case.name not in known]
    load_user_file_everywhere(Path(models.__file__))
    result = _document(outcomes, seeds)
    context = multiprocessing.get_context("spawn")
    with one_thread_each(), ProcessPoolExecutor(options["processes"], mp_context=context) as pool:
        for done, outcome in enumerate(pool.map(run_case, cases), start=1):
            outcomes.append(outcome)
            result = _document(outcomes, [*seeds, options["seed"]])
            if record is not None:
                write_result(record, result)
            report_progress(done, len(cases))
    return result


def run_case(case: OwnCase) -> Outcome:
    """Writes a case into a temporary folder, diagnoses it, then opens its truth."""
    load_user_file_everywhere(Path(models.__file__))
    with tempfile.TemporaryDirectory(prefix="safedpa-own-robots-") as folder:
        model, runs, sealed = write_case(case, Path(folder))
        begin, processor = time.perf_counter(), time.process_time()
        document = diagnosed(model, runs)
        seconds, processor = time.perf_counter() - begin, time.process_time() - processor
        truth: dict[str, Any] = json.loads(sealed.read_text(encoding="utf-8"))
        known = {item.name for item in models.EFFECTS if item.robot == case.robot}
        # An effect that the library lacks today cannot be fitted, so there is no error to compare with.
        fitted = bool(truth["effects"]) and set(truth["effects"]) <= known
        oracle = oracle_error(model, runs, truth["effects"]) if fitted else None
        if case.outside:
            oracle = truth_error(case, model, runs)
        return judged(case.name, document, truth, oracle, seconds, processor)


def truth_error(case: OwnCase, model: Path, runs: Sequence[Path]) -> float:
    """The error of predictions by the true robot, from the measured starts of the windows that a report shows.

    A model with a smaller error, or one that is hardly larger, cannot be distinguished from the truth by these logs.
    """
    given = load_model(model)
    windows = heldout_of([load_run(path, given.system) for path in runs], HORIZON).windows
    windows = windows.select(np.unique(np.linspace(0, len(windows) - 1, _WINDOWS).astype(int)))
    predictions = np.empty((len(windows), len(given.system.state)))
    period = PLANTS[case.robot].period
    for number in range(case.runs):
        own = np.flatnonzero(windows.run == number)
        first, last = (np.round(windows.time[rows[own]] / period).astype(int) for rows in (windows.start, windows.end))
        wanted = list(zip(first.tolist(), last.tolist(), windows.states[windows.start[own]], strict=True))
        predictions[own] = predicted(PLANTS[case.robot], case.effects, case.seed + number, case.outside, wanted)
    return error_of(windows, windows.end, predictions).value


_WINDOWS = 300
"""Predictions by the true robot, which integrates finely, spread over all windows."""


def _document(outcomes: Sequence[Outcome], seeds: Sequence[int]) -> Result:
    return {**document_of(outcomes, seeds), "experiment": _NAME}


def report(result: Result) -> str:
    """The tables of a run."""
    return page_of(result).replace("# Hidden effects: results", "# Own robots: results")
