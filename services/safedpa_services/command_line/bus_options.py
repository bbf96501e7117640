"""Options with which a command joins the bus of a running fleet, to observe it or to send a request."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import click

from safedpa.errors import InputError, SafedpaError
from safedpa_services.command_line.options import PATH, as_json_option

if TYPE_CHECKING:
    from safedpa.bus import Answer, Bus, Request


ANSWER_SECONDS = 2.0

_C = TypeVar("_C", bound=Callable[..., Any])


_certificates_option = click.option(
    "--certificates", type=PATH, metavar="DIR", help="folder with the operator's certificate"
)
who_option = click.option("--who", default="", help="your name, for the recording; default: your user name")


def listening_options(command: _C) -> _C:
    """Adds ``--fleet``, ``--connect``, ``--certificates`` and ``--json`` to a command."""
    for option in (
        _certificates_option,
        as_json_option,
        click.option(
            "--connect",
            multiple=True,
            envvar="SAFEDPA_CONNECT",
            metavar="ENDPOINT",
            help="endpoint of the loop, printed by 'safedpa up'; also SAFEDPA_CONNECT",
        ),
        click.option("--fleet", default="fleet", show_default=True, help="name of the fleet on the bus"),
    ):
        command = option(command)
    return command


def bus_of(options: dict[str, Any], role: str = "operator") -> Bus:
    """Joins the bus that the options describe, in a role. Raises BusError if it cannot be opened."""
    from safedpa.bus import Bus, ZenohSettings, ZenohTransport
    from safedpa.bus.security.certificates import Certificates

    folder = options["certificates"]
    certificates = None if folder is None else Certificates(folder, role)
    mode: Literal["client", "peer"] = "client" if options["connect"] else "peer"
    settings = ZenohSettings(mode, connect=tuple(options["connect"]), certificates=certificates)
    return Bus(ZenohTransport(settings), options["fleet"])


def request_answer(bus: Bus, robot: str, request: Request, kind: str, no_answer: str) -> Answer:
    """Sends a request and returns the answer.

    Raises InputError if the request is refused, and SafedpaError with the text ``no_answer`` if no answer arrives
    within 2 s.
    """
    answer = bus.request(robot, request, ANSWER_SECONDS, kind)
    if answer is None:
        raise SafedpaError(f"fleet '{bus.fleet}': {no_answer}")
    if not answer.ok:
        raise InputError(answer.sentence)
    return answer
