"""All rows, or some, one after the other; what was measured before stays in the file."""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from safedpa.errors import InputError, SafedpaError, did_you_mean
from safedpa.fleet.workers import available_cores
from safedpa.native.library import why_not_compiled
from safedpa.records.writers.tables import atomic_path
from safedpa_lab.benchmarks.results import Effort
from safedpa_lab.benchmarks.rows import ROWS, measured
from safedpa_lab.benchmarks.usage import load_average
from safedpa_lab.provenance.record import KEY, installed_version, provenance

_FORMAT: Final = 1
_VERSIONS: Final = ("safedpa", "numpy", "torch", "piqp", "eclipse-zenoh", "pymunk", "mujoco-core", "gymnasium")

Document = dict[str, Any]


def chosen_rows(only: Sequence[str], effort: Effort) -> list[str]:
    """The rows to measure, in their order; without a choice all but the long ones, which ``full`` adds.

    Raises InputError for a row that does not exist.
    """
    for name in only:
        if name not in ROWS:
            raise InputError(f"--only {name}: {did_you_mean(name, ROWS)}")
    if only:
        return [name for name in ROWS if name in only]
    return [name for name, listed in ROWS.items() if effort.full or not listed.long]


def run_rows(
    names: Sequence[str],
    effort: Effort,
    file: Path | None,
    report_progress: Callable[[str, Document], None],
    resume: bool = False,
) -> Document:
    """Measures rows and hands each to ``report_progress`` as it comes; returns the whole document.

    With ``file`` every row is written as soon as it is there; rows in it that are not measured now stay, and with
    ``resume`` those that are there already are not measured again. A row that fails is reported; the others go on.
    """
    document: Document = {"format": _FORMAT, "rows": {}}
    if file is not None and file.exists():
        document = read_document(file)
    for name in names:
        if resume and "failed" not in document["rows"].get(name, {"failed": ""}):
            report_progress(name, document["rows"][name])
            continue
        document["rows"][name] = _one(name, effort)
        document["rows"] = {known: document["rows"][known] for known in ROWS if known in document["rows"]}
        if file is not None:
            with atomic_path(file) as unfinished:
                unfinished.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        report_progress(name, document["rows"][name])
    return document


def _one(name: str, effort: Effort) -> Document:
    before, began = load_average(), time.perf_counter()
    try:
        found = measured(name, effort).as_document()
    except (SafedpaError, OSError, ImportError) as error:
        found = {"name": name, "work": ROWS[name].work, "failed": f"{type(error).__name__}: {error}"}
    effort_name = "quick" if effort.quick else "full" if effort.full else "usual"
    about = {"effort": effort_name, "seconds": round(time.perf_counter() - began, 1)}
    return {**found, **about, "load_average": [before, load_average()], "machine": machine(), KEY: provenance()}


def read_document(file: Path) -> Document:
    """A file that ``run_rows`` wrote. Raises InputError naming it when it is none."""
    try:
        document: Document = json.loads(file.read_text(encoding="utf-8"))
        if document.get("format") != _FORMAT or not isinstance(document.get("rows"), dict):
            raise ValueError(f"format {document.get('format')!r}")
    except (OSError, ValueError, AttributeError) as error:
        raise InputError(f"{file}: got no results of this benchmark ({error}); wanted some, or no file") from error
    return document


def machine() -> Document:
    """What it runs on, without its name."""
    return {
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "processor": _processor(),
        "cores": available_cores(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "compiled": not why_not_compiled(),
        "threads": os.environ.get("OMP_NUM_THREADS", "as many as there are cores"),
        "versions": {name: found for name in _VERSIONS if (found := installed_version(name))},
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or "unknown"
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")
