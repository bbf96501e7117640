"""Crash-safe writing of files, and readable reasons for failed writes."""

from __future__ import annotations

import contextlib
import errno
import os
from pathlib import Path

__all__ = ["why_not_written", "write_through"]

_FULL = (errno.ENOSPC, errno.EDQUOT)


def why_not_written(error: OSError) -> str:
    """Returns the reason of a failed write as part of a sentence."""
    if error.errno in _FULL:
        return "the disk is full: free some space"
    return os.strerror(error.errno) if error.errno else str(error) or type(error).__name__


def write_through(path: Path, text: str) -> None:
    """Writes a file atomically and durably: after a crash it has either the old or the new contents.

    Raises OSError; the old contents then remain.
    """
    alongside = path.with_name(path.name + ".new")
    try:
        with alongside.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        alongside.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            alongside.unlink()
        raise
    # The new name is durable only once the folder itself is on the disk.
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
