"""``safedpa workbench``: a page on which an engineer finds out what a model lacks, and adds it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from safedpa.extras import needs
from safedpa_services.command_line.listening import bus_of
from safedpa_services.command_line.names import complete_models

__all__ = ["command"]


@click.command(name="workbench")
@click.argument("model", default="", shell_complete=complete_models)
@click.argument("runs", metavar="[RUN]...", nargs=-1)
@click.option("--columns", help="Column map (TOML), or the name of one that ships: dart_car_columns, say.")
@click.option("--horizon", type=float, default=1.0, show_default=True, metavar="SECONDS", help="How far to predict.")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("workbench"),
    show_default=True,
    metavar="DIR",
    help="Folder into which Save writes model.toml and margin.toml.",
)
@click.option(
    "--effects",
    "--robot-file",
    "effects",
    type=click.Path(path_type=Path),
    metavar="FILE.py",
    help="Effects, systems and robots of your own.",
)
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
@needs("workbench")
def command(**options: Any) -> None:
    """Compare MODEL with recorded RUNs on a web page, see where it fails, add what it lacks, watch the error fall.

    Without arguments the page asks for model and recordings; with --fleet or --connect it watches driving robots as
    well, at /live. Everything is served from this machine.
    """
    from safedpa.dynamics import load_own_everywhere

    if options["effects"] is not None:
        load_own_everywhere(options["effects"])
    if options["pictures"] is not None:
        _take_pictures(options)
    else:
        _serve(options)


def _serve(options: dict[str, Any]) -> None:
    from safedpa_services.workbench.recordings import Choice
    from safedpa_services.workbench.server import chosen_port, serve
    from safedpa_services.workbench.serving import Serving

    choice = Choice(options["model"], options["runs"], options["columns"], options["horizon"])
    out, browser = options["out"], not options["no_browser"]
    serving = Serving(
        options["host"],
        chosen_port(options["host"], options["port"]),
        options["name"],
        options["folder"],
        options["tls_certificate"],
        options["tls_key"],
        options["token_only"],
    )
    if not options["fleet"] and not options["connect"]:
        serve(choice, out, serving, browser=browser, bus=options["replay"])
        return
    import os

    with bus_of({**options, "fleet": options["fleet"] or "fleet"}, "workbench") as bus:
        os.nice(10)  # the loop that it looks at comes first; the bus keeps its links up, and so is not put behind it
        serve(choice, out, serving, browser=browser, bus=bus)


def _take_pictures(options: dict[str, Any]) -> None:
    """This very command once more, behind a headless browser."""
    from safedpa_services.workbench.pictures import take_pictures

    live = bool(options["fleet"] or options["connect"] or options["replay"])
    arguments = [options["model"], *options["runs"]] if options["model"] else []
    for name in ("columns", "horizon", "out", "effects", "fleet", "replay", "certificates"):
        arguments += [f"--{name}", str(options[name])] if options[name] is not None else []
    arguments += [item for endpoint in options["connect"] for item in ("--connect", endpoint)]
    for path in take_pictures(arguments, options["pictures"], live=live):
        click.echo(str(path))
