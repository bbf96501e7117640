"""Which safedpa a process runs, for heartbeats."""

from __future__ import annotations

from functools import cache
from importlib.metadata import PackageNotFoundError, version

__all__ = ["software_version"]


@cache
def software_version() -> str:
    """Of the installed package; empty where it runs without having been installed."""
    try:
        return version("safedpa")
    except PackageNotFoundError:
        return ""
