"""Files that outlive a crash, and what the disk says when it cannot take something, in words."""

from __future__ import annotations

import contextlib
import errno
import os
from pathlib import Path

__all__ = ["why_not_written", "write_through"]

_FULL = (errno.ENOSPC, errno.EDQUOT)


def why_not_written(error: OSError) -> str:
    """The reason of a failed write as part of a sentence; that the disk is full is said so."""
    if error.errno in _FULL:
        return "the disk is full: make room"
    return os.strerror(error.errno) if error.errno else str(error) or type(error).__name__


def write_through(path: Path, text: str) -> None:
    """All of it or nothing, whenever the process or the machine ends, and on the disk before it returns.

    Raises OSError; then what was there before stays.
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
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
