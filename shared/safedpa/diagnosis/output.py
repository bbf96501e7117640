"""Folders into which results go."""

from __future__ import annotations

import os
from pathlib import Path

from safedpa.errors import InputError

__all__ = ["writable"]


def writable(folder: Path, *, create: bool = False) -> Path:
    """The folder, made when it is not there and ``create``; asked before long work, not after it.

    Raises InputError when it is no folder or must not be written to.
    """
    try:
        if create:
            folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder}: cannot be made a folder ({error.strerror}); choose another place with --out"
        ) from error
    if not folder.is_dir():
        raise InputError(f"{folder}: got no folder that exists; make it, or choose another place with --out")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"{folder}: must not be written to; choose another place with --out")
    return folder
