"""Measures the limits of a plausible state in healthy drives, with loads, slip, wind, noise and lost states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from safedpa.calibration.from_drives import DriveTick
from safedpa.calibration.state_limits import state_evidence
from safedpa.dynamics import load_model
from safedpa.safety.defaults import settings_named
from safedpa.safety.session.state_limits import Evidence, limits_from_evidence
from safedpa_lab.experiments.common.drives import driven_with_latents
from safedpa_lab.experiments.common.seeds import seeds_for
from safedpa_lab.experiments.common.workers import each_result
from safedpa_lab.experiments.driving.state_faults import ROBOTS, FaultyState, StateFault
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent
from safedpa_lab.experiments.report import markdown_table

_HEALTHY: Final = StateFault("none")


@dataclass(frozen=True)
class HealthyDrive:
    """One drive without a fault."""

    robot: str
    world: str
    seed: int
    seconds: float


def measured_evidence(wanted: HealthyDrive) -> list[Evidence]:
    """What the states of the drive show."""
    kind = ROBOTS[wanted.robot]
    model, settings = load_model(kind.model), settings_named(kind.settings)
    truth = kind.make(wanted.world, wanted.seed)
    faulty = FaultyState(truth, kind.system, _HEALTHY, wanted.seed)
    nodes = kind.nodes()
    ticks: list[DriveTick] = driven_with_latents(faulty, nodes, round(wanted.seconds / truth.period))[1]
    return state_evidence(model, settings, ticks)


def state_limits(
    robots: Sequence[str], drives: int, seconds: float, processes: int, on_drive: ReportProgress = silent
) -> dict[str, Any]:
    """The limits of each robot from ``drives`` of its worlds in turn."""
    seeds = seeds_for("calibration", drives, 70_000)
    wanted = [
        HealthyDrive(name, kind.worlds[index % len(kind.worlds)], seed, seconds)
        for name in robots
        for kind in [ROBOTS[name]]
        for index, seed in enumerate(seeds)
    ]
    found: dict[str, list[Evidence]] = {}
    for one, rows in zip(wanted, each_result(measured_evidence, wanted, processes, on_drive), strict=True):
        found.setdefault(one.robot, []).extend(rows)
    limits = {name: limits_from_evidence(rows) for name, rows in found.items()}
    return {
        "drives": drives,
        "seconds": seconds,
        "seeds": [seeds[0], seeds[-1]],
        "limits": {
            name: {table: dict(getattr(each, table)) for table in ("jump", "drift", "drift_share", "unanswered")}
            for name, each in limits.items()
        },
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
                *(
                    f"{table[key][unit]:.3g}" if unit in table[key] else "-"
                    for key in ("jump", "drift", "drift_share", "unanswered")
                ),
            )
        )
        for name, table in result["limits"].items()
        for unit in table["jump"]
    ]
    return markdown_table("robot | unit | jump | drift in 2 s | drift per way | unanswered", rows)
