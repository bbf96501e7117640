"""What a file is, by its first bytes and its name: each kind that is no recording is told with what to do."""

from __future__ import annotations

from pathlib import Path

import pytest

from safedpa.errors import RunError
from safedpa.records.bags.kinds import kind_of

OTHERS = {
    "#ROSBAG V1": "is a ROS 1 bag of format 1; bring it up to format 2.0: rosbag fix",
    "\x1f\x8b": "is packed by gzip; unpack it: gunzip",
    "BZh": "is packed by bzip2; unpack it: bunzip2",
    "\xfd7zXZ": "is packed by xz; unpack it: unxz",
    "\x04\x22\x4d\x18": "is packed by lz4; unpack it: lz4 -d",
    "PK\x03\x04": "is a zip archive, or a spreadsheet; unpack it, or save the sheet as CSV",
    "\x89HDF": "is an HDF5 file; write its columns as CSV or Parquet",
    "MATLAB": "is a MATLAB file; write its columns as CSV: writetable",
    "\x93NUMPY": "is a NumPy array; write its columns as CSV: numpy.savetxt with a header",
    "ARROW1": "is an Arrow file; write it as Parquet",
    "RRF": "is a Rerun recording; name the log that it was made from",
    "\xa3\x95": "is an ArduPilot log; write its messages as CSV: mavlogdump.py --format csv",
    "\x80\x04\x95": "is a Python pickle, which is never opened; write its columns as CSV",
    "%PDF": "is a PDF document; name the log itself",
    "\x89PNG": "is a picture; name the log itself",
    "\xff\xd8\xff": "is a picture; name the log itself",
    "\x7fELF": "is a program; name a log",
    "\x28\xb5\x2f\xfd": "is packed by zstd; unpack it, or call it NAME.mcap.zstd; wanted a recording",
}


@pytest.mark.parametrize("name", ["a.csv", "a", "a.txt"])
@pytest.mark.parametrize("start", OTHERS)
def test_what_begins_as_something_else_is_told_whatever_its_name(start: str, name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(start.encode("latin-1") + b" " * 200)
    with pytest.raises(RunError) as caught:
        kind_of(path)
    assert str(caught.value).startswith(f"{path}: {OTHERS[start]}")


@pytest.mark.parametrize("start", OTHERS)
def test_one_byte_less_is_none_of_these(start: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(start[:-1].encode("latin-1"))
    assert kind_of(path) == "csv"


@pytest.mark.parametrize(
    ("name", "what"),
    [("a.bag", "ROS 1 bag"), ("a.db3", "rosbag2 in SQLite"), ("a.ulg", "PX4 flight log"), ("A.BAG", "ROS 1 bag")],
)
def test_a_bag_by_its_name_alone_is_refused(name: str, what: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text("t,x\n0,1\n", encoding="utf-8")
    with pytest.raises(
        RunError, match=f"is called {path.suffix.lower()}, but is no {what}; copy it once more, or name"
    ):
        kind_of(path)


@pytest.mark.parametrize(
    ("name", "start", "kind"),
    [
        ("a.csv", b"t,x\n", "csv"),
        ("a.CSV", b"t,x\n", "csv"),
        ("a.txt", b"t,x\n", "csv"),
        ("a", b"#ROSBAG V2.0\n", "topics"),
        ("a.csv", b"SQLite format 3\0", "topics"),
        ("a.csv", b"ULog\x01\x12\x35\x01", "topics"),
        ("a.csv", b"PAR1", "parquet"),
        ("a.parquet", b"t,x\n", "parquet"),
        ("a.PARQUET", b"t,x\n", "parquet"),
        ("a.mcap", b"t,x\n", "mcap"),
        ("a.mcap.zstd", b"\x28\xb5\x2f\xfd", "topics"),
        ("a.db3.zstd", b"\x28\xb5\x2f\xfd", "topics"),
        ("metadata.yml", b"t,x\n", "csv"),
    ],
)
def test_the_first_bytes_decide_and_then_the_ending(name: str, start: bytes, kind: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(start)
    assert kind_of(tmp_path / name) == kind


def test_what_is_not_there_or_empty_or_a_bag_s_metadata_is_told(tmp_path: Path) -> None:
    (tmp_path / "empty.csv").touch()
    (tmp_path / "metadata.yaml").write_text("rosbag2", encoding="utf-8")
    (tmp_path / "folder").mkdir()
    for name, said in {
        "none.csv": "no such file; ",
        "empty.csv": "the file is empty; wanted a recording with a header and rows",
        "metadata.yaml": f"is the metadata of a bag; name its folder, {tmp_path}",
        "folder": "is a folder without a bag; ",
    }.items():
        with pytest.raises(RunError, match=f": {said}"):
            kind_of(tmp_path / name)


def test_a_name_that_is_not_utf_8_is_told(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"its name is not UTF-8, which readers of tables want; rename it"):
        kind_of(tmp_path / "a\udcff.csv")
    with pytest.raises(RunError, match=r"no such file"):
        kind_of(tmp_path / "a\u00e4\uffff.csv")
