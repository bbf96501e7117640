"""``safedpa diagnose``: finds out which physical effect a model lacks."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from safedpa.errors import InputError
from safedpa.extras import needs
from safedpa_services.command_line.fleet_diagnosis import fleet_options, run_fleet_diagnosis, wants_fleet
from safedpa_services.command_line.names import complete_models
from safedpa_services.command_line.options import (
    as_json_option,
    columns_option,
    effects_option,
    folder_option,
    force_option,
    horizon_option,
    inputs_of,
    load_given_model,
    load_runs,
    value_text,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from safedpa.api.deployment import CalibratedMargin
    from safedpa.diagnosis.report_schema import Report
    from safedpa.records.run import Run

__all__ = ["command", "story_lines"]

WRITTEN = ("report.json", "report.html", "diagnosis.rrd", "model.toml", "margin.toml")
"""Files that a diagnosis writes."""
BAR = 40
"""Characters of the longest bar."""
ROWS = 60_000
"""Evenly spread rows for the margin's calibration. Limited because the actuator state is simulated along each of
them."""
WORSE = 3
"""Number of states that got worse that are printed; the report lists all."""
FINDINGS = 6
"""Number of findings about the data that are printed; the report lists all."""


@click.command(name="diagnose")
@click.argument("model", shell_complete=complete_models)
@click.argument("runs", metavar="RUN...", nargs=-1)
@columns_option
@horizon_option()
@effects_option
@as_json_option
@folder_option("report.json, report.html, diagnosis.rrd, model.toml and margin.toml")
@click.option(
    "--check", is_flag=True, help="Only report which effects these runs could show; takes seconds, writes nothing."
)
@force_option
@fleet_options
@needs("diagnosis")
def command(model: str, runs: tuple[str, ...], **options: Any) -> int:
    """Find out from recorded RUNs which effect MODEL lacks.

    Fits every effect of the library, alone and in pairs, and adds those that improve the prediction of held-out data.
    Also reports if nothing is missing, if the data cannot distinguish effects, and if no effect explains the remaining
    error.

    With --check: reports within seconds which effects these runs could show, and from which size on, without a search.

    With --fleet FOLDER, or runs of many robots and --by: diagnoses each robot and reports which effect is missing in
    which robots. Writes fleet.html, fleet.json and a folder for each robot; robots that are done are skipped.
    """
    if options["check"]:
        _check(model, runs, options)
        return 0
    if wants_fleet(options["fleet"], options["by"]):
        return run_fleet_diagnosis(model, runs, **options)
    unused = [name for name in ("jobs", "ray") if options[name] is not None] + ["again"] * options["again"]
    if unused:
        raise InputError(f"--{unused[0]}: got no fleet; name its folder with --fleet, or say what a robot is with --by")
    if not runs:
        raise InputError("runs: got none; wanted recordings of a robot, or --fleet FOLDER")
    _diagnose(model, runs, options)
    return 0


def _check(model: str, runs: tuple[str, ...], options: dict[str, Any]) -> None:
    """Reports which effects the runs could show."""
    from safedpa.diagnosis.identifiability.check import as_document, check_identifiability, check_lines
    from safedpa.progress import progress

    if not runs:
        raise InputError("--check: got no runs; wanted recordings of a robot")
    loaded = load_given_model(model, options["effects"])
    recorded = load_runs(loaded, runs, options["columns"])
    with progress("checking"):
        found = check_identifiability(loaded, recorded)
    if options["as_json"]:
        click.echo(json.dumps(as_document(found), allow_nan=False))
    else:
        click.echo("\n".join(check_lines(found)))


def _diagnose(model: str, runs: tuple[str, ...], options: dict[str, Any]) -> None:
    """Diagnoses one robot: reads the runs, searches, writes the report, prints the result."""
    from safedpa.comparison.output import results_folder
    from safedpa.diagnosis.diagnose import diagnose
    from safedpa.diagnosis.report_schema import as_document
    from safedpa.progress import progress, progress_with_notes

    loaded = load_given_model(model, options["effects"])
    read = inputs_of(model, runs, options["columns"], options["effects"])
    with results_folder(options["out"], "diagnose", model, WRITTEN, read, options["force"]) as out:
        recorded = load_runs(loaded, runs, options["columns"])
        with progress_with_notes("diagnosing") as narrate:
            report = diagnose(loaded, recorded, options["horizon"], narrate)
        document = as_document(report)
        with progress("writing") as report_progress:
            report_progress(0, 2)
            _write(document, report, recorded, out, Path(model).stem)
            report_progress(1, 2)
            margin = _margin(report, recorded, out)
    if options["as_json"]:
        facts = _margin_document(report, out, margin, options["effects"])
        click.echo(json.dumps({**document, "margin": facts}, allow_nan=False))
    else:
        _show(report, out, margin, options["effects"])


def _margin(report: Report, runs: Sequence[Run], out: Path) -> CalibratedMargin:
    """Calibrates the filter's margin for the diagnosed model; none if the data allowed no verdict."""
    from safedpa.api.deployment import CalibratedMargin, calibrate_margin_file
    from safedpa.comparison.excerpt import subsample_runs

    path = out / "margin.toml"
    judged = report.verdict != "unexplained" if report.unexplained is None else report.unexplained.depends_on
    if not judged:
        path.unlink(missing_ok=True)  # a margin of an earlier diagnosis is for another model
        return CalibratedMargin()
    return calibrate_margin_file(report.models[-1], runs, path, lambda some: subsample_runs(some, ROWS, report.horizon))


