"""Reads files with a size limit, and checks archives and files of weights by their directory or header."""

from __future__ import annotations

import math
import os
import stat
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safedpa.errors import InputError, near_files
from safedpa.limits.table import limit, too_much
from safedpa.limits.text import parse_json

_READ = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
"""Opens a file; without the second flag a pipe without a writer would block."""


def file_of_at_most(path: Path, name: str) -> bytes:
    """Returns the bytes of a regular file that is no larger than the limit ``name``.

    Raises LimitError if it is larger, InputError for a device, pipe or socket (which may never end), and OSError as
    ``open`` does.
    """
    most = limit(name)
    descriptor = os.open(path, _READ)
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
    """Reads a text file in UTF-8, or in UTF-16 with a byte order mark, like ``file_of_at_most``.

    Also raises UnicodeDecodeError.
    """
    data = file_of_at_most(path, name)
    encoding = "utf-16" if data.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig"
    return data.decode(encoding).replace("\r\n", "\n").replace("\r", "\n")


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


def check_archive(path: Path) -> None:
    """Checks a zip archive (and so .npz) by its directory: the reader never unpacks more than the size listed there.

    Raises LimitError if the archive passes a limit, and InputError if it is damaged or no archive.
    """
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


_LENGTH_BYTES = 8
_METADATA = "__metadata__"
_LARGEST_SIDE = 1 << 32
_BYTES = {"F64": 8, "F32": 4, "F16": 2, "BF16": 2, "I64": 8, "I32": 4, "I16": 2, "I8": 1, "U8": 1, "BOOL": 1}


def check_tensor_file(path: Path) -> None:
    """Checks a file of weights (safetensors) by its header, before any tensor is read.

    Format: 8 bytes with the length of the header; the header, a JSON object from names to ``dtype``, ``shape`` and
    ``data_offsets``; the data. Raises LimitError for a passed limit, InputError if shapes and file size disagree, and
    OSError as ``open`` does.
    """
    if not path.is_file():
        raise FileNotFoundError(2, "no such file", str(path))
    size = path.stat().st_size
    if size > limit("tensor_bytes"):
        raise too_much("tensor_bytes", f"{size} bytes")
    with path.open("rb") as file:
        length = int.from_bytes(file.read(_LENGTH_BYTES), "little")
        if length > limit("tensor_header_bytes"):
            raise too_much("tensor_header_bytes", f"{length} bytes")
        header = file.read(length)
    if len(header) < length or length < 2:
        raise InputError("ends within its header; wanted a file that 'safedpa train' wrote")
    table = parse_json(header)
    if not isinstance(table, dict):
        raise InputError("the header is not a table of tensors; wanted a file that 'safedpa train' wrote")
    table.pop(_METADATA, None)
    if len(table) > limit("tensors"):
        raise too_much("tensors", len(table))
    for name, entry in table.items():
        _check_tensor(name, entry, size - _LENGTH_BYTES - length)


def _check_tensor(name: str, entry: Any, room: int) -> None:
    if len(name) > limit("tensor_name"):
        raise too_much("tensor_name", len(name))
    shape = entry.get("shape") if isinstance(entry, dict) else None
    numbers = isinstance(shape, list) and len(shape) <= 8 and all(type(side) is int for side in shape)
    if shape is None or not numbers or not all(0 <= side < _LARGEST_SIDE for side in shape):
        raise InputError(f"tensor {name[:60]!r}: got an invalid shape, wanted a list of at most 8 whole numbers")
    wanted = math.prod(shape) * _BYTES.get(str(entry.get("dtype")), 1)
    if wanted > room:
        raise InputError(f"tensor {name[:60]!r}: its shape needs {wanted} bytes, the file has {room}")
