"""What is exactly as large as the limit is read, and one more is refused, with the limit's name."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet
from tests.records.ros_logs import bag

from safedpa.limits import LimitError
from safedpa.records.readers.bags import topic_log
from safedpa.records.readers.csv import read_csv_table
from safedpa.records.readers.parquet import read_parquet_table

FORMS = ("mcap", "db3", "bag")
ROWS = 20


def bag_file(folder: Path, form: str) -> Path:
    """The file itself, without its metadata."""
    made = bag(folder / "drive", form, ROWS)
    return next(made.glob(f"*.{form}")) if made.is_dir() else made


def csv_file(folder: Path) -> Path:
    path = folder / "a.csv"
    path.write_text("t,x,y\n" + "".join(f"{k},1,2\n" for k in range(ROWS)), encoding="utf-8")
    return path


def parquet_file(folder: Path) -> Path:
    path = folder / "a.parquet"
    columns = {name: np.arange(float(ROWS)) for name in ("t", "x", "y")}
    parquet.write_table(pa.table(columns), path)
    return path


def refused_below(monkeypatch: pytest.MonkeyPatch, name: str, size: int, read: Any) -> None:
    """At this size it is read, and refused where one less is allowed."""
    monkeypatch.setenv("SAFEDPA_LIMITS", f"{name}={size}")
    read()
    monkeypatch.setenv("SAFEDPA_LIMITS", f"{name}={size - 1}")
    with pytest.raises(LimitError, match=f"wanted at most {size - 1}; .*{name}"):
        read()


@pytest.mark.parametrize("form", FORMS)
def test_the_size_of_a_bag_is_limited(form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = bag_file(tmp_path, form)
    refused_below(monkeypatch, "bag_bytes", path.stat().st_size, lambda: topic_log(path).topics())


@pytest.mark.parametrize("form", ["db3", "bag"])
def test_the_number_of_topics_of_a_bag_is_limited(form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Odometry and commands."""
    path = bag_file(tmp_path, form)
    refused_below(monkeypatch, "bag_topics", 2, lambda: topic_log(path).topics())


@pytest.mark.parametrize("form", FORMS)
def test_the_number_of_messages_read_from_a_bag_is_limited(form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = bag_file(tmp_path, form)
    count = topic_log(path).topics()["/odom"].count
    wanted = {"/odom": ("pose.pose.position.x",)}
    refused_below(monkeypatch, "bag_messages", count, lambda: topic_log(path).series(wanted))


@pytest.mark.parametrize(("made", "read"), [(csv_file, read_csv_table), (parquet_file, read_parquet_table)])
@pytest.mark.parametrize("name", ["table_bytes", "columns"])
def test_bytes_and_columns_of_a_table_are_limited(made, read, name, tmp_path, monkeypatch):
    path = made(tmp_path)
    size = 3 if name == "columns" else path.stat().st_size
    refused_below(monkeypatch, name, size, lambda: read(path, ["t", "x"]))
