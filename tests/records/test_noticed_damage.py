"""Damage without a checksum, and tables that are not what their first line says, are noticed."""

import gzip
from pathlib import Path

import numpy as np
import pyarrow
import pytest
from pyarrow import parquet

from safedpa.errors import RunError
from safedpa.records import Run, load_run
from safedpa.robots.car.system import CAR

NAMES = ("t", "x", "y", "yaw", "speed", "target_speed", "steer")
T = 0.05 * np.arange(400)
SPEED = 1.2 + 0.2 * np.sin(1.3 * T)
YAW = 0.4 * np.sin(0.7 * T)
POSITION = np.cumsum(0.05 * SPEED[:, None] * np.column_stack([np.cos(YAW), np.sin(YAW)]), axis=0)
DRIVE = np.column_stack([T, POSITION, YAW, SPEED, SPEED + 0.09 * np.cos(1.3 * T), 0.07 * np.cos(0.7 * T)])
LINES = [",".join(f"{value:.9g}" for value in row) for row in DRIVE]


def csv(path: Path, *lines: str) -> Path:
    data = ("\n".join(lines) + "\n").encode()
    path.write_bytes(gzip.compress(data) if path.suffix == ".gz" else data)
    return path


def kinds(run: Run) -> list[str]:
    return [item.kind for item in run.findings]


def test_rows_below_a_header_of_another_order_are_left_out(tmp_path: Path) -> None:
    other = ",".join([NAMES[0], NAMES[2], NAMES[1], *NAMES[3:]])
    run = load_run(csv(tmp_path / "a.csv", ",".join(NAMES), *LINES[:200], other, *LINES[200:]), CAR)
    assert len(run.t) == 200
    assert "line 202 is a header with other columns: the 200 rows below it" in run.findings[0].message
    run = load_run(csv(tmp_path / "b.csv", ",".join(NAMES), *LINES[:200], ",".join(NAMES), *LINES[200:]), CAR)
    assert len(run.t) == 400


def test_a_few_texts_among_numbers_lose_their_lines_and_many_are_refused(tmp_path: Path) -> None:
    texts = ["Total,400,,,,,", "20.0,ERR,0,0,1,1,0"]
    run = load_run(csv(tmp_path / "a.csv", ",".join(NAMES), *LINES, *texts), CAR)
    assert (len(run.t), kinds(run)) == (400, ["malformed_line"])
    with pytest.raises(RunError, match="column 'x': got 'ERR', wanted a number"):
        load_run(csv(tmp_path / "b.csv", ",".join(NAMES), *LINES, *[texts[1]] * 20), CAR)


def test_a_packed_table_is_read_up_to_its_damage(tmp_path: Path) -> None:
    path = csv(tmp_path / "a.csv.gz", ",".join(NAMES), *LINES)
    path.write_bytes(path.read_bytes()[:-3000])
    run = load_run(path, CAR)
    assert kinds(run)[0] == "cut_off"
    assert 100 < len(run.t) < 400


def test_days_and_a_first_line_of_dates_are_named(tmp_path: Path) -> None:
    days = [f"{46_000 + t / 86_400:.10f},{line.partition(',')[2]}" for t, line in zip(T, LINES, strict=True)]
    with pytest.raises(RunError, match=r"looks like days.*multiply it by 86400"):
        load_run(csv(tmp_path / "a.csv", ",".join(NAMES), *days), CAR)
    with pytest.raises(RunError, match="has no header: line 1 holds numbers"):
        load_run(csv(tmp_path / "b.csv", *[f"2026-03-29 00:59:5{line}" for line in LINES[:9]]), CAR)


@pytest.mark.parametrize(("name", "count"), [("speed", 1), ("speed", 30), ("x", 30), ("target_speed", 30)])
def test_zeros_over_rows_of_a_column_are_cut(name: str, count: int, tmp_path: Path) -> None:
    path, place = tmp_path / "a.parquet", NAMES.index(name)
    table = pyarrow.table({key: DRIVE[:, k] for k, key in enumerate(NAMES)})
    parquet.write_table(table, path, compression="none", use_dictionary=False)
    assert kinds(load_run(path, CAR)) == []
    data = path.read_bytes()
    column = DRIVE[200 : 200 + count, place].tobytes()
    path.write_bytes(data.replace(column, bytes(len(column)), 1))
    run = load_run(path, CAR)
    assert {"frozen", "jump", "damaged"} & set(kinds(run))
    rows = np.searchsorted(T, run.t - 1e-6)
    np.testing.assert_allclose(np.column_stack([run.states, run.actions]), DRIVE[rows, 1:], atol=1e-9)
    assert len(run.t) >= 400 - count - 5
