"""What the disk says when it cannot take something, in words."""

from __future__ import annotations

import errno
import os

__all__ = ["why_not_written"]

_FULL = (errno.ENOSPC, errno.EDQUOT)


def why_not_written(error: OSError) -> str:
    """The reason of a failed write as part of a sentence; that the disk is full is said so."""
    if error.errno in _FULL:
        return "the disk is full: make room"
    return os.strerror(error.errno) if error.errno else str(error) or type(error).__name__
