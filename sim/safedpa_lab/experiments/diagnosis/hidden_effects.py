"""Diagnosis against truths that it cannot see: how often it names what is hidden, and nothing else.

The cases become counts with intervals, a JSON document, and Markdown.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import platform
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, fields
from datetime import UTC, datetime
from importlib.metadata import version
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from safedpa.diagnosis.diagnose import diagnose
from safedpa.dynamics import load_model
from safedpa.errors import InputError, RunError, SafedpaError
from safedpa.records import load_run
from safedpa_lab.experiments.common.statistics import wilson_interval
from safedpa_lab.experiments.diagnosis.diagnosing import diagnosed, oracle_error
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent
from safedpa_lab.hidden import SUITES, Case, Log, cases_of, write_case, write_cases
from safedpa_lab.hidden.judge import Found, Outcome, judged
from safedpa_lab.provenance.record import require_same_maker, write_result


def summary(suites: Iterable[str], outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Rows by suite and, where one effect is hidden, by effect; and the cases that were not right."""
    rows, effects = [], []
    for suite in suites:
        own = [item for item in outcomes if item.suite == suite]
        rows.append(_suite_row(suite, "all", own))
        for name in sorted({item.hidden[0] for item in own if len(item.hidden) == 1}):
            effects.append(_suite_row(suite, name, [item for item in own if item.hidden == (name,)]))
    missed = [
        {
            "case": item.case,
            "hidden": list(item.hidden),
            "verdict": item.verdict,
            "added": [*item.added, *item.reported],
            "error_ratio": item.error_ratio if np.isfinite(item.error_ratio) else None,
        }
        for item in outcomes
        if not item.right or item.wrong or item.false_laws
    ]
    return {"suites": rows, "effects": effects, "missed": missed}


def _suite_row(suite: str, effect: str, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    deviations = np.abs([value for item in outcomes for value in item.deviations])
    ratios = np.array([item.error_ratio for item in outcomes if np.isfinite(item.error_ratio)])
    seconds = np.array([item.seconds for item in outcomes])
    processor = np.array([item.processor_seconds for item in outcomes if np.isfinite(item.processor_seconds)])
    hidden = any(item.hidden for item in outcomes)
    return {
        "suite": suite,
        "effect": effect,
        "cases": len(outcomes),
        "right": _share([item.right for item in outcomes]),
        "named_first": _share([item.first_named for item in outcomes]) if hidden else None,
        "all_named": _share([item.all_named for item in outcomes]) if hidden else None,
        "wrong_additions": _share([bool(item.wrong) for item in outcomes]),
        "false_laws": _share([bool(item.false_laws) for item in outcomes]),
        "parameters_within_two": _share([value <= 2.0 for value in deviations]) if len(deviations) else None,
        "error_ratio_median": float(np.median(ratios)) if len(ratios) else None,
        "error_ratio_largest": float(ratios.max()) if len(ratios) else None,
        "error_ratio_within": _share([value <= 1.1 for value in ratios]) if len(ratios) else None,
        "seconds_median": float(np.median(seconds)),
        "seconds_largest": float(seconds.max()),
        "processor_seconds_median": float(np.median(processor)) if len(processor) else None,
        "processor_seconds_largest": float(processor.max()) if len(processor) else None,
    }


def _share(hits: Sequence[Any]) -> dict[str, Any]:
    """Hits, trials and the 95 % interval of the share."""
    count = int(sum(bool(hit) for hit in hits))
    return {"hits": count, "of": len(hits), "interval_95": [round(end, 4) for end in wilson_interval(count, len(hits))]}


_FORMAT = 1
_LISTS = ("hidden", "added", "wrong", "reported", "false_laws")
_PACKAGES = ("safedpa", "numpy", "pymunk")


def document_of(outcomes: Sequence[Outcome], seeds: Sequence[int], end: datetime | None = None) -> dict[str, Any]:
    """What was measured when and with what, the figures by suite and effect, and every case."""
    suites = tuple(dict.fromkeys(item.suite for item in outcomes))
    versions = {"python": platform.python_version(), **{name: version(name) for name in _PACKAGES}}
    return {
        "experiment": "hidden-effects",
        "format": _FORMAT,
        "seeds": sorted(set(seeds)),
        "date": (end or datetime.now(UTC)).isoformat(timespec="seconds"),
        "versions": versions,
        **summary(suites, outcomes),
        "cases": [_case_row(item) for item in outcomes],
    }


def _case_row(item: Outcome) -> dict[str, Any]:
    row = asdict(item)
    row["parameters"] = [{**asdict(found), "deviation": found.deviation} for found in item.parameters]
    row.update({name: list(row[name]) for name in _LISTS})
    plain = {name: None if isinstance(value, float) and not isfinite(value) else value for name, value in row.items()}
    return {**plain, "right": item.right}


def write_document(document: Mapping[str, Any], path: Path) -> None:
    """Writes the record whole or not at all: a reader never finds half of one."""
    write_result(path, document)


def read_outcomes(path: Path, experiment: str = "hidden-effects") -> tuple[list[Outcome], list[int]]:
    """The cases and seeds of a record, none of one that is not there yet.

    Raises InputError for another document, and for cases of another command or of other code.
    """
    if not path.exists():
        return [], []
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        if (document["experiment"], document.get("format")) != (experiment, _FORMAT):
            raise KeyError("format")
        outcomes, seeds = [_read_outcome(row) for row in document["cases"]], list(document["seeds"])
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: got something else than a record of this experiment ({error}); name a new file"
        ) from error
    require_same_maker(path, document)
    return outcomes, seeds


