"""Description of the running process for recordings and heartbeats: versions and options."""

from __future__ import annotations

import json
import os
import platform
import sys
import uuid
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version

from safedpa.bus.messages.messages import SetupMessage, header

SETUP_SECONDS = 5.0
"""Interval between setup messages: a recorder that is started later has the setup within this time."""
# Packages whose versions affect numerical results.
_DECIDING = ("safedpa", "numpy", "piqp", "pymunk")


def setup_message(service: str, options: Mapping[str, object]) -> SetupMessage:
    """Returns the setup message of this process with a new random instance.

    ``options`` are those of the command line; None values are left out. The fields about model, settings, margin and
    controller are empty; fill them with ``dataclasses.replace``.
    """
    reported = {name: _reported(value) for name, value in options.items() if value is not None}
    return SetupMessage(
        **header(),
        service=service,
        instance=uuid.uuid4().hex[:12],
        pid=os.getpid(),
        software=json.dumps(_software(), sort_keys=True),
        options=json.dumps(reported, sort_keys=True),
    )


def _reported(value: object) -> object:
    """Converts a value to JSON types."""
    # Lists stay lists, because a replay passes the recorded options to the command line again.
    if isinstance(value, list | tuple):
        return [_reported(item) for item in value]
    return value if isinstance(value, str | int | float) else str(value)


def _software() -> dict[str, str]:
    found = {"python": platform.python_version(), "machine": platform.machine(), "system": sys.platform}
    for name in _DECIDING:
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # a container image has only the packages that its service needs
            continue
    return found


_SUPERVISED: list[bool] = []


def mark_as_supervised() -> None:
    """Declares that a supervisor started this process; its heartbeats report that from now on."""
    _SUPERVISED.append(True)


def is_supervised() -> bool:
    """Whether a supervisor started this process."""
    return bool(_SUPERVISED)


@cache
def software_version() -> str:
    """Returns the version of the installed package; empty if it is not installed."""
    try:
        return version("safedpa")
    except PackageNotFoundError:
        return ""
