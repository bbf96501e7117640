"""Measures the limits of a plausible state in healthy drives, in the conditions of ``false_stops``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, Final

from safedpa.bus import LatentMessage
from safedpa.calibration.from_drives import DriveTick
from safedpa.calibration.state_limits import only_answers, state_evidence
from safedpa.dynamics import load_model
from safedpa.safety.defaults import settings_named
from safedpa.safety.session.state_limits import Evidence, StateLimits, limits_from_evidence
from safedpa_lab.experiments.common.seeds import seeds_for
from safedpa_lab.experiments.common.workers import each_result
from safedpa_lab.experiments.driving.false_stops import healthy_drive
from safedpa_lab.experiments.driving.implausible_states import HEALTHY, StateDrive
from safedpa_lab.experiments.driving.state_faults import ROBOTS, FaultyState, drive_directly
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent
from safedpa_lab.experiments.report import markdown_table

_TABLES: Final = tuple(field.name for field in fields(StateLimits))


def measured_evidence(wanted: StateDrive) -> list[Evidence]:
    """What the states of a healthy drive show."""
    kind = ROBOTS[wanted.robot]
    truth = wanted.simulated()
    source = FaultyState(truth, kind.system, HEALTHY, wanted.seed, wanted.noise, wanted.lost_share)
    latents: dict[int, LatentMessage] = {}
    missed = wanted.missed_ticks(truth.period)
    ticks = [
        DriveTick(tick.state, latents.get(tick.state.tick))
        for tick in drive_directly(
            source,
            kind.nodes(),
            round(wanted.seconds / truth.period),
            missed.__contains__,
            lambda latent: latents.update({latent.tick: latent}),
        )
    ]
    rows = state_evidence(load_model(kind.model), settings_named(kind.settings), ticks)
    # The session compares a state with the prediction under each allowed delay, and widens the limit of a drift after
    # lost states; the rows know of neither.
    if wanted.late:
        rows = list(map(only_answers, rows))
    elif wanted.lost_share or missed:
        rows = [row._replace(drift=only_answers(row).drift) for row in rows]
    # Views of mappings cannot be sent to another process.
    return [Evidence(dict(row.jump), dict(row.drift), dict(row.unanswered), dict(row.overbraking)) for row in rows]


def state_limits(
    robots: Sequence[str], drives: int, seconds: float, processes: int, on_drive: ReportProgress = silent
) -> dict[str, Any]:
    """The limits of each robot from ``drives`` of its worlds in turn."""
    seeds = seeds_for("calibration", drives, 70_000)
    wanted = [healthy_drive(name, index, seed, seconds) for name in robots for index, seed in enumerate(seeds)]
    found: dict[str, list[Evidence]] = {}
    for one, rows in zip(wanted, each_result(measured_evidence, wanted, processes, on_drive), strict=True):
        found.setdefault(one.robot, []).extend(rows)
    limits = {name: limits_from_evidence(rows) for name, rows in found.items()}
    return {
        "drives": drives,
        "seconds": seconds,
        "seeds": [seeds[0], seeds[-1]],
        "limits": {name: {table: dict(getattr(each, table)) for table in _TABLES} for name, each in limits.items()},
        "files": {
            name: each.text(f"{drives} healthy drives of {seconds:g} s, seeds {seeds[0]} to {seeds[-1]}")
            for name, each in limits.items()
        },
    }


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment state-limits``."""
    names = options["robots"] or tuple(ROBOTS)
    found = state_limits(names, options["drives"], options["seconds"], options["processes"], report_progress)
    files = found.pop("files")
    if options["folder"] is not None:
        for name, text in files.items():
            (Path(options["folder"]) / f"{name}.toml").write_text(text, encoding="utf-8")
    return {"experiment": "state-limits", **found}


def report(result: Result) -> str:
    """One row per robot and unit."""
    rows = [
        " | ".join(
            (
                name,
                unit,
                *(f"{table[key][unit]:.3g}" if unit in table[key] else "-" for key in _TABLES),
            )
        )
        for name, table in result["limits"].items()
        for unit in table["jump"]
    ]
    return markdown_table("robot | unit | jump | drift in 2 s | drift per way | unanswered | overbraking", rows)
