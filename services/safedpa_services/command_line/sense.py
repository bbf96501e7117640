"""``safedpa sense``: what a driving robot's perception listens to and which zones count, and switching them."""

from __future__ import annotations

import getpass
import json
from typing import Any

import click

from safedpa_services.command_line.bus_options import bus_of, listening_options, request_answer, who_option
from safedpa_services.lines import print_plain

__all__ = ["command"]


@click.command()
@click.argument("robot", metavar="ROBOT")
@click.option("--source", "sources", multiple=True, metavar="NAME=on|off", help="listen to a source, or do not")
@click.option("--zone", "zones", multiple=True, metavar="NAME=on|off", help="let a zone of its file count, or not")
@listening_options
@who_option
def command(robot: str, sources: tuple[str, ...], zones: tuple[str, ...], **options: Any) -> None:
    """Switch sources and zones of ROBOT's perception while it drives; without options, tell which count.

    All that is asked for takes effect at one tick, or nothing does. It holds until another order, or until perception
    is started again. What only a source sees that is off is hidden; with none left the filter brakes.
    """
    from safedpa.bus import Request
    from safedpa.bus.messages.requests import SENSE

    switches = (*(f"source {text}" for text in sources), *(f"zone {text}" for text in zones))
    who = options["who"] or getpass.getuser()
    request = Request(do="switch" if switches else "status", switches=switches, who=who)
    with bus_of(options) as bus:
        no_answer = (
            "no perception answers; wanted a running loop with one (safedpa up --laser), whose endpoint is named"
        )
        answer = request_answer(bus, robot, request, SENSE, f"{no_answer} with --connect")
    if options["as_json"]:
        click.echo(json.dumps({"sentence": answer.sentence}))
    else:
        print_plain(answer.sentence)
