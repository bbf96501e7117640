"""``safedpa sense``: shows and switches the sources and zones of a driving robot's perception."""

from __future__ import annotations

import getpass
import json
from typing import Any

import click

from safedpa_services.command_line.bus_options import bus_of, listening_options, request_answer, who_option
from safedpa_services.plain_output import print_plain


@click.command()
@click.argument("robot", metavar="ROBOT")
@click.option("--source", "sources", multiple=True, metavar="NAME=on|off", help="use or ignore a sensor source")
@click.option(
    "--zone", "zones", multiple=True, metavar="NAME=on|off", help="use or ignore a zone of the perception file"
)
@listening_options
@who_option
def command(robot: str, sources: tuple[str, ...], zones: tuple[str, ...], **options: Any) -> None:
    """Show or switch sensor sources and zones of ROBOT.

    All switches of one command take effect at the same tick, or none does. They hold until the next order or until
    perception is restarted. Areas that only a switched-off source sees count as hidden; without any source the filter
    brakes.
    """
    from safedpa.bus import Request
    from safedpa.bus.messages.requests import SENSE

    switches = (*(f"source {text}" for text in sources), *(f"zone {text}" for text in zones))
    who = options["who"] or getpass.getuser()
    request = Request(do="switch" if switches else "status", switches=switches, who=who)
    with bus_of(options) as bus:
        no_answer = "no perception answers; start a loop with one (safedpa up --laser), and name its endpoint"
        answer = request_answer(bus, robot, request, SENSE, f"{no_answer} with --connect")
    if options["as_json"]:
        click.echo(json.dumps({"sentence": answer.sentence}))
    else:
        print_plain(answer.sentence)
