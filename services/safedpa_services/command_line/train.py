"""``safedpa train``: trains the learned model of a robot, or tunes one on recorded runs."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from safedpa.dynamics import load_user_file_everywhere
from safedpa.errors import InputError
from safedpa.extras import needs
from safedpa.systems.robots import robot_named, robots
from safedpa_services.command_line.names import SuggestingChoice, complete_robots
from safedpa_services.command_line.options import PATH, as_json_option

if TYPE_CHECKING:
    from safedpa_sim.training.configuration import Configuration


@click.command()
@click.argument("robot", shell_complete=complete_robots)
@click.argument("runs", nargs=-1, type=PATH, metavar="[RUN...]")
@click.option("--robot-file", type=PATH, metavar="FILE.py", help="a robot of your own; the file is executed")
@click.option("--configuration", "source", metavar="FILE", help="training configuration, or the name of a shipped one")
@click.option(
    "--model",
    metavar="MODEL.toml",
    help="simulate this model, from `safedpa diagnose` for example; its effects are added to e",
)
@click.option(
    "--small", is_flag=True, help="run every phase within seconds, as a demonstration; the result cannot drive"
)
@click.option(
    "--out", type=click.Path(path_type=Path, file_okay=False), help="folder; default: learned/ROBOT or learned/NAME"
)
@click.option("--phases", metavar="NAME,NAME,...", help="phases to run; default: all of the robot's")
@click.option("--pairs", type=click.IntRange(min=1), help="state-action pairs of phase 1a")
@click.option("--seed", type=click.IntRange(min=0), help="seed of all random numbers")
@click.option("--device", default="cpu", show_default=True, help="cpu or cuda")
@click.option("--tune", is_flag=True, help="only tune WEIGHTS on the recorded RUNs")
@click.option("--weights", type=click.Path(path_type=Path, dir_okay=False), help="with --tune: weights to tune")
@click.option("--columns", type=click.Path(path_type=Path, dir_okay=False), help="with --tune: column map of the runs")
@click.option(
    "--what", type=SuggestingChoice(["all", "phi", "heads"]), default="all", show_default=True, help="with --tune"
)
@as_json_option
@needs("train")
def command(robot: str, runs: tuple[Path, ...], out: Path | None, as_json: bool, **options: Any) -> None:
    """Train or tune the learned model of a robot.

    Phases: 1a, environment encoder and control-affine dynamics; 1b, policy; 2, history encoder; 3, tuning on a little
    data of the real robot; ablations: Fix, Mix and RMA-P. A robot of your own has phases 1a and 2; it needs a FRAME and
    a configuration. Phases that are done with the same configuration are skipped; an interrupted phase is resumed.
    """
    if options["robot_file"] is not None:
        load_user_file_everywhere(options["robot_file"])
    robot = robot_named(robot).name
    out = Path("learned") / _folder(robot, options["source"]) if out is None else out
    _check(runs, options)
    configuration = _configuration(robot, options)
    with _progress() as report_progress:
        result = _result(configuration, runs, out, options, report_progress)
    for warning in _warnings(result):
        click.echo(f"warning: {warning}", err=True)
    if as_json:
        click.echo(json.dumps(result))
    elif not options["tune"]:
        _report(result, out)
    else:
        times = ", ".join(f"{name} {value:.1f} times" for name, value in result.get("times_better", {}).items())
        click.echo(f"{out}: tuned on {len(runs)} runs; held-out error lower: {times}")


def _folder(robot: str, source: str | None) -> str:
    """Returns the folder's name: another shipped configuration does not overwrite the robot's own results."""
    from safedpa_sim.training.configuration import configurations

    return source if source in configurations() else robot


def _warnings(result: dict[str, Any]) -> list[str]:
    """Returns the warnings of all phases."""
    records = [result, *(record for record in result.values() if isinstance(record, dict))]
    corrected = [record["mended_simulator"] for record in records if isinstance(record.get("mended_simulator"), dict)]
    return [item["warning"] for item in corrected if "warning" in item]


def _check(runs: tuple[Path, ...], options: dict[str, Any]) -> None:
    """Raises InputError for conflicting options."""
    if options["small"] and options["source"]:
        raise InputError("--small, --configuration: got both, wanted one; --small is a configuration itself")
    if options["tune"]:
        if not runs or options["weights"] is None:
            raise InputError("--tune: wanted RUN... and --weights FILE: the weights to tune, and the recorded runs")
    elif runs or options["weights"] or options["columns"]:
        raise InputError("RUN, --weights, --columns: got them without --tune; add --tune, or leave them out")


def _configuration(robot: str, options: dict[str, Any]) -> Configuration:
    from dataclasses import replace

    from safedpa_sim.training.configuration import configurations, load_configuration

    source = options["source"] or (f"{robot}_small" if options["small"] else robot)
    if options["small"] and source not in configurations():
        small = sorted(name for name in robots() if f"{name}_small" in configurations())
        raise InputError(
            f"--small: got it for {robot}, available for {', '.join(small)}; use --configuration FILE with short phases"
        )
    configuration = load_configuration(source)
    if configuration.robot != robot:
        raise InputError(f"{source}: got a simulator of robot '{configuration.robot}', wanted '{robot}'")
    if options["model"] is not None:
        from safedpa.dynamics import load_model
        from safedpa_sim.training.configuration import with_diagnosed

        configuration = with_diagnosed(configuration, load_model(options["model"]))
    if options["pairs"] is not None:
        phase = replace(configuration.phase_1a, pairs=options["pairs"])
        configuration = replace(configuration, phase_1a=phase)
    return configuration if options["seed"] is None else replace(configuration, seed=options["seed"])


def _result(
    configuration: Configuration,
    runs: tuple[Path, ...],
    out: Path,
    options: dict[str, Any],
    report_progress: Callable[[str, int, int, str], None],
) -> dict[str, Any]:
    from safedpa_sim.training.pipeline import run_pipeline, stages_of, tune_on_runs

    if options["tune"]:
        chosen = (options["weights"], list(runs), options["columns"], out, options["what"])
        return tune_on_runs(configuration, *chosen, report_progress)
    given = options["phases"]
    phases = [] if given is None else [name.strip() for name in given.split(",") if name.strip()]
    if given is not None and not phases:
        raise InputError(f"--phases: got none, wanted one or more of {', '.join(stages_of(configuration.robot))}")
    return run_pipeline(configuration, out, phases, report_progress, options["device"])


@contextmanager
def _progress() -> Iterator[Callable[[str, int, int, str], None]]:
    """Yields ``report_progress(phase, done, total, note)``, which shows one progress bar per phase on a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskID, TaskProgressColumn, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda _phase, _done, _all, _note: None
        return
    title, note = TextColumn("train {task.description}"), TextColumn("{task.fields[note]}")
    with Progress(title, BarColumn(), TaskProgressColumn(), TimeRemainingColumn(), note, console=console) as bar:
        tasks: dict[str, TaskID] = {}

        def report_progress(phase: str, done: int, everything: int, note: str) -> None:
            if phase not in tasks:
                tasks[phase] = bar.add_task(phase, note="")
            bar.update(tasks[phase], completed=done, total=everything, note=note)

        yield report_progress


def _report(records: dict[str, Any], out: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, padding=(0, 2, 0, 0))
    for name in ("phase", "seconds", "loss", "explained"):
        justify: Literal["left", "right"] = "right" if name in ("seconds", "loss") else "left"
        table.add_column(name, justify=justify, no_wrap=name != "explained")
    for phase, record in records.items():
        seconds = "skipped" if record.get("skipped") else f"{record['seconds']:.1f}"
        table.add_row(phase, seconds, _loss(record), _explained(record))
    console = Console(highlight=False)
    console.print(table)
    console.print(f"Weights, model files and progress.json are in {out}", markup=False, soft_wrap=True)


def _loss(record: dict[str, Any]) -> str:
    return f"{record['loss']:.2e}" if "loss" in record else ""


def _explained(record: dict[str, Any]) -> str:
    explained = record.get("explained", ())
    names = record.get("states") or [f"latent_{index}" for index in range(len(explained))]
    shares = zip(names, explained, strict=True)
    return ", ".join(f"{name} {100 * share:.2f} %" for name, share in shares)
