"""``safedpa workbench``: serves a page for finding and adding what a model lacks."""

from __future__ import annotations

import math
import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from safedpa.errors import InputError
from safedpa.extras import needs
from safedpa_services.command_line.bus_options import bus_of
from safedpa_services.command_line.json_answer import answers_json, finish, report_progress
from safedpa_services.command_line.names import complete_models
from safedpa_services.command_line.options import PATH, columns_option, effects_option

if TYPE_CHECKING:
    from safedpa_services.workbench.session.controller import SessionController
    from safedpa_services.workbench.session.inputs import InputSelection


@click.command(name="workbench")
@click.argument("model", default="", shell_complete=complete_models)
@click.argument("runs", metavar="[RUN]...", nargs=-1)
@columns_option
@click.option("--horizon", type=float, default=1.0, show_default=True, metavar="SECONDS", help="How far to predict.")
@click.option(
    "--out",
    type=PATH,
    default=Path("workbench"),
    show_default=True,
    metavar="DIR",
    help="Folder of the session and of saved files; DIR-2 if DIR has a session of other recordings.",
)
@click.option(
    "--session",
    type=PATH,
    metavar="FILE",
    help="Resume a session.json: opens its model and recordings and repeats its decisions.",
)
@effects_option
@click.option(
    "--host",
    default="127.0.0.1",
    show_default=True,
    help="Address to serve on; 0.0.0.0 allows other machines, and requires a password or a certificate.",
)
@click.option(
    "--name",
    multiple=True,
    metavar="HOST",
    help="Further host name under which browsers may open the page, besides localhost.",
)
@click.option(
    "--folder",
    multiple=True,
    type=click.Path(path_type=Path, file_okay=False, exists=True),
    metavar="DIR",
    help="Folder whose recordings may be opened; default: those of the RUNs, or the current folder.",
)
@click.option("--tls-certificate", type=PATH, metavar="FILE.pem", help="Serve over TLS.")
@click.option("--tls-key", type=PATH, metavar="FILE.pem", help="Key of the certificate.")
@click.option(
    "--token-only", is_flag=True, help="Require only the token; for a port that is mapped to a loopback interface."
)
@click.option("--port", type=click.IntRange(1, 65535), help="Port of the web page; default: 8080 or the next free one.")
@click.option("--fleet", help="Show the robots of this fleet live.")
@click.option("--connect", multiple=True, metavar="ENDPOINT", help="Endpoint of the loop, printed by 'safedpa up'.")
@click.option("--certificates", type=PATH, metavar="DIR", help="Folder with the workbench's certificate.")
@click.option("--replay", type=PATH, metavar="FILE.mcap", help="Play a recording of the bus on the live page.")
@click.option(
    "--pictures", type=PATH, metavar="DIR", help="Write pictures of the page to DIR with a headless Chromium, and exit."
)
@click.option("--no-browser", is_flag=True, help="Do not open a browser.")
@answers_json
@needs("workbench")
def command(**options: Any) -> None:
    """Compare and diagnose MODEL on a web page.

    The page shows where the model fails on recorded RUNs, and adds missing effects.

    Decisions are saved in session.json below --out. The same command resumes the session; without arguments the last
    session is resumed or, if there is none, the page asks for model and recordings. With --fleet or --connect the page
    /live shows driving robots. Everything is served from this machine.
    """
    from safedpa.dynamics import load_user_file_everywhere

    if options["effects"] is not None:
        load_user_file_everywhere(options["effects"])
    if options["pictures"] is not None:
        _take_pictures(options)
    else:
        _serve(options)


def _serve(options: dict[str, Any]) -> None:
    from safedpa_services.web.page_options import PageServerOptions
    from safedpa_services.workbench.server import serve

    controller, serving = _controller(options), PageServerOptions.of(options)
    start = partial(serve, controller, serving, browser=not options["no_browser"], announce=_announce)
    if not options["fleet"] and not options["connect"]:
        start(bus=options["replay"])
        return
    with bus_of({**options, "fleet": options["fleet"] or "fleet"}, "workbench") as bus:
        os.nice(10)  # the control loop has priority; the bus's threads, started before, keep theirs
        start(bus=bus)


def _announce(where: str) -> None:
    report_progress(f"Workbench: {where}  (Ctrl-C ends it)", facts={"address": where})
    finish()


def _controller(options: dict[str, Any]) -> SessionController:
    """Returns the initial state of the page: a resumed session, or the given model and runs."""
    from safedpa_services.workbench.session.controller import SessionController
    from safedpa_services.workbench.session.files import newest_session, read_session
    from safedpa_services.workbench.session.inputs import InputSelection

    if not 0.0 < options["horizon"] < math.inf:
        raise InputError(f"--horizon: got {options['horizon']} s, wanted a positive number of seconds, such as 1")
    named = InputSelection(options["model"], options["runs"], options["columns"], options["horizon"])
    if options["session"] is not None and named.model:
        raise InputError(
            f"MODEL {named.model}: got it together with --session, which names a model; leave out one of them"
        )
    _check_inputs(named)
    live = options["fleet"] or options["connect"] or options["replay"]
    file = options["session"] or (None if named.model or live else newest_session(options["out"]))
    if file is None:
        return SessionController(named, options["out"])
    session = read_session(file)
    line = f"Workbench: resuming {file} ({len(session.decisions)} decisions)"
    report_progress(line, err=True, facts={"session": str(file)})
    return SessionController(session.choice, options["out"], session.decisions, file.parent)


def _check_inputs(named: InputSelection) -> None:
    """Raises InputError for an invalid model or an unknown kind of file; the page handles the contents of files."""
    from safedpa.dynamics import load_model
    from safedpa.records.readers.bags.detect import kind_of
    from safedpa.records.store import url_of

    if named.model:
        load_model(named.model)
    for run in named.runs:
        if not url_of(run):  # which would be transferred twice
            kind_of(Path(run))


def _take_pictures(options: dict[str, Any]) -> None:
    """Runs the same command again and opens its page in a headless browser."""
    from safedpa_services.workbench.screenshots import take_screenshots

    live = bool(options["fleet"] or options["connect"] or options["replay"])
    arguments = [options["model"], *options["runs"]] if options["model"] else []
    for name in ("columns", "horizon", "out", "session", "effects", "fleet", "replay", "certificates"):
        arguments += [f"--{name}", str(options[name])] if options[name] is not None else []
    arguments += [item for endpoint in options["connect"] for item in ("--connect", endpoint)]
    for path in take_screenshots(arguments, options["pictures"], live=live):
        report_progress(str(path), facts={"written": [str(path)]})
