"""NumPy archives, MATLAB files and LeRobot datasets."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from safedpa.errors import RunError
from safedpa.records import Run, load_run
from safedpa.records.column_map.file import parse_column_map
from safedpa.records.readers.arrays import read_array_table
from safedpa.records.readers.preview import raw_rows
from safedpa.robots.car.system import CAR
from safedpa_lab.log_faults.drive import NAMES, drive_of

DRIVE = drive_of(2).values


def mapped(path: Path, time: str, state: str, action: str) -> Run:
    sources = [time, *(f"{state}[{k}]" for k in range(4)), *(f"{action}[{k}]" for k in range(2))]
    lines = [f'{name} = "{source}"' for name, source in zip(NAMES, sources, strict=True)]
    return load_run(path, CAR, parse_column_map("\n".join(['format = 1\nrobot = "car"\n[columns]', *lines])))


def assert_whole(run: Run) -> None:
    np.testing.assert_allclose(np.column_stack([run.states, run.actions]), DRIVE[:, 1:], atol=1e-9)
    np.testing.assert_allclose(run.t, DRIVE[:, 0], atol=1e-9)


def matlab(path: Path, variables: dict[str, object]) -> None:
    from scipy.io import savemat

    savemat(path, variables, do_compression=True)


@pytest.mark.parametrize("suffix", [".npz", ".mat"])
def test_arrays_are_columns_by_name_or_by_element(suffix: str, tmp_path: Path) -> None:
    plain, wide = tmp_path / f"plain{suffix}", tmp_path / f"wide{suffix}"
    arrays = {"time": DRIVE[:, 0], "state": DRIVE[:, 1:5], "action": DRIVE[:, 5:]}
    for path, content in ((plain, dict(zip(NAMES, DRIVE.T, strict=True))), (wide, arrays)):
        if suffix == ".npz":
            np.savez_compressed(path, **content)
        else:
            matlab(path, content)
    assert_whole(load_run(plain, CAR))
    assert_whole(mapped(wide, "time", "state", "action"))
    assert raw_rows(wide).names == ("time", *(f"state[{k}]" for k in range(4)), "action[0]", "action[1]")


def test_fields_of_a_matlab_struct_are_columns(tmp_path: Path) -> None:
    matlab(tmp_path / "a.mat", {"log": {"time": DRIVE[:, 0], "state": DRIVE[:, 1:5], "action": DRIVE[:, 5:]}})
    assert_whole(mapped(tmp_path / "a.mat", "log.time", "log.state", "log.action"))


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ({"t": [0.0, 1.0], "x": [0.0]}, "its arrays have 1, 2 rows; wanted one length"),
        ({"t": [0.0], "x": [[1.0, 2.0]]}, r"column 'x': got an array of shape \(1, 2\); name a column: x\[0\]"),
        ({"t": [0.0]}, "column 'x' is missing"),
        ({"t": ["a"]}, "contains no array of numbers"),
        ({"t": np.array([None])}, "cannot be read as a NumPy archive"),
    ],
)
def test_arrays_that_are_no_columns_are_refused(content: dict[str, list[float]], problem: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", **content)
    with pytest.raises(RunError, match=problem):
        read_array_table(tmp_path / "a.npz", ("t", "x"))


def test_other_files_are_named_with_the_remedy(tmp_path: Path) -> None:
    for content, problem in {
        b"MATLAB 7.3 MAT-file": "a MATLAB file of version 7.3; save it with -v7",
        b"TDSm\x0e\0\0\0": "a TDMS file; write its channels as CSV or Parquet: npTDMS reads them",
        b"MATLAB 5.0 MAT-file, damaged": "cannot be read as a MATLAB file",
    }.items():
        (tmp_path / "a.mat").write_bytes(content)
        with pytest.raises(RunError, match=problem):
            load_run(tmp_path / "a.mat", CAR)


def test_the_episodes_of_a_dataset_are_segments(tmp_path: Path) -> None:
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text(json.dumps({"codebase_version": "v2.1"}))
    for number, rows in enumerate((slice(0, 150), slice(150, 400))):
        part = DRIVE[rows]
        file = tmp_path / "data" / "chunk-000" / f"episode_{number:06d}.parquet"
        file.parent.mkdir(parents=True, exist_ok=True)
        columns = {
            "timestamp": part[:, 0] - part[0, 0],
            "observation.state": list(part[:, 1:5]),
            "action": list(part[:, 5:]),
        }
        parquet.write_table(pa.table({**columns, "episode_index": np.full(len(part), number)}), file)
    run = mapped(tmp_path, "timestamp", "observation.state", "action")
    assert [len(part) for part in run.stretches] == [150, 250]
    np.testing.assert_allclose(np.column_stack([run.states, run.actions]), DRIVE[:, 1:], atol=1e-9)
    assert "observation.state[3]" in raw_rows(tmp_path).names
    for file in (tmp_path / "data").rglob("*.parquet"):
        file.unlink()
    with pytest.raises(RunError, match="is a LeRobot dataset without data"):
        load_run(tmp_path, CAR)
