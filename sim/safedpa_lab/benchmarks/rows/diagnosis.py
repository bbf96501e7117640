"""Diagnosis of six runs of forty seconds, next to programs that look for terms of equations."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from safedpa_lab.benchmarks.diagnosis_cases import (
    CASES,
    Hidden,
    expression_is_right,
    reported,
    terms_are_right,
    written,
)
from safedpa_lab.benchmarks.peer_process import ask_peer
from safedpa_lab.benchmarks.real_drives import dart_drives
from safedpa_lab.benchmarks.results import Curve, Effort, Entry, Row, Target, missing

__all__ = ["measure"]

_RUNS, _SECONDS = 6, 40.0
_HORIZON = 1.0
_LACKS = "given what the model leaves of each step; no memory of actuators, nothing held out, no verdict"
_THRESHOLDS: Final = {"polynomial": 0.05, "weak": 0.05}
"""Below it a coefficient is dropped: half of the weakest term that is hidden."""


def measure(effort: Effort) -> Row:
    """Cases with one hidden effect, two, or none: seconds of each and how many answers are right."""
    runs, seconds = effort.of((2, 20.0), (_RUNS, _SECONDS))
    cases = CASES[1:2] if effort.quick else CASES
    with tempfile.TemporaryDirectory(prefix="safedpa-bench-") as name:
        logs = [written(case, Path(name) / str(number), runs, seconds) for number, case in enumerate(cases)]
        own, candidates = _ours(cases, logs)
        offered = _offered(logs[0])
        peers = _peers(cases, [reported(log) for log in logs], effort)
        curves = (_over_length(Path(name), effort), _over_effects(logs[-1], effort))
    real, real_targets = dart_drives(effort)
    targets = (
        Target("the longest of the cases", 10.0, own.figures["longest"], "s"),
        Target("the cases on average", 5.0, own.figures["seconds"], "s"),
        *real_targets,
    )
    work = f"diagnosis of {runs} runs of {seconds:g} s, {candidates} candidates and their pairs, {len(cases)} cases"
    notes = (f"hidden: {', '.join(case.name for case in cases)}", offered)
    return Row("diagnosis", work, "seconds", (own, real), tuple(peers), targets, curves, notes=notes)


def _offered(log: Any) -> str:
    """Which candidates there are: the library of cars without what the given model's actions do not allow."""
    from safedpa.diagnosis.diagnose import library_for
    from safedpa.dynamics import load_model
    from safedpa.effects import effects_of

    model = load_model(log.model)
    every, offered = effects_of(model.system.name), {item.name for item in library_for(model)}
    left_out = ", ".join(name for name in every if name not in offered)
    return f"candidates: {len(offered)} of the library's {len(every)} effects; not for this drive: {left_out or 'none'}"


def _ours(cases: Sequence[Hidden], logs: Sequence[Any]) -> tuple[Entry, int]:
    from safedpa.diagnosis.diagnose import library_for
    from safedpa.dynamics import load_model
    from safedpa_lab.experiments.diagnosis.diagnosing import diagnosed
    from safedpa_lab.hidden.case import truth_of
    from safedpa_lab.hidden.judge import judged

    clock: list[float] = []
    used: list[float] = []
    right = []
    for hidden, log in zip(cases, logs, strict=True):
        began, before = time.perf_counter(), time.process_time()
        document = diagnosed(log.model, log.runs)
        clock.append(time.perf_counter() - began)
        used.append(time.process_time() - before)
        outcome = judged(hidden.name, document, truth_of(log.case), None, clock[-1])
        right.append(outcome.right and not outcome.wrong)
    named = [case.name for case, good in zip(cases, right, strict=True) if not good]
    note = "reads the files, searches, fits, judges" + (f"; not right: {', '.join(named)}" if named else "")
    return _entry("safedpa", clock, used, right, note), len(library_for(load_model(logs[0].model)))


