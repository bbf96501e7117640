"""Pictures that teach how to read a diagnosis: of real logs, and of one simulated drive over a carpet."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from safedpa.diagnosis.diagnose import diagnose
from safedpa.diagnosis.identifiability.check import IdentifiabilityCheck, check_identifiability
from safedpa.diagnosis.identifiability.rehearsal import RehearsalResult, rehearse_diagnosis
from safedpa.diagnosis.report_schema import Report
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.errors import InputError
from safedpa.records import load_run
from safedpa.records.run import Run, Stretch
from safedpa_lab.experiments.common.figures import BLUE, GREEN, GREY, ORANGE, bare, figure, heading
from safedpa_lab.experiments.diagnosis.real_logs_data import CAR, PENDULUM, mapped_runs, paths_of
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent
from safedpa_lab.hidden import Case, write_case

if TYPE_CHECKING:
    from matplotlib.axes import Axes


PICTURES = ("missing", "undecided", "rehearse", "condition")
"""Files are called diagnosis_{name}.png."""
_SHORT = 12.0
"""s of a drive that is too short."""
_REHEARSED = ("coulomb_friction", "tip_mass", "torque_delay")
_SIZES = (0.3, 1.0)
"""Of an ordinary change."""
_CARPET = {"deceleration": 0.9, "x_above": 1.0}
_SIMULATED = "four simulated drives of 40 s, seed 7; dashed: where the carpet begins; coloured: where it was found"
_DECIDED = {"accepted": GREEN, "suspected": ORANGE, "rejected": GREY}


def diagnosis_pictures(
    data: Path, out: Path, names: Sequence[str] = PICTURES, report_progress: ReportProgress = silent
) -> list[Path]:
    """Draws the named pictures into a folder; ``data`` holds the recordings of docs/evidence/diagnosis.md.

    Raises InputError where those are not there.
    """
    drawn = []
    for number, name in enumerate(names):
        report_progress(number, len(names))
        path = out / f"diagnosis_{name}.png"
        {"missing": _missing, "undecided": _undecided, "rehearse": _rehearse, "condition": _condition}[name](data, path)
        drawn.append(path)
    report_progress(len(names), len(names))
    return drawn


def _runs(data: Path, pattern: str, model: str) -> tuple[PhysicsModel, list[Run]]:
    paths = paths_of(data, pattern)
    if not paths:
        raise InputError(f"{data}: found no {pattern}; name the folder of the recordings of docs/evidence/diagnosis.md")
    loaded = load_model(model)
    return loaded, mapped_runs(paths, loaded, f"{model}_columns")


def _missing(data: Path, path: Path) -> None:
    """What a real pendulum lacks: every candidate with its error, and the model stage after stage."""
    model, runs = _runs(data, PENDULUM, "dfki_pendulum")
    report = diagnose(model, runs, 0.4)
    with figure(path, 3.2) as drawn:
        left, right = drawn.subplots(1, 2, width_ratios=(3, 2))
        _candidates(left, report)
        errors = [stage.heldout_error for stage in report.stages]
        names = ["given", *(f"+ {name.replace('_', ' ')}" for name in report.added)]
        bars = right.bar(names, errors, color=[GREY, *([GREEN] * len(report.added))], width=0.55)
        right.bar_label(bars, [f"{value:.3f}" for value in errors], padding=2, fontsize=8)
        right.set_ylabel("held-out error after 0.4 s")
        bare(right)
        heading(drawn, "A real pendulum: what does its model lack?", "six logs, torque-limited pendulum of DFKI")


def _candidates(axes: Axes, report: Report) -> None:
    """Gain on unseen blocks of every candidate of the first stage."""
    tried = [
        item for item in report.candidates if item.stage == 0 and item.score is not None and "+" not in item.effect
    ]
    tried = sorted(tried, key=lambda item: item.score or 0.0)
    names = [item.effect.replace("_", " ") for item in tried]
    axes.barh(names, [item.score or 0.0 for item in tried], color=[_DECIDED[item.decision] for item in tried])
    axes.axvline(3.0, color=BLUE, linewidth=1.2)
    axes.text(2.9, 0.0, "3: asked for", color=BLUE, fontsize=8, ha="right", va="center")
    axes.set_xlabel("gain on unseen blocks, standard errors (green: accepted)")
    bare(axes)


def _undecided(data: Path, path: Path) -> None:
    """Twelve seconds of a drive against four whole drives: the smallest sizes that each could show."""
    model, runs = _runs(data, CAR, "dart_car")
    first = runs[0]
    begin = first.stretches[0].start
    stop = min(begin + round(_SHORT / first.period), first.stretches[0].stop)
    short = replace(first, stretches=(Stretch(begin, stop),))
    with figure(path, 3.8) as drawn:
        axes = drawn.subplots()
        shown = _sizes(
            axes, check_identifiability(model, [short]), ORANGE, "o", f"{_SHORT:.0f} s of one drive: undecided"
        )
        _sizes(axes, check_identifiability(model, runs), BLUE, "s", "four whole drives", shown)
        axes.axvline(1.0, color=GREY, linewidth=1.0)
        axes.set_xscale("log")
        axes.set_xlabel("smallest size that would be found, as a share of an ordinary one; at the right edge: none")
        axes.legend(loc="upper right", fontsize=8)
        bare(axes)
        heading(
            drawn, "What could these logs show? (diagnose --check)", "a real car; left of 1 an ordinary effect is seen"
        )


def _sizes(
    axes: Axes, check: IdentifiabilityCheck, colour: str, marker: str, label: str, order: Sequence[str] | None = None
) -> list[str]:
    """One point for each number, at its smallest size; the names in the order drawn."""
    most = 30.0
    sizes = {
        f"{item.effect.replace('_', ' ')}: {item.parameter}": most
        if item.smallest is None
        else min(item.smallest / item.ordinary, most)
        for item in check.sizes
    }
    names = list(order) if order is not None else sorted(sizes, key=lambda name: -sizes[name])
    there = [name for name in names if name in sizes]
    axes.plot([sizes[name] for name in there], there, marker, color=colour, label=label, markersize=4.5)
    axes.tick_params(axis="y", labelsize=6.5)
    return names


def _rehearse(data: Path, path: Path) -> None:
    """What a rehearsal promised of the pendulum's own commands, and what a diagnosis of the simulated logs found."""
    model, runs = _runs(data, PENDULUM, "dfki_pendulum")
    found: RehearsalResult = rehearse_diagnosis(model, runs, _SIZES, _REHEARSED)
    with figure(path, 2.2) as drawn:
        axes = drawn.subplots()
        rows = list(dict.fromkeys(f"{item.effect.replace('_', ' ')}: {item.parameter}" for item in found.trials))
        for item in found.trials:
            row = rows.index(f"{item.effect.replace('_', ' ')}: {item.parameter}")
            face = GREEN if item.found else "white"
            marker = "s" if item.predicted else "o"
            axes.plot(item.size, row, marker, markerfacecolor=face, markeredgecolor=GREEN, markersize=10)
        axes.set_yticks(range(len(rows)), rows)
        axes.set_ylim(-0.6, len(rows) - 0.4)
        axes.set_xscale("log")
        axes.set_xlabel("hidden size, in the number's unit; square: predicted to be found, filled: found")
        bare(axes)
        heading(drawn, f"A rehearsal: {found.agreeing} of {len(found.trials)} predictions hold")


