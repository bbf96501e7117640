"""The table of raw numbers that every reader returns."""

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
    """Columns by name, each of shape (rows,); missing cells are NaN."""

    columns: Mapping[str, NDArray[np.float64]]
    findings: tuple[Finding, ...] = ()
    segment: NDArray[np.intp] | None = None
    """Segment of each row, between which a clock was set; None if the times were not judged yet."""

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def taken(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> Table:
        """Some of the rows."""
        segment = None if self.segment is None else self.segment[index]
        return Table({name: values[index] for name, values in self.columns.items()}, self.findings, segment)


def require_file(path: Path) -> None:
    """Raises RunError if the file is missing or empty."""
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "no such file"
        raise RunError(f"{path}: {what}; {near_files(path)}wanted a recording (.csv, .parquet or .mcap)")
    if path.stat().st_size == 0:
        raise RunError(f"{path}: the file is empty; wanted a recording with a header and rows")


def require_columns(path: Path, wanted: Iterable[str], present: list[str]) -> None:
    """Raises RunError that names the columns that are missing or duplicated."""
    missing = [name for name in wanted if name not in present]
    if missing:
        rest = f" (and {len(missing) - 1} more: {', '.join(missing[1:])})" if len(missing) > 1 else ""
        raise RunError(
            f"{path}: column '{missing[0]}' is missing{rest}; {did_you_mean(missing[0], present)}; "
            "rename it in the file, or name a column map"
        )
    duplicated = [name for name in wanted if present.count(name) > 1]
    if duplicated:
        raise RunError(
            f"{path}: column '{duplicated[0]}' occurs {present.count(duplicated[0])} times; rename the others"
        )
