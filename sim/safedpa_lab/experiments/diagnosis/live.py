"""Live diagnosis, measured: how soon a change is found, named and corrected; and is anything found where nothing is?"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any, Final

from safedpa.errors import InputError
from safedpa.live.model_monitor import ALPHA
from safedpa_lab.experiments.common.workers import each_result
from safedpa_lab.experiments.diagnosis.live_drive import CASES, MODEL_NAME, LiveDrive, drive_live, record_drive
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent
from safedpa_lab.experiments.report import markdown_table

__all__ = ["NOTHING", "LiveExperiment", "live_experiment", "report", "run"]

NOTHING: Final = "nothing"
_RAISED, _NAMED, _FELL = 10.0, 60.0, 20.0
"""s from the change to the finding and to the effect, and from the model's change to the fallen error."""
_LONGEST = 150.0
"""s of a drive in which something changes."""
_FALL = 0.4


@dataclass(frozen=True)
class LiveExperiment:
    """Which cases, on how many scenes each, and how long without any change."""

    cases: tuple[str, ...] = (*CASES, NOTHING)
    seeds: tuple[int, ...] = tuple(range(1, 11))
    quiet_seeds: tuple[int, ...] = (1,)
    quiet_seconds: float = 3600.0
    change_after: float = 30.0
    processes: int = 1
    model: str = MODEL_NAME


@dataclass(frozen=True)
class _Job:
    case: str
    seed: int
    seconds: float
    after: float
    model: str


def live_experiment(experiment: LiveExperiment, report_progress: ReportProgress = silent) -> dict[str, Any]:
    """One row a case with every drive in it, and the drives in which nothing changed."""
    jobs = [
        _Job(case, seed, _LONGEST, experiment.change_after, experiment.model)
        for case in experiment.cases
        if case != NOTHING
        for seed in experiment.seeds
    ]
    if NOTHING in experiment.cases:
        jobs += [
            _Job(NOTHING, seed, experiment.quiet_seconds, experiment.change_after, experiment.model)
            for seed in experiment.quiet_seeds
        ]
    drives = each_result(_run, jobs, experiment.processes, report_progress)
    rows = [_row(case, [item for item in drives if item.case == case]) for case in experiment.cases if case != NOTHING]
    quiet = [item for item in drives if item.case == NOTHING]
    return {**dataclasses.asdict(experiment), "rows": rows, "quiet": _quiet(quiet) if quiet else None}


def _run(job: _Job) -> LiveDrive:
    """The same job gives the same drive."""
    return drive_live(job.case, job.seed, job.seconds, job.after, model=job.model)


def _row(case: str, drives: Sequence[LiveDrive]) -> dict[str, Any]:
    found = [_judged(item) for item in drives]
    return {
        "case": case,
        "effect": CASES[case],
        "drives": len(found),
        **{
            name: sum(item[name] for item in found)
            for name in ("raised_in_time", "first", "named_in_time", "fell_in_time")
        },
        "collisions": sum(item["collisions"] for item in found),
        **{
            f"{name}_median": _median([item[name] for item in found])
            for name in ("seconds_to_finding", "seconds_to_effect", "seconds_to_fall", "before", "after")
        },
        "each": found,
    }


def _judged(drive: LiveDrive) -> dict[str, Any]:
    """The drive with times counted from the change, and which steps were in time."""
    changed = drive.changed

    def since(moment: float | None, start: float | None) -> float | None:
        return None if moment is None or start is None else round(moment - start, 3)

    to_finding, to_effect = since(drive.raised, changed), since(drive.found, changed)
    to_fall = since(drive.fell, drive.taken)
    right = CASES[drive.case]
    return {
        **dataclasses.asdict(drive),
        "seconds_to_finding": to_finding,
        "seconds_to_effect": to_effect,
        "seconds_to_fall": to_fall,
        "raised_in_time": to_finding is not None and 0.0 <= to_finding <= _RAISED,
        "first": drive.effect == right,
        "named_in_time": to_effect is not None and 0.0 <= to_effect <= _NAMED and right in (drive.effect, *drive.group),
        "fell_in_time": to_fall is not None and to_fall <= _FELL,
    }


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return round(median(known), 4) if known else None


def _quiet(drives: Sequence[LiveDrive]) -> dict[str, Any]:
    hours = sum(item.driven for item in drives) / 3600.0
    return {
        "hours": round(hours, 3),
        "findings": sum(item.findings for item in drives),
        "stated_probability_at_most": round(min(1.0, ALPHA * 3600.0 * hours), 6),
        "largest_evidence": round(max(item.evidence for item in drives), 2),
        "collisions": sum(item.collisions for item in drives),
        "each": [dataclasses.asdict(item) for item in drives],
    }


_CASES = ("hitch", "headwind", "steering_offset", "nothing")


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment live``, or records one of its drives."""
    case, after, record = options["case"], options["after"], options["record"]
    if not 25.0 <= after < 1e5:
        raise InputError("--after: wanted 25 s or more, the band is learned in the first 20 s")
    if record is not None:
        if case == "all":
            raise InputError("--record: got --case all, wanted one case; a recording holds one drive")
        drive = record_drive(case, options["seed"], 120.0 + after, after, record)
        return {"experiment": "live", "recording": str(record), **dataclasses.asdict(drive)}
    first, quiet = options["seed"], options["quiet_drives"]
    experiment = LiveExperiment(
        cases=_CASES if case == "all" else (case,),
        seeds=tuple(range(first, first + options["drives"])),
        quiet_seeds=tuple(range(first, first + quiet)),
        quiet_seconds=3600.0 * options["hours"] / quiet,
        change_after=after,
        processes=options["processes"],
    )
    return {"experiment": "live", **live_experiment(experiment, report_progress)}


def report(result: Result) -> str:
    """One row per change, and the findings while nothing changed."""
    if "recording" in result:
        return f"recording: {result['recording']}"
    parts = []
    if result["rows"]:
        above = f"The change comes after {result['change_after']:g} s; medians in s, errors over 1 s."
        head = "case | raised | after | named | after | first | error | then | fell | hits"
        parts.append(markdown_table(head, map(_row_text, result["rows"]), above=above))
    if (quiet := result["quiet"]) is not None:
        parts.append(
            f"Nothing changed in {quiet['hours']:g} h: {quiet['findings']} findings (stated: any with probability "
            f"{quiet['stated_probability_at_most']:.2%} at most), {quiet['collisions']} collisions."
        )
    return "\n\n".join(parts)


def _row_text(row: dict[str, Any]) -> str:
    def number(name: str, digits: int) -> str:
        value = row[f"{name}_median"]
        return "" if value is None else f"{value:.{digits}f}"

    count = row["drives"]
    return (
        f"{row['case']} | {row['raised_in_time']}/{count} | {number('seconds_to_finding', 1)} "
        f"| {row['named_in_time']}/{count} | {number('seconds_to_effect', 1)} | {row['first']}/{count} "
        f"| {number('before', 3)} | {number('after', 3)} | {row['fell_in_time']}/{count} | {row['collisions']}"
    )
