"""``safedpa diagnose``: finds out which physical effect a model lacks."""

from __future__ import annotations

import json
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
)

if TYPE_CHECKING:
    from safedpa.api.diagnosing import Diagnosis


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
    from safedpa.api.planning import check_data

    if not runs:
        raise InputError("--check: got no runs; wanted recordings of a robot")
    found = check_data(model, runs, columns=options["columns"], effects=options["effects"])
    click.echo(json.dumps(found.to_dict(), allow_nan=False) if options["as_json"] else str(found))


def _diagnose(model: str, runs: tuple[str, ...], options: dict[str, Any]) -> None:
    """Diagnoses one robot: reads the runs, searches, writes the report, prints the result."""
    from safedpa.api.diagnosing import diagnose
    from safedpa.comparison.output import new_folder

    given = {name: options[name] for name in ("columns", "horizon", "effects", "force")}
    found = diagnose(model, runs, **given, out=options["out"] or new_folder("diagnose", model))
    if options["as_json"]:
        click.echo(json.dumps(found.to_dict(), allow_nan=False))
    else:
        _show(found)


def _show(found: Diagnosis) -> None:
    from safedpa.report.diagnosis_lines import story_lines
    from safedpa_services.terminal import terminal

    console = terminal(highlight=False, soft_wrap=True)
    console.print()
    for line, style in story_lines(found.report):
        console.print(line, style=style, markup=False)
    saved = found.saved
    assert saved is not None, "the command always writes its files"
    console.print(f"Report: {saved.folder / 'report.html'}  model: {saved.folder / 'model.toml'}", markup=False)
    if saved.margin.notice:
        console.print(saved.margin.notice, markup=False)
    if saved.drive is not None:
        console.print(f"To drive with it: {saved.drive}", markup=False)
    elif saved.margin.path is not None:
        console.print(f"Not offered for driving: the verdict is {found.verdict}, so the model may fail elsewhere.")
