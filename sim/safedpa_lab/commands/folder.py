"""The folders that a command writes into and reads from."""

from __future__ import annotations

from pathlib import Path

from safedpa.errors import InputError

__all__ = ["made_folder", "named_folder"]


def made_folder(out: Path | None) -> None:
    """Makes it, where one is named. Raises InputError at once, not after hours, when it cannot be made."""
    if out is None:
        return
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {out}: cannot be made ({error.strerror}); choose another folder") from error


def named_folder(option: str, folder: Path, usual: Path = Path()) -> None:
    """Raises InputError for a folder that a user named and that is not there: what ships would be taken for it."""
    if folder != usual and not folder.is_dir():
        raise InputError(
            f"{option} {folder}: got no folder that exists, wanted one; without {option} what ships is taken"
        )
