"""Reads logs with every fault in every format it can have, and counts what was read wrongly, lost and reported."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from safedpa_lab.experiments.common.seeds import seeds_of
from safedpa_lab.experiments.common.workers import Workers
from safedpa_lab.experiments.record import Options, ReportProgress, Result
from safedpa_lab.experiments.report import markdown_table
from safedpa_lab.log_faults.faults import FAULTS, FORMS, Fault
from safedpa_lab.log_faults.judge import Score, read_spoilt

__all__ = ["INTACT", "NAMES", "report", "run"]

INTACT: Final = "intact"
"""The logs without a fault."""
_BY_NAME: Final[dict[str, Fault | None]] = {INTACT: None, **{fault.name: fault for fault in FAULTS}}
NAMES: Final = tuple(_BY_NAME)
Task = tuple[str, str, int]


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Reads ``seeds`` logs of each fault and format; a row for each fault and format."""
    names = options["faults"] or NAMES
    formats = options["formats"] or FORMS
    pairs = [(name, form) for name in names for form in _forms(_BY_NAME[name]) if form in formats]
    seeds = seeds_of(options)
    tasks = [(name, form, seed) for name, form in pairs for seed in seeds]
    scores: dict[tuple[str, str], list[Score]] = {}
    with Workers(options["processes"]) as workers:
        for done, ((name, form, _), score) in enumerate(zip(tasks, workers.map(_score, tasks), strict=True), 1):
            scores.setdefault((name, form), []).append(score)
            report_progress(done, len(tasks))
    rows = [_row(name, form, found) for (name, form), found in scores.items()]
    return {"seeds": [seeds.start, seeds.stop], "rows": rows, "totals": _totals(rows)}


def _forms(fault: Fault | None) -> Sequence[str]:
    return FORMS if fault is None else fault.forms


def _score(task: Task) -> Score:
    name, form, seed = task
    with tempfile.TemporaryDirectory(prefix="safedpa-log-faults-") as folder:
        return read_spoilt(_BY_NAME[name], form, seed, Path(folder))


def _row(name: str, form: str, scores: list[Score]) -> dict[str, Any]:
    fault = _BY_NAME[name]
    return {
        "fault": name,
        "format": form,
        "meaning": "no fault" if fault is None else fault.meaning_in(form),
        "logs": len(scores),
        "wrong_rows": sum(score.wrong for score in scores),
        "lost_share": sum(score.lost for score in scores) / len(scores),
        "unreported": sum(not score.reported for score in scores),
        "with_findings": sum(score.surplus > 0 for score in scores),
        "refused": sum(bool(score.refused) for score in scores),
        "crashed": sum(score.crashed for score in scores),
        "refusal": next((score.refused for score in scores if score.refused), ""),
        "scores": [asdict(score) for score in scores],
    }


def _totals(rows: list[dict[str, Any]]) -> dict[str, Any]:
    intact = [row for row in rows if row["fault"] == INTACT]
    spoilt = [row for row in rows if row["fault"] != INTACT]
    return {
        "kinds": len({row["fault"] for row in spoilt}),
        "logs": sum(row["logs"] for row in spoilt),
        "wrong_rows": sum(row["wrong_rows"] for row in spoilt),
        "lost_share": sum(row["lost_share"] * row["logs"] for row in spoilt) / max(1, sum(r["logs"] for r in spoilt)),
        "worst_lost_share": max((row["lost_share"] for row in spoilt), default=0.0),
        "unreported": sum(row["unreported"] for row in spoilt),
        "crashed": sum(row["crashed"] for row in rows),
        "intact": sum(row["logs"] for row in intact),
        "intact_with_findings": sum(row["with_findings"] for row in intact),
    }


def report(result: Result) -> str:
    """The table of all faults and formats."""
    totals = result["totals"]
    above = (
        f"{totals['logs']} logs of {totals['kinds']} kinds of faults: {totals['wrong_rows']} rows with a command, "
        f"state or time of another row; {totals['lost_share']:.1%} of the undamaged rows lost; "
        f"{totals['unreported']} logs whose fault was not reported; {totals['crashed']} crashes. "
        f"{totals['intact_with_findings']} of {totals['intact']} intact logs got a finding."
    )
    rows = (
        f"{row['fault']} | {row['format']} | {row['meaning']} | {row['logs']} | {row['wrong_rows']} | "
        f"{row['lost_share']:.1%} | {row['unreported']} | {row['refused']}"
        for row in result["rows"]
    )
    head = "fault | format | meaning | logs | wrong rows | good rows lost | unreported | refused"
    return markdown_table(head, rows, above=above)
