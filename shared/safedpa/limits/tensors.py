"""Checks files of weights (safetensors) by their header before any tensor is read.

Format: 8 bytes with the length of the header; the header, a JSON object from tensor names to ``dtype``, ``shape`` and
``data_offsets``; the data.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from safedpa.errors import InputError
from safedpa.limits.table import limit, too_much
from safedpa.limits.text import parse_json

__all__ = ["check_tensor_file"]

_LENGTH_BYTES = 8
_METADATA = "__metadata__"
_LARGEST_SIDE = 1 << 32
_BYTES = {"F64": 8, "F32": 4, "F16": 2, "BF16": 2, "I64": 8, "I32": 4, "I16": 2, "I8": 1, "U8": 1, "BOOL": 1}


def check_tensor_file(path: Path) -> None:
    """Raises LimitError for a passed limit, InputError if shapes and file size disagree, OSError as ``open`` does."""
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
