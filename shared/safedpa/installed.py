"""Cached entry points of installed distributions; reading them opens a file of every distribution."""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

__all__ = ["entry_points_of_group"]


def entry_points_of_group(group: str) -> tuple[EntryPoint, ...]:
    """Returns the entry points of a group, as read at the first call in this process."""
    return tuple(_all().select(group=group))


@cache
def _all() -> Any:  # the class differs between Python 3.11 and 3.12; both have ``select``
    return entry_points()
