"""The options by which a command joins a running fleet to listen to it or to give it an order."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import click

if TYPE_CHECKING:
    from safedpa.bus import Bus

__all__ = ["bus_of", "listening_options"]

_C = TypeVar("_C", bound=Callable[..., Any])


def listening_options(command: _C) -> _C:
    """``--fleet``, ``--connect`` and ``--json``."""
    for option in (
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


def bus_of(options: dict[str, Any]) -> Bus:
    """The bus that the options describe. Raises BusError when it cannot be opened."""
    from safedpa.bus import Bus, ZenohSettings, ZenohTransport

    settings = ZenohSettings("client" if options["connect"] else "peer", connect=tuple(options["connect"]))
    return Bus(ZenohTransport(settings), options["fleet"])