def _condition(_data: Path, path: Path) -> None:
    """A carpet beyond a line: the way driven, and the border that the diagnosis found."""
    case = Case("pictures", 7, {"rolling_resistance": _CARPET}, laws={"rolling_resistance": "where x above"}, runs=4)
    with tempfile.TemporaryDirectory() as folder:
        log = write_case(case, Path(folder))
        model = load_model(log.model)
        runs = [load_run(one, model.system) for one in log.runs]
    report = diagnose(model, runs, 1.0)
    (reported,) = report.conditions
    border = report.parameters["rolling_resistance.x_above"]
    with figure(path, 3.6) as drawn:
        left, right = drawn.subplots(1, 2, width_ratios=(3, 2))
        for run in runs:
            left.plot(run.states[:, 0], run.states[:, 1], color=GREY, linewidth=0.7)
        left.axvspan(border.value, max(float(run.states[:, 0].max()) for run in runs), color=ORANGE, alpha=0.25)
        left.axvline(_CARPET["x_above"], color=BLUE, linestyle="--", linewidth=1.0)
        left.set_xlabel("x [m]")
        left.set_ylabel("y [m]")
        left.set_aspect("equal")
        bare(left)
        errors = [stage.heldout_error for stage in report.stages]
        bars = right.bar(["given", "with the carpet"], errors, color=[GREY, GREEN], width=0.55)
        right.bar_label(bars, [f"{value:.3f}" for value in errors], padding=2, fontsize=8)
        right.set_ylabel("held-out error after 1 s")
        bare(right)
        heading(drawn, reported.sentence[0].upper() + reported.sentence[1:], _SIMULATED)


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment diagnosis-pictures``. Raises InputError for a folder that does not exist."""
    for name in ("data", "out"):
        if not options[name].is_dir():
            raise InputError(f"--{name} {options[name]}: got no folder that exists; make it, or name another one")
    drawn = diagnosis_pictures(options["data"], options["out"], options["names"] or PICTURES, report_progress)
    return {"pictures": [str(path) for path in drawn]}


def report(result: Result) -> str:
    """The files, one per line."""
    return "\n".join(result["pictures"])
