"""Checks zip archives (and so .npz) by their directory; the reader never unpacks more than the size listed there."""

from __future__ import annotations

import zipfile
from pathlib import Path

from safedpa.errors import InputError
from safedpa.limits.table import limit, too_much

__all__ = ["check_archive"]


def check_archive(path: Path) -> None:
    """Raises LimitError if the archive passes a limit, and InputError if it is damaged or no archive."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            if len(members) > limit("archive_members"):
                raise too_much("archive_members", len(members), str(path))
            unpacked = sum(member.file_size for member in members)
            packed = path.stat().st_size
            if unpacked > limit("archive_bytes"):
                raise too_much("archive_bytes", f"{unpacked} bytes", str(path))
            if unpacked > max(limit("expansion_free_bytes"), packed * limit("expansion")):
                raise too_much("expansion", unpacked // max(1, packed), str(path))
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError) as error:
        raise InputError(f"{path}: is damaged or no archive ({' '.join(str(error).split())[:120]})") from error
