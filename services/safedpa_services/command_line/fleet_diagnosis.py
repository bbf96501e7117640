"""``safedpa diagnose`` for a fleet: which effect is missing in which robots."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from safedpa.errors import InputError
from safedpa_services.command_line.names import SuggestingChoice
from safedpa_services.command_line.options import PATH

if TYPE_CHECKING:
    from safedpa.fleet import DiscoveredRobots, Workers


Command = TypeVar("Command", bound=Callable[..., Any])
Job = TypeVar("Job")
Answer = TypeVar("Answer")

LOCAL = "local"
"""Address that makes the command start a local Ray instance."""
_NAMES = 8
"""Number of robots of a group whose names are printed; fleet.json lists all."""


def fleet_options(command: Command) -> Command:
    """Adds --fleet, --by, --jobs, --ray and --again, in this order on the help page."""
    for option in (
        click.option(
            "--again", is_flag=True, help="For a fleet: diagnose all robots again, including those that are done."
        ),
        click.option(
            "--ray",
            is_flag=False,
            flag_value=LOCAL,
            metavar="[ADDRESS]",
            help="For a fleet: use the Ray cluster at ADDRESS ('auto': the one of this machine); without "
            "ADDRESS a local instance.",
        ),
        click.option(
            "--jobs", type=int, metavar="N", help="For a fleet: number of robots at a time; default: one per core."
        ),
        click.option(
            "--by",
            type=SuggestingChoice(["auto", "folder", "file", "robot"]),
            default="auto",
            show_default=True,
            help="What makes a robot of a fleet: a folder of recordings, a file, or a name inside MCAP recordings.",
        ),
        click.option(
            "--fleet",
            type=PATH,
            metavar="FOLDER",
            help="Diagnose every robot with recordings in FOLDER, such as FOLDER/ROBOT/*.csv, and compare the robots.",
        ),
    ):
        command = option(command)
    return command


def wants_fleet(fleet: Path | None, by: str) -> bool:
    """Whether the options ask for a diagnosis of a fleet: --fleet, or runs and --by."""
    return fleet is not None or by != "auto"


def run_fleet_diagnosis(model: str, runs: Sequence[str], **options: Any) -> int:
    """Diagnoses a fleet and prints the result; returns exit code 0.

    Raises InputError if no robot's recordings can be used.
    """
    from safedpa.api.inputs import files_of
    from safedpa.comparison.output import new_folder, results_folder
    from safedpa.fleet import Fleet, Options, diagnose_fleet
    from safedpa.progress import progress
    from safedpa.records.store import url_of

    given: Path | None = options["out"]
    effects: Path | None = options["effects"]
    if effects is not None:
        from safedpa.dynamics import load_user_file_everywhere

        load_user_file_everywhere(effects)
    if given is not None and options["fleet"] is not None and _place(given) == _place(options["fleet"]):
        raise InputError(f"--out {given}: got the folder of the recordings; choose another folder for the results")
    found = _found(runs, options)
    read = files_of(model, [file for robot in found.robots for file in robot.files], effects)
    columns = _absolute(options["columns"]) if options["columns"] else None
    own = str(effects.resolve()) if effects else None
    known = Options(_absolute(model), columns, options["horizon"], own)
    written = "fleet.html", "fleet.json"
    place = given or new_folder("fleet", model)
    with (
        nullcontext(place)
        if url_of(place)  # which needs no folder, and has no inputs of this command
        else results_folder(place, written, read, options["force"], resumes=True) as out,
        progress(f"diagnosing {len(found.robots)} robots") as report_progress,
    ):
        fleet = Fleet(found, known, _place(out))
        document = diagnose_fleet(fleet, _workers(options), report_progress, again=options["again"])
    if options["as_json"]:
        click.echo(json.dumps(document, allow_nan=False))
    else:
        _show(document, out)
    usable = document["counts"]
    if usable["unreadable"] == len(document["robots"]):
        reason = document["robots"][0]["reason"]
        raise InputError(f"no robot's recordings can be used; the first robot's: {reason}")
    return 0


def _absolute(name: str) -> str:
    """Returns the full path of a file, for workers with another working directory; names of shipped ones unchanged."""
    return str(Path(name).resolve()) if Path(name).is_file() else name


def _place(folder: Path) -> Path:
    """Returns the full path of a folder; a URL unchanged."""
    from safedpa.records.store import url_of

    return folder if url_of(folder) else folder.resolve()


def _found(runs: Sequence[str], options: dict[str, Any]) -> DiscoveredRobots:
    from safedpa.fleet import robots_in_folder, robots_of_files

    fleet: Path | None = options["fleet"]
    if fleet is None:
        return robots_of_files([Path(run) for run in runs], options["by"])
    if runs:
        raise InputError(f"--fleet {fleet}: got it together with runs ({runs[0]}); leave one of them out")
    return robots_in_folder(_place(fleet), options["by"])


def _workers(options: dict[str, Any]) -> Workers:
    """Returns the function that runs the jobs: in processes of this machine, or on a cluster."""
    jobs: int | None = options["jobs"]
    if jobs is not None and jobs < 1:
        raise InputError(f"--jobs: got {jobs}, wanted at least 1")
    return partial(_run, jobs, options["ray"])


def _run(
    jobs: int | None,
    cluster: str | None,
    work: Callable[[Job], Answer],
    items: Sequence[Job],
    failed: Callable[[Job, str], Answer],
) -> Iterator[Answer]:
    from safedpa.fleet.workers import available_cores, in_processes, on_cluster

    if cluster is None:
        return in_processes(work, items, min(jobs or available_cores(), max(1, len(items))), failed)
    return on_cluster(work, items, cluster, failed, jobs) if items else iter(())


def _show(document: dict[str, Any], out: Path) -> None:
    from safedpa.fleet.summary import common_sentence, discovery_sentence, headline
    from safedpa.records.store import url_of
    from safedpa_services.terminal import terminal

    console = terminal(highlight=False)
    console.print()
    console.print(headline(document), style="bold", markup=False, soft_wrap=True)
    console.print(_table(document))
    common = common_sentence(document)
    if common:
        console.print(common, style="green", markup=False, soft_wrap=True)
    for item in document["odd"]:
        console.print(f"{item['robot']} does not fit: {item['times']:.1f} times the fleet's error with every effect.",
                      style="yellow", markup=False)  # fmt: skip
    for robot in document["robots"]:
        if robot["kind"] in ("unreadable", "failed", "no_verdict"):
            console.print(f"  {robot['robot']}: {robot['reason']}", style="dim", markup=False, soft_wrap=True)
        elif robot["unreadable_files"]:
            lost = f"{robot['unreadable_files']} of its files could not be read (result.json says why)"
            console.print(f"  {robot['robot']}: {lost}", style="dim", markup=False, soft_wrap=True)
    for item in document["left_out"]:
        console.print(f"  left out: {item['path']} ({item['reason']})", style="dim", markup=False, soft_wrap=True)
    console.print(discovery_sentence(document), style="dim", markup=False, soft_wrap=True)
    page = out / "fleet.html"
    console.print(f"Page: {url_of(page) or page}", markup=False, soft_wrap=True)


def _table(document: dict[str, Any]) -> Any:
    from rich.table import Table

    from safedpa.fleet.summary import group_title, listed, numbers_text

    table = Table(box=None, padding=(0, 2, 0, 0))
    table.add_column("robots", justify="right", no_wrap=True)
    for name in ("what is missing", "numbers", "error", "which"):
        table.add_column(name)
    for group in document["groups"]:
        before, after = group["error_before"], group["error_after"]
        errors = "" if after is None else f"{before:.3g} to {after:.3g}" if group["effects"] else f"{after:.3g}"
        title = group_title(group) + (" (suspected)" if group["kind"] == "suspected" else "")
        names = listed(group["robots"], _NAMES)
        table.add_row(str(len(group["robots"])), title, numbers_text(group), errors, names)
    return table