def _margin_document(report: Report, out: Path, margin: CalibratedMargin, own: Path | None) -> dict[str, Any]:
    """Returns the margin's file and step [s] (None: no margin), a notice about it, and the command to drive with it."""
    from safedpa.api.deployment import drive_command

    document: dict[str, Any] = {"file": None, "period": None, "notice": margin.notice, "drive": None}
    if margin.path is not None:
        drive = drive_command(report.models[-1], out / "model.toml", margin.path, own, margin.period)
        document |= {"file": str(margin.path), "period": margin.period, "drive": drive}
    return document


def _write(document: dict[str, Any], report: Report, runs: list[Run], out: Path, title: str) -> None:
    from safedpa.dynamics import LearnedBase, save_model, write_model
    from safedpa.records.writers.tables import atomic_path
    from safedpa.report.diagnosis_page import write_report
    from safedpa.report.diagnosis_recording import write_recording

    texts = {"report.json": json.dumps(document, allow_nan=False, indent=1) + "\n"}
    if isinstance(report.models[-1].base, LearnedBase):
        save_model(report.models[-1], out / "model.toml")  # writes the weights, too
    else:
        texts["model.toml"] = write_model(report.models[-1])
    for name, text in texts.items():
        with atomic_path(out / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
    write_report(document, runs, report.models, out, title)
    write_recording(document, runs, report.models, out)


def _show(report: Report, out: Path, margin: CalibratedMargin, own: Path | None) -> None:
    from safedpa_services.terminal import terminal

    console = terminal(highlight=False, soft_wrap=True)
    console.print()
    for line, style in story_lines(report):
        console.print(line, style=style, markup=False)
    console.print(f"Report: {out / 'report.html'}  model: {out / 'model.toml'}", markup=False)
    facts = _margin_document(report, out, margin, own)
    if facts["notice"]:
        console.print(facts["notice"], markup=False)
    if facts["drive"] is not None:
        console.print(f"To drive with it: {facts['drive']}", markup=False)


def story_lines(report: Report) -> list[tuple[str, str]]:
    """Returns the diagnosis as lines with styles: verdict, largest error, missing effects, rest, next drive."""
    from safedpa.diagnosis.report_schema import as_document
    from safedpa.report.diagnosis_story import report_text
    from safedpa.report.undecided_story import closest_rows

    story = report_text(as_document(report))
    lines = [(_verdict(report, story.lead), "bold")]
    worst = next((item for item in report.where if math.isfinite(item["ratio"])), None)
    if worst is not None:
        unit = "" if worst["unit"] == "1" else f" {worst['unit']}"
        place = f"{worst['variable']} {worst['low']:.3g} to {worst['high']:.3g}{unit}"
        lines.append((f"Worst at {place}: {worst['ratio']:.1f} times the average error.", ""))
    lines += [(f"  {line}", "green") for line in _found(report)]
    lines += _bars(report)
    for lost in report.worse[:WORSE]:
        text = f"  {lost.state} got worse in {lost.run}: {lost.before:.3g} to {lost.after:.3g}, though the mean fell"
        lines.append((text, "yellow"))
    lines += [
        (f"  Cannot be distinguished: {name} and {', '.join(others)}.", "yellow") for name, others in _groups(report)
    ]
    if report.unexplained is not None and report.unexplained.depends_on:
        lines.append((story.remains, "yellow"))
        lines.append((f"  {story.formula_title}: {report.unexplained.expression}", "yellow"))
        lines.append((f"  {story.formula_note}", "dim"))
    for effect, numbers, fall, drive in closest_rows(as_document(report)):
        off = f"; would reduce the error by {fall}" if fall else ""
        lines.append((f"  Likely, not proven: {effect} ({numbers}{off})", "yellow"))
        lines += [(f"    To find out, drive: {drive}.", "cyan")] if drive else []
    if report.next_experiment is not None:
        item = report.next_experiment
        lines.append((f"Next: {item.manoeuvre}; {item.why}.", "cyan"))
    messages = list(dict.fromkeys(str(item["message"]) for item in report.data_quality))
    lines += [(f"  data: {message}", "dim") for message in messages[:FINDINGS]]
    return lines


def _verdict(report: Report, lead: str) -> str:
    if report.verdict == "unexplained" and report.unexplained is not None and not report.unexplained.depends_on:
        return f"No verdict: {report.unexplained.expression}."
    if report.verdict == "unexplained" and report.added:
        return f"No verdict: the model predicts badly with every effect added ({', '.join(report.added)} fit best)."
    return lead


def _found(report: Report) -> list[str]:
    lines = []
    for name in report.added:
        own = {path.split(".")[1]: item for path, item in report.parameters.items() if path.split(".")[0] == name}
        lines.append(f"{name}: {', '.join(value_text(key, item) for key, item in own.items())}")
        lines += [f"  {item.sentence}" for item in report.conditions if item.effect == name]
    return lines


def _bars(report: Report) -> list[tuple[str, str]]:
    first = report.stages[0].heldout_error
    lines = []
    for number, stage in enumerate(report.stages):
        before = report.stages[number - 1].effects if number else ()
        name = " ".join(f"+ {own}" for own in stage.effects if own not in before) or "given model"
        length = round(BAR * min(stage.heldout_error / first, 1.0)) if first > 0 else 0
        runs = f" ({stage.runs_improved} runs better)" if stage.runs_improved else ""
        lines.append((f"  {name:24.24} {'█' * length:{BAR}} {stage.heldout_error:.3g}{runs}", ""))
    return lines


def _groups(report: Report) -> list[tuple[str, tuple[str, ...]]]:
    ambiguous = [item for item in report.candidates if item.decision == "accepted" and item.indistinguishable_from]
    return [(item.effect, item.indistinguishable_from) for item in ambiguous]
