"""NumPy archives, MATLAB files and LeRobot datasets."""

import json
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import fsspec
import h5py
import numpy as np
import pyarrow as pa
import pytest
from fsspec.implementations.memory import MemoryFileSystem
from pyarrow import parquet

from safedpa.errors import RunError
from safedpa.limits import LimitError
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


def hdf5(path: Path, variables: dict[str, np.ndarray], *, of_matlab: bool = False) -> None:
    """MATLAB 7.3 has its header in front, each array transposed, and vectors as matrices."""
    with h5py.File(path, "w", userblock_size=512 if of_matlab else 0) as file:
        for name, values in variables.items():
            content = np.atleast_2d(values.T) if of_matlab else values
            file.create_dataset(name, data=content, chunks=True, compression="gzip")
        file.create_dataset("camera", (1000, 480, 640), dtype="u1", chunks=(1, 480, 640))
    if of_matlab:
        content = path.read_bytes()
        path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + content[512:])


@pytest.mark.parametrize("suffix", [".npz", ".mat", ".h5", ".7.3.mat"])
def test_arrays_are_columns_by_name_or_by_element(suffix: str, tmp_path: Path) -> None:
    plain, wide = tmp_path / f"plain{suffix}", tmp_path / f"wide{suffix}"
    arrays = {"time": DRIVE[:, 0], "state": DRIVE[:, 1:5], "action": DRIVE[:, 5:]}
    for path, content in ((plain, dict(zip(NAMES, DRIVE.T, strict=True))), (wide, arrays)):
        if suffix == ".npz":
            np.savez_compressed(path, **content)
        elif suffix == ".mat":
            matlab(path, content)
        else:
            hdf5(path, content, of_matlab=suffix == ".7.3.mat")
    assert_whole(load_run(plain, CAR))
    assert_whole(mapped(wide, "time", "state", "action"))
    assert set(raw_rows(wide).names) == {"time", *(f"state[{k}]" for k in range(4)), "action[0]", "action[1]"}


def test_an_hdf5_file_reads_no_other_file_and_no_more_than_it_holds(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["t"] = DRIVE[:, 0]
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["t"] = h5py.ExternalLink("other.h5", "t")
        file.create_dataset("x", (1 << 40,), dtype="f8", chunks=(1 << 16,))
    with pytest.raises(RunError, match="column 't' is missing"):
        read_array_table(tmp_path / "a.h5", ("t", "x"))
    with pytest.raises(LimitError, match="expansion factor"):
        read_array_table(tmp_path / "a.h5", ("x",))


def test_a_log_is_read_by_its_url(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", **dict(zip(NAMES, DRIVE.T, strict=True)))
    handler = partial(SimpleHTTPRequestHandler, directory=tmp_path)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever).start()
        url = f"http://127.0.0.1:{server.server_port}/a.npz"
        try:
            assert_whole(load_run(url, CAR))
            assert_whole(load_run(Path(url), CAR))  # a path has one slash
            assert raw_rows(url).names[0] == "t"
            with pytest.raises(RunError, match=f"^{url}x: cannot be read"):
                load_run(f"{url}x", CAR)
        finally:
            server.shutdown()


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
        b"MATLAB 7.3 MAT-file, damaged": "cannot be read as a MATLAB file",
        b"\x89HDF\r\n\x1a\n, damaged": "cannot be read as HDF5",
        b"TDSm\x0e\0\0\0": r"a TDMS file; write its channels as CSV: nptdms.TdmsFile\(FILE\)",
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


class Bucket(MemoryFileSystem):
    """A store in memory under the address of one in the cloud."""

    protocol = "hf"

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return f"/{path.removeprefix('hf://').strip('/')}"


def test_a_folder_is_read_by_its_url() -> None:
    fsspec.register_implementation("hf", Bucket, clobber=True)
    bucket = fsspec.filesystem("hf")
    columns = pa.table({name: DRIVE[:, k] for k, name in enumerate(NAMES)})
    with bucket.open("/set/data/chunk-000/a.parquet", "wb") as file:
        parquet.write_table(columns, file)
    with bucket.open("/set/meta/info.json", "w") as file:
        file.write("{}")
    assert_whole(load_run("hf://set", CAR))
    assert raw_rows("hf://set").names == NAMES
    with pytest.raises(RunError, match=r"^hf://other: cannot be read"):
        load_run("hf://other", CAR)
