"""``safedpa status``: how the robots and processes of a fleet are, as heard on the bus."""

from __future__ import annotations

import io
import json
import re
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from safedpa.errors import InputError, SafedpaError
from safedpa_services.command_line.listening import bus_of, listening_options

if TYPE_CHECKING:
    from rich.console import Console

    from safedpa.bus.overview import FleetOverview

_REDRAW_SECONDS = 0.5
_FEWEST_COLUMNS = 80


@click.command()
@listening_options
@click.option("--robot", default="*", help="this robot alone")
@click.option("--seconds", type=float, default=3.0, show_default=True, help="how long to listen before telling")
@click.option("--watch", is_flag=True, help="a live table, until Ctrl-C")
@click.option("--picture", type=click.Path(path_type=Path), metavar="FILE.svg", help="also draw it into a file")
def command(robot: str, seconds: float, watch: bool, **options: Any) -> int:
    """Show the fleet: robots, processes, rates, ages, late ticks, verdicts, margin, diagnosis, recorder.

    Exit code 0 when everything is healthy, 1 when something is not or nobody is on the bus.
    """
    from safedpa.bus.overview import FleetOverview

    if not 0.5 <= seconds <= 3600.0:
        raise InputError(f"--seconds: got {seconds:g}, wanted 0.5 to 3600; heartbeats come four times a second")
    if options["picture"] is not None and (watch or options["picture"].suffix != ".svg"):
        raise InputError(f"--picture {options['picture']}: wanted a name that ends with .svg, and no --watch")
    if watch and options["as_json"]:
        raise InputError("--watch, --json: got both, wanted one; a script calls --json as often as it likes")
    with bus_of(options) as bus:
        fleet = FleetOverview(bus, robot)
        healthy = _watched(fleet) if watch else _told(fleet, seconds, options)
    return 0 if healthy else 1


def _told(fleet: FleetOverview, seconds: float, options: dict[str, Any]) -> bool:
    from safedpa_services.status.document import document_of

    fleet.listen(seconds)
    document = document_of(fleet)
    if options["as_json"]:
        click.echo(json.dumps(document))
    elif fleet.nobody:
        raise SafedpaError(_nobody(fleet, seconds, options))
    else:
        _draw(document, options["picture"])
    return bool(document["healthy"])


def _nobody(fleet: FleetOverview, seconds: float, options: dict[str, Any]) -> str:
    where = ", ".join(options["connect"]) or "this machine"
    return (
        f"fleet '{fleet.bus.fleet}': nobody was heard on the bus within {seconds:g} s ({where}); wanted a running "
        "'safedpa up', whose endpoint is named with --connect"
    )


def _draw(document: dict[str, Any], picture: Path | None) -> None:
    from safedpa_services.status.table import picture_of
    from safedpa_services.terminal import terminal

    console = terminal(soft_wrap=False)
    if not console.is_terminal:
        console = terminal(width=max(_FEWEST_COLUMNS, console.width))
    console.print(picture_of(document, console.width))
    if picture is not None:
        drawn = terminal(width=console.width, file=io.StringIO(), record=True, force_terminal=True)
        drawn.print(picture_of(document, console.width))
        _write_svg(drawn, f"safedpa status --fleet {document['fleet']}", picture)


def _write_svg(drawn: Console, title: str, picture: Path) -> None:
    """What was drawn, in a font that the reader's machine has; nothing in the file points to another host."""
    text = drawn.export_svg(title=title, unique_id="safedpa")
    text = re.sub(r"@font-face \{.*?\}", "", text, flags=re.DOTALL)
    text = re.sub(r"<!-- .*? -->", "", text)
    try:
        picture.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"--picture {picture}: cannot be written ({error.strerror})") from error


def _watched(fleet: FleetOverview) -> bool:
    """Draws until Ctrl-C; whether everything was healthy at the last look."""
    from rich.live import Live
    from rich.text import Text

    from safedpa.bus.loop.process import Stop
    from safedpa_services.status.document import document_of
    from safedpa_services.status.table import picture_of
    from safedpa_services.terminal import Shown, terminal

    stop, console, healthy = Stop(), terminal(), False
    stop.listen_to_signals()
    with Live(console=console, auto_refresh=False, screen=console.is_terminal, vertical_overflow="crop") as live:
        while not stop():
            fleet.listen(_REDRAW_SECONDS)
            document = document_of(fleet)
            healthy = document["healthy"]
            if fleet.nobody:
                heard = time.monotonic() - fleet.since
                live.update(Text(f"fleet '{fleet.bus.fleet}': nobody was heard for {heard:.0f} s"), refresh=True)
            else:
                live.update(Shown(picture_of(document, console.width, console.height)), refresh=True)
    return healthy
