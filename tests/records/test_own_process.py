"""Readers run in a process of their own, which limits of processor time and memory end."""

import os
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from safedpa.errors import RunError
from safedpa.limits import LimitError
from safedpa.records import load_column_map, load_run
from safedpa.records.readers.preview import raw_rows
from safedpa.robots.car.system import CAR

READERS = """
import os, time
from pathlib import Path
from safedpa.records.readers.own_process import allow_for, in_own_process, iterated_in_own_process

@iterated_in_own_process
def counted(path: Path, most: int):
    for number in range(most): yield number, os.getpid()
    if most > 3: raise ValueError("wrong")
    return "end"

@in_own_process
def process(path: Path) -> int:
    return os.getpid()

@in_own_process
def endless(path: Path) -> None:
    while True: pass

@in_own_process
def sleeping(path: Path) -> None:
    path.write_text(str(os.getpid())); time.sleep(60)

@in_own_process
def large(path: Path) -> None:
    bytearray(1 << 29)

@in_own_process
def unpacked(path: Path) -> int:
    allow_for(1 << 25)
    return len(bytearray(1 << 29))

@in_own_process
def arrays(path: Path):
    import numpy
    return numpy.arange(1e5), numpy.array([True, False, True])

@in_own_process
def crashing(path: Path) -> None:
    os.abort()

@in_own_process
def wrong(path: Path) -> None:
    raise ValueError("wrong")
"""


@pytest.fixture
def readers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "strange_readers.py").write_text(READERS, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "strange_readers", raising=False)
    import strange_readers

    return strange_readers


def test_a_reader_is_ended_by_its_limits_and_the_next_file_is_read(readers, monkeypatch, tmp_path) -> None:
    assert readers.process(tmp_path) != os.getpid()
    with pytest.raises(ValueError, match="wrong"):
        readers.wrong(tmp_path)
    with pytest.raises(LimitError, match=r"bytes of memory to read a file.*reader_bytes=NUMBER"):
        readers.large(tmp_path)
    assert readers.unpacked(tmp_path) == 1 << 29
    with pytest.raises(RunError, match="ended a process"):
        readers.crashing(tmp_path)
    monkeypatch.setenv("SAFEDPA_LIMITS", "reader_milliseconds=50")
    with pytest.raises(LimitError, match=r"ms of processor time.*at most 50; .*reader_milliseconds=NUMBER"):
        readers.endless(tmp_path / "missing")
    assert readers.process(tmp_path) != os.getpid()


def test_what_a_reader_yields_arrives_while_it_reads_and_its_process_ends_with_the_iteration(readers, tmp_path) -> None:
    found = readers.counted(tmp_path, 2)
    assert [next(found)[0], next(found)[0]] == [0, 1]
    with pytest.raises(StopIteration, match="end"):
        next(found)
    with pytest.raises(ValueError, match="wrong"):
        list(readers.counted(tmp_path, 5))
    left = readers.counted(tmp_path, 2)
    worker = Path("/proc") / str(next(left)[1])
    assert worker.exists()
    left.close()
    until = time.monotonic() + 60.0
    while worker.exists() and time.monotonic() < until:
        time.sleep(0.01)
    assert not worker.exists()


def test_ctrl_c_ends_the_reader_too(readers, tmp_path: Path) -> None:
    file = tmp_path / "pid"
    code = f"import strange_readers as readers; readers.sleeping(readers.Path({str(file)!r}))"
    command = [sys.executable, "-c", code]
    with subprocess.Popen(
        command, stderr=subprocess.DEVNULL, env={**os.environ, "PYTHONPATH": str(tmp_path)}
    ) as program:
        until = time.monotonic() + 60.0
        while not (file.is_file() and file.read_text(encoding="utf-8")) and time.monotonic() < until:
            time.sleep(0.05)
        program.send_signal(signal.SIGINT)
        assert program.wait(30.0) != 0
    worker = Path("/proc") / file.read_text(encoding="utf-8")
    while worker.exists() and time.monotonic() < until:
        time.sleep(0.05)
    assert not worker.exists()


def test_an_array_arrives_whole_and_as_one_of_its_own(readers, tmp_path: Path) -> None:
    numbers, flags = readers.arrays(tmp_path)
    numbers += 1.0
    assert numbers.tolist() == list(range(1, 100_001))
    assert flags.tolist() == [True, False, True]


def test_a_table_is_read_without_pandas() -> None:
    code = """
import sys; from pathlib import Path
from safedpa.records.readers.own_process import in_this_process
from safedpa.records.load import read_columns
Path("a.csv").write_text("t,x\\n0,NA\\n1, 2\\n")
with in_this_process(): print(read_columns(Path("a.csv"), ["t", "x"]).columns["x"], "pandas" in sys.modules)
"""
    assert printed(code) == "[nan  2.] False\n"


def test_where_limits_cannot_be_set_files_are_read_with_a_remark() -> None:
    code = """
import sys; from pathlib import Path
from safedpa.records.load import read_columns
Path("a.csv").write_text("t,x\\n0,1\\n")
import pyarrow.csv, pyarrow.compute
sys.platform = "darwin"; sys.stderr = sys.stdout
print(read_columns(Path("a.csv"), ["x"]).columns["x"])
"""
    shown = printed(code)
    assert "log files are read without limits" in shown
    assert "[1.]" in shown


def printed(code: str) -> str:
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-c", code]
        return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize("table", ["topics", "messages", "message_definitions"])
def test_a_bag_whose_table_is_an_endless_view_is_refused(table: str, tmp_path: Path) -> None:
    path = tmp_path / "bag.db3"
    base = sqlite3.connect(path)
    base.execute("CREATE TABLE topics(id INTEGER, name, type, serialization_format)")
    base.execute("CREATE TABLE messages(topic_id, timestamp, data)")
    base.execute(f"DROP TABLE IF EXISTS {table}")
    rows = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT x AS id FROM c ORDER BY 1"
    base.execute(f"CREATE VIEW {table} AS {rows}")
    base.close()
    for read in (raw_rows, lambda file: load_run(file, CAR, load_column_map("f1tenth_bag"))):
        with pytest.raises(RunError, match=f"'{table}' is no plain table"):
            read(path)
