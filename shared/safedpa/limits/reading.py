"""Reads files with a size limit; refuses anything but regular files."""

from __future__ import annotations

import os
import stat
from collections.abc import Mapping
from pathlib import Path

from safedpa.errors import InputError, near_files
from safedpa.limits.table import limit, too_much

__all__ = ["file_of_at_most", "text_of_file", "text_of_file_or_shipped"]


def file_of_at_most(path: Path, name: str) -> bytes:
    """Returns the bytes of a regular file that is no larger than the limit ``name``.

    Raises LimitError if it is larger, InputError for a device, pipe or socket (which may never end), and OSError as
    ``open`` does.
    """
    most = limit(name)
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a pipe without a writer blocks otherwise
    with open(descriptor, "rb") as file:
        found = os.fstat(descriptor)
        if stat.S_ISDIR(found.st_mode):
            raise IsADirectoryError(21, "is a folder", str(path))
        if not stat.S_ISREG(found.st_mode):
            raise InputError(f"{path}: is not a regular file; wanted one")
        if found.st_size > most:
            raise too_much(name, f"{found.st_size} bytes", str(path))
        content = file.read(most + 1)
    if len(content) > most:  # the file grew, or reports size 0 as those in /proc do
        raise too_much(name, f"more than {most} bytes", str(path))
    return content


def text_of_file(path: Path, name: str) -> str:
    """Reads a UTF-8 text file like ``file_of_at_most``; also raises UnicodeDecodeError."""
    return file_of_at_most(path, name).decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")


def text_of_file_or_shipped(
    source: str | Path, shipped: Mapping[str, Path], wanted: str, error: type[InputError] = InputError
) -> tuple[Path, str]:
    """Returns the path and text of a TOML file: a path, or the name of a shipped file with or without ``.toml``.

    Raises ``error``, which says what was ``wanted``, if it cannot be read, and InputError as ``text_of_file`` does.
    """
    path = Path(source)
    if (not path.exists() or path.is_dir()) and path.stem in shipped and path.parent == Path():
        path = shipped[path.stem]
    try:
        return path, text_of_file(path, "toml_bytes")
    except (OSError, UnicodeDecodeError) as problem:
        reason = getattr(problem, "strerror", None) or str(problem)
        raise error(
            f"{source}: cannot be read ({reason}); {near_files(path, shipped)}wanted {wanted}, or one of "
            f"{', '.join(shipped)}"
        ) from problem
