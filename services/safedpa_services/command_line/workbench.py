"""``safedpa workbench``: a page on which an engineer finds out what a model lacks, and adds it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from safedpa.errors import InputError
from safedpa.extras import needs
from safedpa_services.command_line.bus_options import bus_of
from safedpa_services.command_line.json_answer import answers_json, finish, report_progress
from safedpa_services.command_line.names import complete_models
from safedpa_services.command_line.options import columns_option, effects_option

if TYPE_CHECKING:
    from safedpa_services.workbench.bench import Bench
    from safedpa_services.workbench.recordings import InputSelection

__all__ = ["command"]


@click.command(name="workbench")
@click.argument("model", default="", shell_complete=complete_models)
@click.argument("runs", metavar="[RUN]...", nargs=-1)
@columns_option
@click.option("--horizon", type=float, default=1.0, show_default=True, metavar="SECONDS", help="How far to predict.")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("workbench"),
    show_default=True,
    metavar="DIR",
    help="Folder of the session, and of what Save writes; DIR-2 where DIR holds that of other recordings.",
)
@click.option(
    "--session",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Go on with a session.json: opens what it names and decides again what was decided.",
)
@effects_option
@click.option(
    "--host",
    default="127.0.0.1",
    show_default=True,
    help="Address to serve on; 0.0.0.0 lets other machines in, and wants a password or a certificate.",
)
@click.option("--name", multiple=True, metavar="HOST", help="A name by which browsers come, besides localhost.")
@click.option(
    "--folder",
    multiple=True,
    type=click.Path(path_type=Path, file_okay=False, exists=True),
    metavar="DIR",
    help="Recordings below it may be opened; default: those of the RUNs, without any the current folder.",
)
@click.option("--tls-certificate", type=click.Path(path_type=Path), metavar="FILE.pem", help="Serve over TLS.")
@click.option("--tls-key", type=click.Path(path_type=Path), metavar="FILE.pem", help="Of the certificate.")
@click.option("--token-only", is_flag=True, help="The token is enough: the port is mapped to a loopback interface.")
@click.option("--port", type=click.IntRange(1, 65535), help="Port of the web page; default: 8080 or the next free one.")
@click.option("--fleet", help="Watch the robots of this fleet live.")
@click.option("--connect", multiple=True, metavar="ENDPOINT", help="Where their bus listens, as 'safedpa up' tells.")
@click.option(
    "--certificates",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Prove by the workbench's certificate there who this is.",
)
@click.option(
    "--replay",
    type=click.Path(path_type=Path),
    metavar="FILE.mcap",
    help="Show a recording of the bus on the live page, as if it drove now.",
)
@click.option(
    "--pictures",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Take pictures of the page by a headless Chromium, write them there and end.",
)
@click.option("--no-browser", is_flag=True, help="Open no browser.")
@answers_json
@needs("workbench")
def command(**options: Any) -> None:
    """Compare MODEL with recorded RUNs on a web page, see where it fails, add what it lacks, watch the error fall.

    What is decided is kept in session.json below --out: the same command again goes on with it; without arguments
    the last session goes on, and where there is none the page asks for model and recordings. With --fleet or --connect
    it watches driving robots as well, at /live. Everything is served from this machine.
    """
    from safedpa.dynamics import load_own_everywhere

    if options["effects"] is not None:
        load_own_everywhere(options["effects"])
    if options["pictures"] is not None:
        _take_pictures(options)
    else:
        _serve(options)


def _serve(options: dict[str, Any]) -> None:
    from safedpa_services.workbench.page_address import PageServerOptions
    from safedpa_services.workbench.server import chosen_port, serve

    bench, browser = _bench(options), not options["no_browser"]
    serving = PageServerOptions(
        options["host"],
        chosen_port(options["host"], options["port"]),
        options["name"],
        options["folder"],
        options["tls_certificate"],
        options["tls_key"],
        options["token_only"],
    )
    if not options["fleet"] and not options["connect"]:
        serve(bench, serving, browser=browser, bus=options["replay"], announce=_announce)
        return
    import os

    with bus_of({**options, "fleet": options["fleet"] or "fleet"}, "workbench") as bus:
        os.nice(10)  # the loop that it looks at comes first; the bus keeps its links up, and so is not put behind it
        serve(bench, serving, browser=browser, bus=bus, announce=_announce)


def _announce(where: str) -> None:
    report_progress(f"Workbench: {where}  (Ctrl-C ends it)", facts={"address": where})
    finish()


def _bench(options: dict[str, Any]) -> Bench:
    """What the page begins with: a session that goes on, or what was named."""
    from safedpa_services.workbench.bench import Bench
    from safedpa_services.workbench.recordings import InputSelection
    from safedpa_services.workbench.session_files import newest_session, read_session

    if not 0.0 < options["horizon"] < math.inf:
        raise InputError(f"--horizon: got {options['horizon']} s, wanted a positive number of seconds; choose 1, say")
    out, named = (
        options["out"],
        InputSelection(options["model"], options["runs"], options["columns"], options["horizon"]),
    )
    if options["session"] is not None and named.model:
        raise InputError(f"MODEL {named.model}: got it with --session, which names its own; leave one of them out")
    _look_at(named)
    live = options["fleet"] or options["connect"] or options["replay"]
    file = options["session"] or (None if named.model or live else newest_session(out))
    if file is None:
        return Bench(named, out)
    retained = read_session(file)
    report_progress(
        f"Workbench: goes on with {file} ({len(retained.decisions)} decisions)", err=True, facts={"session": str(file)}
    )
    return Bench(retained.choice, out, retained.decisions, file.parent)


def _look_at(named: InputSelection) -> None:
    """Raises InputError for a model or a file that is none; what is in the files, the page can help with."""
    from safedpa.dynamics import load_model
    from safedpa.records.readers.bags.detect import kind_of

    if named.model:
        load_model(named.model)
    for run in named.runs:
        kind_of(Path(run))


def _take_pictures(options: dict[str, Any]) -> None:
    """This very command again, behind a headless browser."""
    from safedpa_services.workbench.pictures import take_pictures

    live = bool(options["fleet"] or options["connect"] or options["replay"])
    arguments = [options["model"], *options["runs"]] if options["model"] else []
    for name in ("columns", "horizon", "out", "session", "effects", "fleet", "replay", "certificates"):
        arguments += [f"--{name}", str(options[name])] if options[name] is not None else []
    arguments += [item for endpoint in options["connect"] for item in ("--connect", endpoint)]
    for path in take_pictures(arguments, options["pictures"], live=live):
        report_progress(str(path), facts={"written": [str(path)]})