def _entry(
    name: str, clock: Sequence[float], used: Sequence[float], right: Sequence[bool], note: str, **more: Any
) -> Entry:
    figures = {"seconds": sum(clock) / len(clock), "longest": max(clock), "right": float(sum(right))}
    processor = {"seconds": sum(used) / len(used), "longest": max(used)}
    return Entry(name, figures, "s", processor, note=note, more={"cases": len(right), **more})


def _peers(cases: Sequence[Hidden], questions: list[dict[str, Any]], effort: Effort) -> list[Entry]:
    found = []
    for way, name in (("weak", "pysindy, weak form"), ("polynomial", "pysindy, polynomial")):
        question = {"way": way, "threshold": _THRESHOLDS[way], "cases": questions}
        answer = ask_peer("diagnosis_pysindy", "pysindy", question, effort.interpreters, 600.0)
        found.append(_peer(name, answer, cases, way))
    question = {"seconds": effort.of(1, 3), "cases": questions}
    answer = ask_peer("diagnosis_operon", "pyoperon", question, effort.interpreters, 600.0)
    found.append(_peer("pyoperon", answer, cases, "expression"))
    return found


def _peer(name: str, reply: dict[str, Any], cases: Sequence[Hidden], way: str) -> Entry:
    if "missing" in reply:
        return missing(name, reply["missing"], note=_LACKS)
    answers = reply["answers"]
    if way == "expression":
        right = [
            expression_is_right(case, [equation["variables"] for equation in answer["equations"]])
            for case, answer in zip(cases, answers, strict=True)
        ]
        note = "as long as it is given; right if its expressions name the right variables alone; "
    else:
        right = [terms_are_right(case, answer["equations"]) for case, answer in zip(cases, answers, strict=True)]
        note = f"{answers[0]['terms']} terms of degree 2 in 4 variables; right if exactly the hidden terms stay; "
    clock, used = ([answer[key] for answer in answers] for key in ("seconds", "processor_seconds"))
    notice = {case.name: answer["equations"] for case, answer in zip(cases, answers, strict=True)}
    return _entry(name, clock, used, right, note + _LACKS, version=reply["version"], notice=notice)


def _over_length(folder: Path, effort: Effort) -> Curve:
    """Seconds of our diagnosis over the length of each run."""
    from safedpa_lab.experiments.diagnosis.diagnosing import diagnosed

    lengths, times = effort.of((5.0, 10.0), (10.0, 20.0, 40.0, 80.0, 160.0)), []
    for length in lengths:
        log = written(CASES[1], folder / f"long {length:g}", effort.of(2, _RUNS), length)
        began = time.process_time()
        diagnosed(log.model, log.runs)
        times.append(time.process_time() - began)
    series: dict[str, tuple[float | None, ...]] = {"safedpa": tuple(times)}
    return Curve("diagnosis_length", "s of each run", "diagnosis [s of processor]", tuple(lengths), series)


def _over_effects(log: Any, effort: Effort) -> Curve:
    """Seconds of our search over the number of candidates in the library."""
    from safedpa.diagnosis.diagnose import library_for
    from safedpa.diagnosis.fit.data_checks import prepare_runs
    from safedpa.diagnosis.fit.horizon import data_at_horizon
    from safedpa.diagnosis.search.forward_selection import run_search
    from safedpa.dynamics import load_model
    from safedpa.records import load_run

    model = load_model(log.model)
    usable = prepare_runs(model, [load_run(path, model.system) for path in log.runs])
    evidence = data_at_horizon(usable.runs, usable.seconds)
    hidden = set(log.case.effects)
    library = sorted(library_for(model), key=lambda item: item.name not in hidden)
    counts, times = effort.of((2, 4), (2, 6, 12, len(library))), []
    for count in counts:
        began = time.process_time()
        run_search(model, library[:count], evidence.shooting, evidence.heldout)
        times.append(time.process_time() - began)
    series: dict[str, tuple[float | None, ...]] = {"safedpa": tuple(times)}
    return Curve("diagnosis_effects", "candidate effects", "search [s of processor]", tuple(map(float, counts)), series)
