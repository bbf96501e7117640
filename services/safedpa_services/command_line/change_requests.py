"""``safedpa accept``, ``reject`` and ``roll-back``: requests to a running diagnosis to change a robot's model."""

from __future__ import annotations

import getpass
import json
import time
from typing import TYPE_CHECKING, Any

import click

from safedpa.errors import SafedpaError
from safedpa_services.command_line.bus_options import (
    ANSWER_SECONDS,
    bus_of,
    listening_options,
    request_answer,
    who_option,
)
from safedpa_services.command_line.names import complete_effects
from safedpa_services.plain_output import print_plain

if TYPE_CHECKING:
    from safedpa.bus import Answer, Bus


_NO_ANSWER = "no diagnosis answers for this robot; start 'safedpa up', and name its endpoint with --connect"
_LONGEST_CHANGE_SECONDS = 180.0
"""Building the accepted model takes some seconds, and at most a minute; it is then offered three times at most, for 25
s each."""
_POLL_SECONDS = 0.1
_SILENCE_SECONDS = 10.0
"""Single answers may be late or lost; without any answer for this long, the diagnosis is gone."""


@click.command()
@click.argument("robot")
@click.argument("effect", shell_complete=complete_effects)
@listening_options
@who_option
def accept(robot: str, effect: str, **options: Any) -> None:
    """Add a proposed EFFECT to the model of a driving ROBOT.

    Adaptation, policy and safety filter switch to the new model at the same tick, or all keep the old one.
    """
    ask_for_change("accept", robot, effect, options)


@click.command()
@click.argument("robot")
@click.argument("effect", shell_complete=complete_effects)
@listening_options
@who_option
def reject(robot: str, effect: str, **options: Any) -> None:
    """Reject an EFFECT proposed for a driving ROBOT.

    The model does not change.
    """
    ask_for_change("reject", robot, effect, options)


@click.command()
@click.argument("robot")
@listening_options
@who_option
def roll_back(robot: str, **options: Any) -> None:
    """Restore the previous model of a driving ROBOT.

    This is the model before the last accepted effect.
    """
    ask_for_change("roll_back", robot, "", options)


def ask_for_change(do: str, robot: str, effect: str, options: dict[str, Any]) -> None:
    """Requests a change, waits until it is in force or dropped, and prints the result.

    Raises InputError if the request is refused, and SafedpaError if no diagnosis answers or the change is dropped.
    """
    from safedpa.bus import Request
    from safedpa.bus.messages.requests import REQUEST

    with bus_of(options) as bus:
        seen = request_answer(bus, robot, Request(do="status"), REQUEST, _NO_ANSWER)
        if do == "accept" and not options["as_json"]:
            _report_margin(seen, effect)
        who = options["who"] or getpass.getuser()
        request = Request(do=do, effect=effect, model=seen.fingerprint, finding=seen.finding, who=who)
        answer = request_answer(bus, robot, request, REQUEST, _NO_ANSWER)
        end = answer if do == "reject" else _await_end(bus, robot, answer)
    _report(robot, end, as_json=options["as_json"])
    if do != "reject" and end.fingerprint == seen.fingerprint:
        raise SafedpaError(end.sentence)


def _await_end(bus: Bus, robot: str, started: Answer) -> Answer:
    """Returns the status once the change is over."""
    from safedpa.bus import Request

    last_answer, number = time.monotonic(), started.change
    give_up = last_answer + _LONGEST_CHANGE_SECONDS
    while time.monotonic() < give_up:
        status = bus.request(robot, Request(do="status"), ANSWER_SECONDS)
        if status is not None:
            last_answer = time.monotonic()
            # An offer that was not answered in time is made again, under the next number.
            if status.pending and status.sentence.startswith(f"change {number} (") and "; attempt " in status.sentence:
                number = status.change
            if not status.pending or status.change != number:
                return status
        elif time.monotonic() - last_answer > _SILENCE_SECONDS:
            raise SafedpaError(f"fleet '{bus.fleet}': {_NO_ANSWER}")
        time.sleep(_POLL_SECONDS)
    raise SafedpaError(
        f"change {started.change} is not over after {_LONGEST_CHANGE_SECONDS:.0f} s; check that the robot drives"
    )


def _report_margin(seen: Answer, effect: str) -> None:
    """Prints the table of the margins that the effect would change, if the diagnosis has computed it."""
    table = dict(zip(seen.candidates, seen.foreseen, strict=False)).get(effect, "")
    rows = [line.split(" | ") for line in table.split("\n") if " | " in line]
    widths = [max(map(len, column)) for column in zip(*rows, strict=False)]
    for row in rows:
        print_plain("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=False)).rstrip())


def _report(robot: str, end: Answer, *, as_json: bool) -> None:
    if as_json:
        table = {"robot": robot, "change": end.change, "model": end.fingerprint, "sentence": end.sentence}
        click.echo(json.dumps(table))
    else:
        print_plain(f"{robot}: {end.sentence}; model {end.fingerprint} in force")
