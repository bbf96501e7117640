"""The table of raw numbers that every reader returns."""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import RunError, SafedpaError, did_you_mean, near_files
from safedpa.limits import limit, readable, too_much
from safedpa.records.run import Finding
from safedpa.records.store import TransferError, open_store, url_of

__all__ = ["LARGEST_NUMBER", "WANTED", "Table", "plausible_numbers", "regular_file", "require_columns", "require_file"]

WANTED = "a recording: .csv, .parquet, .npz, .mat, .h5, .mcap, .db3, .bag, .ulg, a rosbag2 folder or a LeRobot dataset"
"""Every format, for messages."""
_MAX_FILES = 10_000
"""Files of a folder that is downloaded; a dataset has one for each episode."""


LARGEST_NUMBER = 1e100
"""In SI or any other unit no robot measures more; squares and sums of such numbers are finite."""


def plausible_numbers(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The values, with NaN in place of infinite ones and those beyond ``LARGEST_NUMBER``."""
    beyond = np.abs(values) > LARGEST_NUMBER
    return np.where(beyond, np.nan, values) if beyond.any() else values


@dataclass(frozen=True)
class Table:
    """Columns by name, each of shape (rows,); missing cells are NaN, and so are those beyond ``LARGEST_NUMBER``."""

    columns: Mapping[str, NDArray[np.float64]]
    findings: tuple[Finding, ...] = ()
    segment: NDArray[np.intp] | None = None
    """Segment of each row, between which a clock was set; None if the times were not judged yet."""
    timed: frozenset[str] = frozenset()
    """Columns that hold dates, times or durations, converted to seconds."""

    def __post_init__(self) -> None:
        columns = {name: plausible_numbers(values) for name, values in self.columns.items()}
        object.__setattr__(self, "columns", columns)

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def taken(self, index: NDArray[np.intp] | NDArray[np.bool_] | slice) -> Table:
        """Some of the rows."""
        segment = None if self.segment is None else self.segment[index]
        return Table({name: values[index] for name, values in self.columns.items()}, self.findings, segment, self.timed)


@contextmanager
def regular_file(path: Path) -> Iterator[Path]:
    """Yields the path itself, or a temporary file with the content of ``-`` (standard input), a named pipe or a URL.

    A URL such as ``s3://`` or ``https://`` is opened by fsspec; with ``s3://`` and the like also a folder. Raises
    LimitError if the content is larger than ``piped_bytes`` (of a file by URL: ``table_bytes``), and RunError if it
    takes more than half of the free disk space, or a URL cannot be read.
    """
    if "\0" in str(path):
        raise RunError(f"{readable(str(path))}: the name has a null character; name a recording")
    url = url_of(path)
    if not url and str(path) != "-" and not path.is_fifo():
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="safedpa-pipe-") as folder:
        copy = Path(folder) / ("stdin" if str(path) == "-" else path.name.partition("?")[0])
        if url:
            _download(url, copy)
        else:
            with sys.stdin.buffer if str(path) == "-" else path.open("rb") as source:
                _copy(source, copy, str(path), _Room("piped_bytes", folder))
        yield copy


class _Room:
    """Bytes that may still be copied to a temporary folder: those of a limit, and half of what is free there."""

    def __init__(self, name: str, folder: str) -> None:
        self._name = name
        free = shutil.disk_usage(folder).free // 2
        self._is_disk, self._left = free < limit(name), min(free, limit(name))

    def take(self, size: int, about: str) -> None:
        """Counts bytes; raises LimitError for more than the limit, and RunError for more than fit on the disk."""
        self._left -= size
        if self._left < 0 and self._is_disk:
            raise RunError(f"{about}: is larger than half of the free disk space; make room, or name a file")
        if self._left < 0:
            raise too_much(self._name, "more", about)


def _copy(source: IO[bytes], copy: Path, name: str, room: _Room) -> None:
    with copy.open("wb") as target:
        while piece := source.read(1 << 20):
            room.take(len(piece), name)
            target.write(piece)


def _download(url: str, copy: Path) -> None:
    store, place = open_store(url)
    try:
        if not url.startswith("http") and store.isdir(place):  # a web server lists no folders
            _download_folder(url, store, place, copy)
            return
        with store.open(place, "rb") as source:
            known = getattr(source, "size", None) is not None
            _copy(source, copy, url, _Room("table_bytes" if known else "piped_bytes", str(copy.parent)))
    except SafedpaError:
        raise
    except Exception as error:  # each store raises its own kinds
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise TransferError(f"{url}: cannot be read ({reason}); check the address, or name a file") from error


def _download_folder(url: str, store: Any, place: str, folder: Path) -> None:
    """Copies the files of a folder, such as a rosbag2 or a dataset; raises RunError for too many of them."""
    room, names = _Room("table_bytes", str(folder.parent)), store.find(place)
    if len(names) > _MAX_FILES:
        raise RunError(f"{url}: has {len(names)} files, wanted at most {_MAX_FILES}; name one of them")
    for name in names:
        parts = name.removeprefix(place).strip("/").split("/")
        if ".." in parts:
            raise RunError(f"{url}: has a file named '{readable(name)}'; wanted names inside the folder")
        copy = folder.joinpath(*parts)
        copy.parent.mkdir(parents=True, exist_ok=True)
        with store.open(name, "rb") as source:
            _copy(source, copy, url, room)


def require_file(path: Path) -> None:
    """Raises RunError if the file is missing or empty."""
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "no such file"
        raise RunError(f"{path}: {what}; {near_files(path)}wanted {WANTED}")
    if path.stat().st_size == 0:
        raise RunError(f"{path}: the file is empty; wanted a recording with a header and rows")


def require_columns(path: Path, wanted: Iterable[str], present: list[str]) -> None:
    """Raises RunError that names the columns that are missing or duplicated."""
    missing = [name for name in wanted if name not in present]
    if missing:
        rest = f" (and {len(missing) - 1} more: {', '.join(missing[1:])})" if len(missing) > 1 else ""
        raise RunError(
            f"{path}: column '{missing[0]}' is missing{rest}; {did_you_mean(missing[0], present)}; "
            f"rename it in the file, or name a column map: 'safedpa columns {path}' proposes one"
        )
    duplicated = [name for name in wanted if present.count(name) > 1]
    if duplicated:
        raise RunError(
            f"{path}: column '{duplicated[0]}' occurs {present.count(duplicated[0])} times; rename the others"
        )
