"""What other distributions bring by entry points, looked up once: each look reads a file of every one installed."""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

__all__ = ["entry_points_of_group"]


def entry_points_of_group(group: str) -> tuple[EntryPoint, ...]:
    """The entry points of a group, as they were when this process first asked for any."""
    return tuple(_all().select(group=group))


@cache
def _all() -> Any:  # of Python 3.11 another class than of 3.12, with the same ``select``
    return entry_points()
