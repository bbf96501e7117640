"""``safedpa replay``: runs a recording through the services again, unchanged or with another model or margin."""

from __future__ import annotations

import json
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from safedpa.errors import InputError
from safedpa.extras import need
from safedpa_services.command_line.options import PATH, as_json_option, effects_option
from safedpa_services.plain_output import print_plain

if TYPE_CHECKING:
    from safedpa.replay.driver import ReplayedStep
    from safedpa.replay.tape import RobotTape
    from safedpa.replay.what_if import WhatIfChange
    from safedpa.safety.margins.calibration import MarginCalibration


@click.command()
@click.argument("runs", metavar="RUN...", nargs=-1, required=True, type=PATH)
@click.option("--robot", metavar="NAME", help="The robot to replay, if the recording has several.")
@click.option("--from", "begin", type=float, metavar="SECONDS", help="Compare from this robot time on.")
@click.option("--to", "end", type=float, metavar="SECONDS", help="Compare up to this robot time.")
@click.option(
    "--model", metavar="MODEL", help="What if the filter had this model (a file, or the name of a shipped one)?"
)
@click.option("--eta", type=float, metavar="X", help="What if the filter had this eta?")
@click.option(
    "--margin",
    metavar="X|FILE",
    help="What if the filter had this margin (a number, or a file from 'safedpa calibrate')?",
)
@click.option("--filtered", is_flag=True, help="What if the filter had not been switched off?")
@click.option(
    "--closed-loop", is_flag=True, help="Drive the recorded scene again in closed loop (simulated robots only)."
)
@click.option("--exact", is_flag=True, help="Require bit-identical numbers.")
@click.option("--recorded-model", default="", metavar="MODEL", help="Model for a recording without setup messages.")
@click.option("--weights", type=PATH, metavar="DIR", help="Folder with the weights of a learned model.")
@click.option(
    "--out",
    type=PATH,
    metavar="FILE",
    help="Write the replayed messages to an .mcap file; with another model, eta or margin, every tick to a .csv file.",
)
@click.option("--rrd", type=PATH, metavar="FILE", help="Write the recording for the Rerun viewer.")
@effects_option
@as_json_option
def command(**options: Any) -> int:
    """Replay a recording through the services and compare.

    The services' outputs are compared with the recorded ones, field by field. RUN is the folder of a run, or its
    recording (.mcap); several recordings are parts of one drive. Exit code 0: the outputs are equal, or another model,
    eta or margin was tried; 1: an output differs.
    """
    from safedpa.dynamics import load_user_file
    from safedpa.records.readers.table import regular_file
    from safedpa.records.store import url_of

    if options["rrd"] is not None:
        need("view", what="--rrd")
    if options["effects"] is not None:
        load_user_file(options["effects"])
    with ExitStack() as copies:
        runs = [copies.enter_context(regular_file(run)) if url_of(run) else run for run in options["runs"]]
        return _replayed({**options, "runs": tuple(runs)})


def _replayed(options: dict[str, Any]) -> int:
    """Replays recordings on this machine; returns the exit code."""
    from safedpa.replay.setups import complete_setups
    from safedpa.replay.tape import read_tape

    _check_out(options)
    change = _change(options)
    tape = read_tape(options["runs"], options["robot"])
    assumed = complete_setups(tape, options["recorded_model"])
    if options["rrd"] is not None:
        _draw(tape, options["rrd"])
    if change.is_empty and not options["closed_loop"]:
        return _compare(tape, assumed, options)
    return _what_if(tape, change, assumed, options)


def _check_out(options: dict[str, Any]) -> None:
    """Refuses an output file that a later replay of the same run would read as a part of it."""
    from safedpa.comparison.output import require_writable_folder
    from safedpa.replay.tape import files_of

    out: Path | None = options["out"]
    if out is None:
        return
    require_writable_folder(out.parent, create=True)
    folders = [run.resolve() for run in options["runs"] if run.is_dir()]
    is_input = out.resolve() in [file.resolve() for file in files_of(options["runs"])]
    if is_input or (out.suffix == ".mcap" and out.resolve().parent in folders):
        what = "a place where it would count as a recording of this run"
        raise InputError(f"--out {out}: got {what}; choose another folder")


def _window(options: dict[str, Any]) -> tuple[float, float]:
    begin = float("-inf") if options["begin"] is None else options["begin"]
    end = float("inf") if options["end"] is None else options["end"]
    if not begin <= end:
        raise InputError(f"--from {begin:g} --to {end:g}: wanted a start before the end")
    return begin, end


