"""Diagnosis against truths that it cannot see: how often it names what is hidden, and nothing else."""

from __future__ import annotations

import json
import multiprocessing
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from safedpa.errors import SafedpaError
from safedpa_sim.experiments.diagnosing import diagnosed, oracle_error
from safedpa_sim.experiments.hidden_summary import summary
from safedpa_sim.hidden import SUITES, Case, Log, cases_of, write_cases
from safedpa_sim.hidden.judge import Outcome, judged

__all__ = ["ALL", "hidden_effects_experiment", "run_cases"]

_AT_ONCE = 6
"""Cases that one process simulates together."""


def hidden_effects_experiment(
    suites: Sequence[str],
    count: int,
    seed: int = 0,
    processes: int = 2,
    tell: Callable[[int, int], None] = lambda _done, _all: None,
) -> dict[str, Any]:
    """``count`` cases of each suite, diagnosed and judged; one row a suite and effect, and every case."""
    cases = [case for suite in suites for case in cases_of(suite, count, seed)]
    groups = [cases[start : start + _AT_ONCE] for start in range(0, len(cases), _AT_ONCE)]
    outcomes: list[Outcome] = []
    if processes == 1:
        for group in groups:
            outcomes += run_cases(group)
            tell(len(outcomes), len(cases))
        return summary(suites, outcomes)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context) as pool:
        for done in pool.map(run_cases, groups):
            outcomes += done
            tell(len(outcomes), len(cases))
    return summary(suites, outcomes)


def run_cases(cases: Sequence[Case]) -> list[Outcome]:
    """Writes the cases into a temporary folder, diagnoses each, then opens its truth."""
    with tempfile.TemporaryDirectory(prefix="safedpa-hidden-") as folder:
        logs = write_cases(cases, [Path(folder) / str(number) for number in range(len(cases))])
        return [_outcome(log) for log in logs]


def _outcome(log: Log) -> Outcome:
    begin = time.perf_counter()
    try:
        document = diagnosed(log.model, log.runs)
    except SafedpaError as error:
        raise SafedpaError(f"{log.case.name}: {error}") from error
    seconds = time.perf_counter() - begin
    truth = json.loads(log.truth.read_text(encoding="utf-8"))
    oracle = oracle_error(log.model, log.runs, list(truth["effects"])) if truth["effects"] else None
    return judged(log.case.name, document, truth, oracle, seconds)


ALL = tuple(SUITES)
"""Every suite, in order."""
