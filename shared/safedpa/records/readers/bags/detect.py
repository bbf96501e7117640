"""Detects the kind of a file by its first bytes; the error for another kind of file names that kind."""

from __future__ import annotations

import gzip
import zlib
from pathlib import Path

from safedpa.errors import RunError, near_files
from safedpa.limits import readable
from safedpa.records.readers.bags.rosbag1 import MAGIC as ROS1
from safedpa.records.readers.bags.rosbag1 import Ros1Bag
from safedpa.records.readers.bags.rosbag2 import MAGIC as SQLITE
from safedpa.records.readers.bags.rosbag2 import (
    FolderBag,
    McapBag,
    PackedBag,
    SqliteBag,
    is_bag_folder,
    is_recording_of_the_bus,
)
from safedpa.records.readers.bags.topics import AbstractLog
from safedpa.records.readers.bags.ulog import MAGIC as ULOG
from safedpa.records.readers.bags.ulog import UlogLog
from safedpa.records.readers.dialect import GZIP
from safedpa.records.readers.own_process import in_own_process
from safedpa.records.readers.parquet import is_dataset
from safedpa.records.readers.table import WANTED

__all__ = ["kind_of", "topic_log"]

_ARRAYS, _ZIP = (b"MATLAB 5.0", b"MATLAB 7.3", b"\x89HDF"), b"PK\x03\x04"
_MCAP, _PARQUET, _ZSTD = b"\x89MCAP0\r\n", b"PAR1", b"\x28\xb5\x2f\xfd"
_OTHERS: tuple[tuple[bytes, str, str], ...] = (
    (b"#ROSBAG V1", "a ROS 1 bag of format 1", "convert it to format 2.0: rosbag fix"),
    (b"BZh", "packed by bzip2", "unpack it: bunzip2"),
    (b"\xfd7zXZ", "packed by xz", "unpack it: unxz"),
    (b"\x04\x22\x4d\x18", "packed by lz4", "unpack it: lz4 -d"),
    (b"PK\x03\x04", "a zip archive, or a spreadsheet", "unpack it, or save the sheet as CSV"),
    (b"MATLAB", "a MATLAB file", "write its columns as CSV: writetable"),
    (b"TDSm", "a TDMS file", "write its channels as CSV: nptdms.TdmsFile(FILE).as_dataframe().to_csv(OUT)"),
    (b"\x93NUMPY", "a NumPy array", "write its columns as CSV: numpy.savetxt with a header"),
    (b"ARROW1", "an Arrow file", "write it as Parquet"),
    (b"RRF", "a Rerun recording", "name the log that it was made from"),
    (b"\xa3\x95", "an ArduPilot log", "write its messages as CSV: mavlogdump.py --format csv"),
    (b"\x80\x04\x95", "a Python pickle, which is never opened", "write its columns as CSV"),
    (b"%PDF", "a PDF document", "name the log itself"),
    (b"\x89PNG", "a picture", "name the log itself"),
    (b"\xff\xd8\xff", "a picture", "name the log itself"),
    (b"\x7fELF", "a program", "name a log"),
)


@in_own_process
def kind_of(path: Path) -> str:
    """Returns csv, parquet, arrays (NumPy or MATLAB), dataset (of LeRobot), mcap or topics.

    An mcap is a recording of the bus; topics, a bag or a flight log, need a column map.

    Raises RunError if the file is missing, empty or of another kind, which the message names.
    """
    if any("\ud800" <= sign <= "\udfff" for sign in str(path)):
        raise RunError(f"{readable(str(path))}: its name is not UTF-8, as the table readers require; rename it")
    if path.is_dir():
        return _kind_of_folder(path)
    if not path.is_file():
        raise RunError(f"{path}: no such file; {near_files(path)}wanted {WANTED}")
    with path.open("rb") as file:
        start = file.read(128)
    if not start:
        raise RunError(f"{path}: the file is empty; wanted a recording with a header and rows")
    kind = _kind_of_content(path, start)
    if kind:
        return kind
    if path.name == "metadata.yaml":
        raise RunError(f"{path}: is the metadata of a bag; name its folder, {path.parent}")
    _refuse_others(path, start)
    if start.startswith(GZIP):
        _check_packed(path)
    return "csv"


def _kind_of_folder(path: Path) -> str:
    if is_dataset(path):
        return "dataset"
    if is_bag_folder(path):
        return "topics"
    raise RunError(f"{path}: is a folder without a bag; {near_files(path)}wanted {WANTED}")


def _kind_of_content(path: Path, start: bytes) -> str:
    """The kind by the first bytes, or by a suffix whose reader reports what is wrong; empty for a table of text."""
    suffix = path.suffix.lower()
    if start.startswith(_MCAP):
        return "mcap" if is_recording_of_the_bus(path) else "topics"
    if start.startswith((ROS1, SQLITE, ULOG)) or path.name.endswith((".mcap.zstd", ".db3.zstd")):
        return "topics"
    if suffix == ".mcap":
        return "mcap"
    if start.startswith(_PARQUET) or suffix == ".parquet":
        return "parquet"
    if start.startswith(_ARRAYS) or (start.startswith(_ZIP) and suffix == ".npz"):
        return "arrays"
    return ""


def _check_packed(path: Path) -> None:
    """Raises RunError unless a file that is packed by gzip holds a text."""
    try:
        with gzip.open(path) as packed:
            start = packed.read(512)
    except (EOFError, OSError, zlib.error) as error:
        raise RunError(f"{path}: cannot be unpacked by gzip ({error}); it may be cut off: copy it again") from error
    is_text = not start.startswith((_MCAP, _PARQUET, ROS1, SQLITE, ULOG, *(magic for magic, *_ in _OTHERS)))
    if not is_text or start[257:262] == b"ustar":
        raise RunError(f"{path}: is packed by gzip and no CSV file; unpack it: gunzip; wanted {WANTED}")


def _refuse_others(path: Path, start: bytes) -> None:
    for magic, what, fix in _OTHERS:
        if start.startswith(magic):
            raise RunError(f"{path}: is {what}; {fix}, or name {WANTED}")
    if start.startswith(_ZSTD):
        raise RunError(f"{path}: is packed by zstd; unpack it, or rename it to NAME.mcap.zstd; wanted {WANTED}")
    suffix = path.suffix.lower()
    if suffix in (".bag", ".db3", ".ulg"):
        what = {".bag": "ROS 1 bag", ".db3": "rosbag2 in SQLite", ".ulg": "PX4 flight log"}[suffix]
        raise RunError(f"{path}: has the suffix {suffix}, but is no {what}; copy it again, or name {WANTED}")


def topic_log(path: Path) -> AbstractLog:
    """Opens the log in a file or folder for which ``kind_of`` returns topics."""
    if path.is_dir():
        return FolderBag(path)
    with path.open("rb") as file:
        start = file.read(16)
    if path.name.endswith(".zstd"):
        return PackedBag(path)
    if start.startswith(ROS1):
        return Ros1Bag(path)
    if start.startswith(ULOG):
        return UlogLog(path)
    return SqliteBag(path) if start.startswith(SQLITE) else McapBag(path)
