"""The options by which a command joins a running fleet to listen to it or to give it an order."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import click

from safedpa.errors import InputError, SafedpaError

if TYPE_CHECKING:
    from safedpa.bus import Answer, Bus, Request

__all__ = ["bus_of", "listening_options", "request_answer", "who_option"]

_ANSWER_SECONDS = 2.0

_C = TypeVar("_C", bound=Callable[..., Any])


_certificates_option = click.option(
    "--certificates",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="prove by the operator's certificate there who this is",
)
who_option = click.option("--who", default="", help="your name, for the recording; default: that of the account")


def listening_options(command: _C) -> _C:
    """``--fleet``, ``--connect``, ``--certificates`` and ``--json``."""
    for option in (
        _certificates_option,
        click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else"),
        click.option(
            "--connect",
            multiple=True,
            envvar="SAFEDPA_CONNECT",
            metavar="ENDPOINT",
            help="where the loop listens, as 'safedpa up' tells; also SAFEDPA_CONNECT",
        ),
        click.option("--fleet", default="fleet", show_default=True, help="name of the fleet on the bus"),
    ):
        command = option(command)
    return command


def bus_of(options: dict[str, Any], role: str = "operator") -> Bus:
    """The bus that the options describe, joined in a role. Raises BusError when it cannot be opened."""
    from safedpa.bus import Bus, ZenohSettings, ZenohTransport
    from safedpa.bus.security.certificates import Certificates

    folder = options["certificates"]
    certificates = None if folder is None else Certificates(folder, role)
    mode: Literal["client", "peer"] = "client" if options["connect"] else "peer"
    settings = ZenohSettings(mode, connect=tuple(options["connect"]), certificates=certificates)
    return Bus(ZenohTransport(settings), options["fleet"])


def request_answer(bus: Bus, robot: str, request: Request, kind: str, no_answer: str) -> Answer:
    """The answer to an order. Raises InputError where it is refused, SafedpaError with the words ``no_answer`` where none
    comes within 2 s."""
    answer = bus.request(robot, request, _ANSWER_SECONDS, kind)
    if answer is None:
        raise SafedpaError(f"fleet '{bus.fleet}': {no_answer}")
    if not answer.ok:
        raise InputError(answer.sentence)
    return answer
