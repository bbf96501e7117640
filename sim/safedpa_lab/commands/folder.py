"""The folder that a command writes into."""

from __future__ import annotations

from pathlib import Path

from safedpa.errors import InputError

__all__ = ["made_folder"]


def made_folder(out: Path | None) -> None:
    """Makes it, where one is named. Raises InputError at once, not after hours, when it cannot be made."""
    if out is None:
        return
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {out}: cannot be made ({error.strerror}); choose another folder") from error
