"""A table of numbers as it lies in a file, before anything is made of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import RunError, did_you_mean, near_files
from safedpa.records.run import Finding

__all__ = ["Table", "require_columns", "require_file"]


@dataclass(frozen=True)
class Table:
    """Columns (rows,) by name; missing cells are NaN."""

    columns: Mapping[str, NDArray[np.float64]]
    findings: tuple[Finding, ...] = ()


def require_file(path: Path) -> None:
    """Raises RunError when there is no file, or an empty one."""
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "no such file"
        raise RunError(f"{path}: {what}; {near_files(path)}wanted a recording (.csv, .parquet or .mcap)")
    if path.stat().st_size == 0:
        raise RunError(f"{path}: the file is empty; wanted a recording with a header and rows")


def require_columns(path: Path, wanted: Iterable[str], present: list[str]) -> None:
    """Raises RunError naming the columns that are missing or there twice."""
    missing = [name for name in wanted if name not in present]
    if missing:
        rest = f" (and {len(missing) - 1} more: {', '.join(missing[1:])})" if len(missing) > 1 else ""
        raise RunError(
            f"{path}: column '{missing[0]}' is missing{rest}; {did_you_mean(missing[0], present)}; "
            "rename it in the file, or name a column map"
        )
    twice = [name for name in wanted if present.count(name) > 1]
    if twice:
        raise RunError(f"{path}: column '{twice[0]}' is there {present.count(twice[0])} times; give each its own name")
