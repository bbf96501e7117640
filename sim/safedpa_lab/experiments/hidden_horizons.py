"""Whether a diagnosis says the same, whichever horizon its errors are shown at."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from safedpa.diagnosis.diagnose import diagnose
from safedpa.dynamics import load_model
from safedpa.records import load_run
from safedpa_lab.hidden import Case, Log, cases_of, write_case

__all__ = ["HORIZONS", "hidden_horizons"]

HORIZONS = (0.2, 0.35, 0.5, 0.7, 1.0)
"""s."""


def hidden_horizons(
    suites: Sequence[str],
    count: int,
    seed: int = 0,
    horizons: Sequence[float] = HORIZONS,
    report_progress: Callable[[int, int], None] = lambda _done, _all: None,
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
