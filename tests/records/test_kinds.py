"""The kind of a file by its first bytes and its name; files that are no recordings are refused with advice."""

from pathlib import Path

import pytest

from safedpa.errors import RunError
from safedpa.records import load_run
from safedpa.records.readers.bags.detect import kind_of
from safedpa.robots.car.system import CAR

OTHERS = {
    "#ROSBAG V1": "is a ROS 1 bag of format 1; convert it to format 2.0: rosbag fix",
    "\x1f\x8b": "cannot be unpacked by gzip (",
    "BZh": "is packed by bzip2; unpack it: bunzip2",
    "\xfd7zXZ": "is packed by xz; unpack it: unxz",
    "\x04\x22\x4d\x18": "is packed by lz4; unpack it: lz4 -d",
    "PK\x03\x04": "is a zip archive, or a spreadsheet; unpack it, or save the sheet as CSV",
    "MATLAB": "is a MATLAB file; write its columns as CSV",
    "\x93NUMPY": "is a NumPy array; write its columns as CSV",
    "ARROW1": "is an Arrow file; write it as Parquet",
    "RRF": "is a Rerun recording; name the log",
    "\xa3\x95": "is an ArduPilot log; write its messages as CSV",
    "\x80\x04\x95": "is a Python pickle, which is never opened",
    "%PDF": "is a PDF document; name the log itself",
    "\x89PNG": "is a picture; name the log itself",
    "\xff\xd8\xff": "is a picture; name the log itself",
    "\x7fELF": "is a program; name a log",
    "\x28\xb5\x2f\xfd": "is packed by zstd; unpack it, or rename it to NAME.mcap.zstd; wanted a recording",
}


@pytest.mark.parametrize("start", OTHERS)
def test_a_file_of_another_program_is_refused_whatever_its_name(start: str, tmp_path: Path) -> None:
    for name in ("a.csv", "a", "a.txt"):
        (tmp_path / name).write_bytes(start.encode("latin-1") + b" " * 200)
        with pytest.raises(RunError) as caught:
            kind_of(tmp_path / name)
        assert str(caught.value).startswith(f"{tmp_path / name}: {OTHERS[start]}")
    (tmp_path / "a.csv").write_bytes(start[:-1].encode("latin-1"))  # one byte less is none of these
    assert kind_of(tmp_path / "a.csv") == "csv"


@pytest.mark.parametrize(
    ("name", "start", "kind"),
    [
        ("a.CSV", b"t,x\n", "csv"),
        ("a.txt", b"t,x\n", "csv"),
        ("metadata.yml", b"t,x\n", "csv"),
        ("a", b"#ROSBAG V2.0\n", "topics"),
        ("a.csv", b"SQLite format 3\0", "topics"),
        ("a.csv", b"ULog\x01\x12\x35\x01", "topics"),
        ("a.mcap.zstd", b"\x28\xb5\x2f\xfd", "topics"),
        ("a.db3.zstd", b"\x28\xb5\x2f\xfd", "topics"),
        ("a.csv", b"PAR1", "parquet"),
        ("a.parquet", b"t,x\n", "parquet"),
        ("a.PARQUET", b"t,x\n", "parquet"),
        ("a.mcap", b"t,x\n", "mcap"),
    ],
)
def test_the_first_bytes_decide_before_the_ending(name: str, start: bytes, kind: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(start)
    assert kind_of(tmp_path / name) == kind


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("a.bag", "has the suffix .bag, but is no ROS 1 bag; copy it"),
        ("A.BAG", "has the suffix .bag, but is no ROS 1 bag; copy it"),
        ("a.db3", "has the suffix .db3, but is no rosbag2 in SQLite; copy it"),
        ("a.ulg", "has the suffix .ulg, but is no PX4 flight log; copy it"),
        ("metadata.yaml", "is the metadata of a bag; name its folder, "),
        ("empty.csv", "the file is empty; wanted a recording with a header and rows"),
        ("none.csv", "no such file; "),
        ("folder", "is a folder without a bag; "),
        ("a\udcff.csv", "its name is not UTF-8, as the table readers require; rename it"),
        ("a\u00e4\uffff.csv", "no such file"),
    ],
)
def test_a_path_that_is_no_recording_is_refused(name: str, problem: str, tmp_path: Path) -> None:
    path = tmp_path / name
    if name == "folder":
        path.mkdir()
    elif name.isascii() and not name.startswith("none"):
        path.write_text("" if name.startswith("empty") else "t,x\n0,1\n", encoding="utf-8")
    with pytest.raises(RunError, match=f": {problem}"):
        kind_of(path)


@pytest.mark.parametrize(
    ("path", "problem"),
    [("/proc/self/mem", "cannot be read .Input/output error."), ("a\0b.csv", "the name has a null character")],
)
def test_what_cannot_be_opened_or_read_is_refused(path: str, problem: str) -> None:
    with pytest.raises(RunError, match=problem):
        load_run(path, CAR)
