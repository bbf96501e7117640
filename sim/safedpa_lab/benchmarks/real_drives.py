"""Diagnosis of four drives of a real car, where their folder is named."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Final

from safedpa.errors import InputError
from safedpa_lab.benchmarks.results import Effort, Entry, Target, missing

__all__ = ["dart_drives"]

_NAME: Final = "safedpa, DART drives"
_PROBLEM: Final = "four drives of a real car"
_DRIVES: Final = 4
_HORIZON: Final = 1.0
"""s, as the experiment on real logs has it."""
_MOST_SECONDS: Final = 30.0


def dart_drives(effort: Effort) -> tuple[Entry, list[Target]]:
    """Seconds from the files to the report, by the clock and of the processor, and the target; or why there are none.

    Raises InputError where the named folder does not hold the four drives.
    """
    if effort.recordings is None:
        return missing(
            _NAME, "left out: --data DIR names the folder of the drives; see docs/real-logs.md", _PROBLEM
        ), []
    paths = _found(effort.recordings)
    if effort.quick:
        return missing(_NAME, "left out of a quick run", _PROBLEM), []
    entry = _diagnosed(paths)
    target = Target("DART drives, seconds of processor", _MOST_SECONDS, entry.processor["seconds"], "s")
    return entry, [target]


def _found(folder: Path) -> list[Path]:
    from safedpa_lab.experiments.diagnosis.real_logs_data import CAR, paths_of

    paths = paths_of(folder, CAR)
    if len(paths) != _DRIVES:
        raise InputError(f"--data {folder}: got {len(paths)} files {CAR}, wanted {_DRIVES}; see docs/real-logs.md")
    return paths


def _diagnosed(paths: list[Path]) -> Entry:
    from safedpa.diagnosis.diagnose import diagnose
    from safedpa.diagnosis.report_schema import as_document
    from safedpa.dynamics import load_model
    from safedpa_lab.experiments.diagnosis.real_logs_data import mapped_runs

    began, before = time.perf_counter(), time.process_time()
    model = load_model("dart_car")
    runs = mapped_runs(paths, model, "dart_car_columns")
    document = as_document(diagnose(model, runs, _HORIZON))
    seconds, used = time.perf_counter() - began, time.process_time() - before
    driven = sum(float(run.t[-1] - run.t[0]) for run in runs)
    note = f"{len(runs)} drives, {driven:.0f} s together, all from files to report"
    figures, processor = {"seconds": seconds, "longest": seconds}, {"seconds": used, "longest": used}
    return Entry(_NAME, figures, "s", processor, _PROBLEM, note, more={"verdict": document.get("verdict")})