def _folders(options: dict[str, Any]) -> tuple[Path, ...]:
    return () if options["weights"] is None else (options["weights"],)


def _change(options: dict[str, Any]) -> WhatIfChange:
    from safedpa.dynamics import load_model
    from safedpa.replay.what_if import WhatIfChange
    from safedpa.safety.defaults import margin_for
    from safedpa.systems.robots import DEFAULT_ROBOT

    model = None if options["model"] is None else load_model(options["model"])
    margin: float | MarginCalibration | None = None
    if options["margin"] is not None:
        try:
            margin = float(options["margin"])
        except ValueError:
            of_any = model or load_model(DEFAULT_ROBOT)  # a margin from a file does not depend on the model
            margin = margin_for(of_any, options["margin"])
    return WhatIfChange(model, options["eta"], margin, options["filtered"])


def _compare(tape: RobotTape, assumed: list[str], options: dict[str, Any]) -> int:
    from safedpa.replay.replay import TOLERANCE, replay
    from safedpa.replay.report import document_of, lines_of, write_outputs
    from safedpa.replay.tape import gaps_of

    steps: list[ReplayedStep] = []
    report_progress = steps.append if options["out"] is not None else lambda _step: None
    found = replay(tape, _window(options), 0.0 if options["exact"] else TOLERANCE, _folders(options), report_progress)
    gaps = gaps_of(tape)
    if options["out"] is not None:
        write_outputs(tape, steps, options["out"])
    if options["as_json"]:
        click.echo(json.dumps(document_of(tape, found, gaps, assumed)))
    else:
        print_plain("\n".join(lines_of(tape, found, gaps, assumed)))
    return 0 if found.agrees and any(part.compared for part in found.services) else 1


def _what_if(tape: RobotTape, change: WhatIfChange, assumed: list[str], options: dict[str, Any]) -> int:
    from safedpa.replay.report import note_lines, what_if_document, what_if_lines, write_decisions
    from safedpa.replay.what_if import summary_of, what_if

    decisions = what_if(tape, change, _window(options), _folders(options))
    summary, changed = summary_of(decisions), _change_text(options)
    if options["out"] is not None:
        write_decisions(decisions, options["out"])
    driven: dict[str, Any] | None = None
    if options["closed_loop"]:
        from safedpa_sim.recorded_drive import drive_again

        driven = drive_again(tape, change, _folders(options))
    if options["as_json"]:
        document = what_if_document(summary, decisions, changed) | {"assumed": assumed}
        document["findings"] = [asdict(finding) for finding in tape.findings]
        click.echo(json.dumps(document if driven is None else document | {"closed_loop": driven}))
        return 0
    print_plain(f"robot '{tape.robot}' from {', '.join(str(path) for path in tape.files)}")
    print_plain("\n".join([*note_lines(tape, assumed), *what_if_lines(summary, decisions, changed)]))
    if driven is not None:
        click.echo("\n".join(_driven_lines(driven)))
    return 0


def _change_text(options: dict[str, Any]) -> str:
    given = [f"{name} {options[name]}" for name in ("model", "eta", "margin") if options[name] is not None]
    given += ["the filter on"] if options["filtered"] else []
    return ", ".join(given) or "nothing changed"


def _driven_lines(driven: dict[str, Any]) -> list[str]:
    lines = [f"  driven again in closed loop ({driven['robot']}), {driven['ticks']} ticks: recorded, now"]
    for name, (then, now) in driven["compared"].items():
        lines.append(f"    {name:<28} {then}   {now}")
    apart = driven["apart_from_tick"]
    lines.append("    the drive is identical" if apart is None else f"    the states differ from tick {apart} on")
    return lines


def _draw(tape: RobotTape, path: Path) -> None:
    from safedpa.replay.setups import model_of_document
    from safedpa.safety.settings import parse_settings
    from safedpa_services.dashboard.dashboard import draw_recording
    from safedpa_services.dashboard.display_settings import display_settings

    filters = tape.setups.get("safety_filter", [])
    if not filters:
        raise InputError("--rrd: got a recording without the setup of a safety filter, which the drawing needs")
    setup = filters[0][1]
    model, settings = model_of_document(setup.document), parse_settings(setup.settings)
    draw_recording(tape.files, display_settings(model, settings), path)
    click.echo(f"{path}: open it with 'rerun {path}'", err=True)