def _read_outcome(row: Mapping[str, Any]) -> Outcome:
    known = {field.name for field in fields(Outcome)}
    values = {name: value for name, value in row.items() if name in known}
    for name in _LISTS:
        values[name] = tuple(values.get(name, ()))
    for name in ("error", "error_ratio", "seconds", "processor_seconds"):
        values[name] = _float_or_nan(values[name])
    values["parameters"] = tuple(
        Found(item["path"], *(_float_or_nan(item[name]) for name in ("value", "std", "truth")))
        for item in row["parameters"]
    )
    return Outcome(**values)


def _float_or_nan(reported: float | None) -> float:
    """Values that are not finite become null."""
    return float("nan") if reported is None else float(reported)


_HEAD = (
    "cases", "right", "95 % interval", "named first", "all named", "wrong extra", "false law", "parameters within 2 sd",
    "error over oracle: median", "worst", "at most 1.1", "seconds: median", "worst", "of one core: median", "worst",
)  # fmt: skip


def page_of(document: Mapping[str, Any]) -> str:
    """Markdown: a table by suite, one by effect, and the cases that were missed."""
    versions = ", ".join(f"{name} {number}" for name, number in document["versions"].items())
    seeds = ", ".join(map(str, document["seeds"]))
    count = len(document["cases"])
    lines = [
        "# Hidden effects: results",
        "",
        f"{count} cases, seeds {seeds}; finished {document['date'][:10]}; {versions}.",
        "What the suites are and what counts as right: [Hidden effects](../hidden-effects.md). Shares in %.",
        "",
        "## By suite",
        "",
        *_table("suite", document["suites"]),
    ]
    if document["effects"]:
        lines += ["", "## By effect", "", *_table("effect", document["effects"])]
    return "\n".join([*lines, "", "## Missed, or something wrong added too", "", *_missed(document["missed"])]) + "\n"


def _table(first: str, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    names = (first, *_HEAD) if first == "suite" else ("suite", first, *_HEAD)
    lines = [_line(names), _line(["---"] * (len(names) - len(_HEAD)) + ["--:"] * len(_HEAD))]
    for row in rows:
        title = [row["suite"]] if first == "suite" else [row["suite"], row["effect"]]
        lines.append(_line([*title, *_cells(row)]))
    return lines


def _cells(row: Mapping[str, Any]) -> list[str]:
    low, high = row["right"]["interval_95"]
    shares = ("named_first", "all_named", "wrong_additions", "false_laws", "parameters_within_two")
    seconds = (
        "seconds_median", "seconds_largest", "processor_seconds_median", "processor_seconds_largest",
    )  # fmt: skip
    return [
        str(row["cases"]),
        _percent(row["right"]),
        f"{100 * low:.0f} to {100 * high:.0f}",
        *(_percent(row[name]) for name in shares),
        _number(row["error_ratio_median"], 3),
        _number(row["error_ratio_largest"], 3),
        _percent(row["error_ratio_within"]) if row["error_ratio_median"] is not None else "",
        *(_number(row[name], 1) for name in seconds),
    ]


def _missed(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    if not rows:
        return ["None."]
    found = []
    for row in rows:
        hidden, added = (" + ".join(row[key]) or "nothing" for key in ("hidden", "added"))
        ratio = row.get("error_ratio")
        error = "" if ratio is None else f"; error {ratio:.2f} times that of the truth"
        found.append(f"- `{row['case']}`: hidden {hidden}; {row['verdict']}, added {added}{error}")
    return found


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _percent(share: Mapping[str, Any] | None) -> str:
    return "" if share is None else f"{100 * share['hits'] / share['of']:.0f}"


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def report(result: Result) -> str:
    """The tables of a run; of the comparison of horizons, the cases in which they differ."""
    if "suites" in result:
        return page_of(result)
    lines = [f"Verdict and names are equal for every horizon in {result['equal']} of {result['of']} cases.", ""]
    for row in result["cases"]:
        if not row["equal"]:
            found = "; ".join(f"{own['horizon']} s {own['verdict']} {'+'.join(own['added'])}" for own in row["notice"])
            lines.append(f"- differs: {row['case']}: {found}")
    return "\n".join(lines)


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
    with one_thread_each(), ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        for future in as_completed([pool.submit(run_cases, group) for group in groups]):
            yield future.result()


@contextmanager
def one_thread_each() -> Iterator[None]:
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
