"""Files, measured before they are read: only ordinary ones, and no larger than their limit."""

from __future__ import annotations

import os
import stat
from collections.abc import Mapping
from pathlib import Path

from safedpa.errors import InputError, near_files
from safedpa.limits.table import limit, too_much

__all__ = ["file_of_at_most", "text_of_file", "text_of_file_or_shipped"]


def file_of_at_most(path: Path, name: str) -> bytes:
    """The bytes of an ordinary file, if they are no more than the limit ``name``.

    Raises InputError for a device, a pipe or a socket, which may never end; LimitError; and OSError as ``open`` does.
    """
    most = limit(name)
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a pipe without a writer would wait
    with open(descriptor, "rb") as file:
        found = os.fstat(descriptor)
        if stat.S_ISDIR(found.st_mode):
            raise IsADirectoryError(21, "is a folder", str(path))
        if not stat.S_ISREG(found.st_mode):
            raise InputError(f"{path}: is no ordinary file; wanted one")
        if found.st_size > most:
            raise too_much(name, f"{found.st_size} bytes", str(path))
        content = file.read(most + 1)
    if len(content) > most:  # it grew, or has no size of its own, such as those of /proc
        raise too_much(name, f"more than {most} bytes", str(path))
    return content


def text_of_file(path: Path, name: str) -> str:
    """The same as text in UTF-8; raises UnicodeDecodeError besides."""
    return file_of_at_most(path, name).decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")


def text_of_file_or_shipped(
    source: str | Path, shipped: Mapping[str, Path], wanted: str, error: type[InputError] = InputError
) -> tuple[Path, str]:
    """A TOML file and its text: the one named, or one that ships, by its name with or without ``.toml``.

    Raises ``error`` that says what was ``wanted``, and InputError as ``text_of_file`` does.
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
