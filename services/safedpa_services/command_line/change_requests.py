"""Asking a running diagnosis to change a robot's model: shared by ``accept``, ``reject`` and ``roll-back``."""

from __future__ import annotations

import getpass
import json
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import click

from safedpa.errors import InputError, SafedpaError
from safedpa_services.command_line.bus_options import bus_of, listening_options, who_option
from safedpa_services.lines import print_plain

if TYPE_CHECKING:
    from safedpa.bus import Answer, Bus, Request

__all__ = ["ask_for_change", "bus_options"]

_C = TypeVar("_C", bound=Callable[..., Any])

_TIMEOUT_SECONDS = 2.0
_LONGEST_CHANGE_SECONDS = 120.0
"""A model that is made when it is accepted takes some seconds; the diagnosis itself gives up after a minute."""
_LOOK_SECONDS = 0.1
_SILENCE_SECONDS = 10.0
"""A change goes on while one answer about it is late or lost; no one is there where none comes for so long."""


def bus_options(command: _C) -> _C:
    """The options by which a command finds a running loop, and says who asks."""
    return listening_options(who_option(command))


def ask_for_change(do: str, robot: str, effect: str, options: dict[str, Any]) -> None:
    """Asks, waits until the change is taken or dropped, and tells what came of it.

    Raises InputError when it is refused, SafedpaError when no one answers or nothing came of it.
    """
    from safedpa.bus import Request

    with bus_of(options) as bus:
        seen = _asked(bus, robot, Request(do="status"))
        if not seen.ok:
            raise InputError(seen.sentence)
        who = options["who"] or getpass.getuser()
        request = Request(do=do, effect=effect, model=seen.fingerprint, finding=seen.finding, who=who)
        answer = _asked(bus, robot, request)
        if not answer.ok:
            raise InputError(answer.sentence)
        end = answer if do == "reject" else _end_of(bus, robot, answer)
    _report(robot, end, as_json=options["as_json"])
    if do != "reject" and end.fingerprint == seen.fingerprint:
        raise SafedpaError(end.sentence)


def _asked(bus: Bus, robot: str, request: Request) -> Answer:
    answer = bus.request(robot, request, _TIMEOUT_SECONDS)
    if answer is None:
        raise _no_answer(bus, robot)
    return answer


def _no_answer(bus: Bus, robot: str) -> SafedpaError:
    return SafedpaError(
        f"robot '{robot}' of fleet '{bus.fleet}': no diagnosis answers; wanted a running 'safedpa up', whose "
        "endpoint is named with --connect"
    )


def _end_of(bus: Bus, robot: str, begun: Answer) -> Answer:
    """The status once the change is over."""
    from safedpa.bus import Request

    heard = time.monotonic()
    give_up = heard + _LONGEST_CHANGE_SECONDS
    while time.monotonic() < give_up:
        status = bus.request(robot, Request(do="status"), _TIMEOUT_SECONDS)
        if status is not None:
            heard = time.monotonic()
            if not status.pending or status.change != begun.change:
                return status
        elif time.monotonic() - heard > _SILENCE_SECONDS:
            raise _no_answer(bus, robot)
        time.sleep(_LOOK_SECONDS)
    raise SafedpaError(
        f"change {begun.change} is not over after {_LONGEST_CHANGE_SECONDS:.0f} s; does the robot drive?"
    )


def _report(robot: str, end: Answer, *, as_json: bool) -> None:
    if as_json:
        table = {"robot": robot, "change": end.change, "model": end.fingerprint, "sentence": end.sentence}
        click.echo(json.dumps(table))
    else:
        print_plain(f"{robot}: {end.sentence}; model {end.fingerprint} in force")
