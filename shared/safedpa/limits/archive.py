"""Archives (zip, and so .npz), measured by their directory: the reader ends a member at the size that stands there."""

from __future__ import annotations

import zipfile
from pathlib import Path

from safedpa.errors import InputError
from safedpa.limits.table import limit, too_much

__all__ = ["check_archive"]


def check_archive(path: Path) -> None:
    """Raises LimitError naming the limit, InputError where it is no whole archive."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            if len(members) > limit("archive_members"):
                raise too_much("archive_members", len(members), str(path))
            reported = sum(member.file_size for member in members)
            packed = path.stat().st_size
            if reported > limit("archive_bytes"):
                raise too_much("archive_bytes", f"{reported} bytes", str(path))
            if reported > max(limit("expansion_free_bytes"), packed * limit("expansion")):
                raise too_much("expansion", reported // max(1, packed), str(path))
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError) as error:
        raise InputError(f"{path}: is no whole archive ({' '.join(str(error).split())[:120]})") from error
