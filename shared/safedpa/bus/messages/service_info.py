"""What a process says of itself, for recordings: versions, options, and with what it computes.

Which safedpa a process runs, for heartbeats.
"""

from __future__ import annotations

import json
import os
import platform
import sys
import time
import uuid
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version

from safedpa.bus.messages.messages import SetupMessage

__all__ = [
    "SETUP_SECONDS",
    "setup_message",
    "software_version",
]

SETUP_SECONDS = 5.0
"""Between two tellings of the setup: anyone who joins late knows it soon."""
_DECIDING = ("safedpa", "numpy", "piqp", "pymunk")
"""Packages on whose versions the numbers depend."""


def setup_message(service: str, options: Mapping[str, object]) -> SetupMessage:
    """The setup of this process, with an instance redrawn; ``options`` are the command line's (None: not given)

    The fields about model, settings, margin and controller are empty; ``dataclasses.replace`` fills them.
    """
    reported = {name: _reported(value) for name, value in options.items() if value is not None}
    return SetupMessage(
        epoch=0,
        tick=0,
        robot_time=0.0,
        publish_time=time.time(),
        service=service,
        instance=uuid.uuid4().hex[:12],
        pid=os.getpid(),
        software=json.dumps(_software(), sort_keys=True),
        options=json.dumps(reported, sort_keys=True),
    )


def _reported(value: object) -> object:
    """As JSON can say it: lists as such, since what was recorded is taken as options again."""
    if isinstance(value, list | tuple):
        return [_reported(item) for item in value]
    return value if isinstance(value, str | int | float) else str(value)


def _software() -> dict[str, str]:
    found = {"python": platform.python_version(), "machine": platform.machine(), "system": sys.platform}
    for name in _DECIDING:
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # an image has only what its role needs
            continue
    return found


@cache
def software_version() -> str:
    """Of the installed package; empty where it runs without having been installed."""
    try:
        return version("safedpa")
    except PackageNotFoundError:
        return ""
