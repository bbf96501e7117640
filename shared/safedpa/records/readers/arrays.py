"""Reads files of named arrays as tables: NumPy archives (``.npz``), MATLAB files (``.mat``) and HDF5 files."""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from safedpa.errors import RunError
from safedpa.extras import need
from safedpa.limits import check_archive, limit, too_much
from safedpa.records.readers.cells import element_of
from safedpa.records.readers.own_process import allow_for
from safedpa.records.readers.table import Table, require_columns, require_file

__all__ = ["arrays_in", "column_names", "read_array_table"]

_HDF5 = b"\x89HDF\r\n\x1a\n"
_MAX_ITEMS, _MAX_DEPTH = 50_000, 12
"""Entries and nested groups of an HDF5 file; a data set of demonstrations has ten for each of some thousand."""
_COMPRESSED = 15
"""Type of a MATLAB variable that is compressed by zlib."""
_PIECE_BYTES = 1 << 20


def read_array_table(path: Path, wanted: Sequence[str]) -> Table:
    """Reads the wanted columns: arrays of one length, or ``state[0]`` of an array with several columns.

    Raises RunError for a file that cannot be read, a missing array, and arrays of different lengths.
    """
    arrays = arrays_in(path)
    elements = {name: found for name in wanted if (found := element_of(name, list(arrays)))}
    sources = {name: elements[name][0] if name in elements else name for name in wanted}
    require_columns(path, list(dict.fromkeys(sources.values())), list(arrays))
    if not zipfile.is_zipfile(path) and _is_hdf5(path):
        arrays = _hdf5_arrays(path, set(sources.values()))
    columns = {name: _column(path, name, arrays[source], elements.get(name)) for name, source in sources.items()}
    lengths = {len(column) for column in columns.values()}
    if len(lengths) > 1:
        raise RunError(f"{path}: its arrays have {', '.join(map(str, sorted(lengths)))} rows; wanted one length")
    return Table(columns)


def arrays_in(path: Path) -> Mapping[str, np.ndarray[Any, Any]]:
    """Every array of numbers in the file, by name; a field of a MATLAB struct is called ``struct.field``.

    Those of an HDF5 file have no values, since it can hold far more than the columns that are wanted.
    """
    require_file(path)
    size = path.stat().st_size
    if size > limit("table_bytes"):
        raise too_much("table_bytes", f"{size} bytes", str(path))
    if zipfile.is_zipfile(path):
        found = _numpy_arrays(path)
    else:
        found = _hdf5_arrays(path, ()) if _is_hdf5(path) else _matlab_arrays(path)
    if not found:
        raise RunError(f"{path}: contains no array of numbers; wanted t, states and actions as arrays")
    if len(found) > limit("columns"):
        raise too_much("columns", len(found), str(path))
    return found


def column_names(arrays: Mapping[str, np.ndarray[Any, Any]]) -> list[str]:
    """The names under which a column map names the columns of arrays."""
    names: list[str] = []
    for name, array in arrays.items():
        names += [name] if array.ndim < 2 else [f"{name}[{place}]" for place in range(array.shape[1])]
    return names


def _numpy_arrays(path: Path) -> dict[str, np.ndarray[Any, Any]]:
    check_archive(path)
    with zipfile.ZipFile(path) as packed:
        allow_for(sum(entry.file_size for entry in packed.infolist()))
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise RunError(f"{path}: cannot be read as a NumPy archive ({str(error)[:100]})") from error
    return {name: array for name, array in arrays.items() if _is_column(array)}


def _matlab_arrays(path: Path) -> dict[str, np.ndarray[Any, Any]]:
    need("sim", what="reading MATLAB files")
    from scipy.io import loadmat

    _check_matlab_size(path)
    try:
        variables = loadmat(path, squeeze_me=True, struct_as_record=False, verify_compressed_data_integrity=True)
    except Exception as error:  # scipy raises errors of many kinds for damaged files
        raise RunError(f"{path}: cannot be read as a MATLAB file ({str(error)[:100]}); save it with -v7") from error
    found: dict[str, np.ndarray[Any, Any]] = {}
    for name, value in variables.items():
        fields = getattr(value, "_fieldnames", None)
        parts = {name: value} if fields is None else {f"{name}.{field}": getattr(value, field) for field in fields}
        found |= {key: part for key, part in parts.items() if isinstance(part, np.ndarray) and _is_column(part)}
    return found


def _check_matlab_size(path: Path) -> None:
    """Raises LimitError if the variables of a MATLAB file expand too much: scipy unpacks each as a whole."""
    size = path.stat().st_size
    most = left = max(limit("expansion_free_bytes"), size * limit("expansion"))
    with path.open("rb") as file:
        order = ">" if file.read(128)[126:] == b"MI" else "<"
        while len(head := file.read(8)) == 8:
            kind, length = struct.unpack(f"{order}II", head)
            end = file.tell() + length
            unpacker = zlib.decompressobj()
            packed = b""
            while kind == _COMPRESSED and (packed or file.tell() < min(end, size)):
                packed = packed or file.read(min(_PIECE_BYTES, end - file.tell()))
                try:
                    left -= len(unpacker.decompress(packed, _PIECE_BYTES))
                except zlib.error:
                    break  # scipy reports the damage
                packed = unpacker.unconsumed_tail
                if left < 0:
                    raise too_much("expansion", "more", str(path))
            file.seek(end)
    allow_for(most - left)


def _is_hdf5(path: Path) -> bool:
    """Whether the file is HDF5, also behind the header of MATLAB 7.3."""
    with path.open("rb") as file:
        start = file.read(520)
    return _HDF5 in (start[:8], start[512:])


def _hdf5_arrays(path: Path, wanted: Collection[str]) -> dict[str, np.ndarray[Any, Any]]:
    """The datasets of numbers by name; only the ``wanted`` ones have values. MATLAB stores arrays transposed."""
    need("hdf5", what="reading HDF5 files")
    import h5py

    found: dict[str, np.ndarray[Any, Any]] = {}
    left = max(limit("expansion_free_bytes"), path.stat().st_size * limit("expansion"))
    try:
        with h5py.File(path, "r") as file:
            matlab = file.userblock_size > 0
            for name, item in _datasets(path, file):
                values = np.broadcast_to(np.empty((), item.dtype), item.shape)
                key = name.replace("/", ".") if matlab else name
                if key in wanted:
                    left -= values.size * max(item.dtype.itemsize, 8)
                    if left < 0:
                        raise too_much("expansion", "more", str(path))
                    allow_for(item.nbytes)
                    values = item[()]
                values = values.T if matlab else values
                found[key] = values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values
    except (OSError, RuntimeError, ValueError, KeyError, TypeError) as error:
        raise RunError(f"{path}: cannot be read as HDF5 ({str(error)[:100]}); it may be cut off: copy it") from error
    return found


def _datasets(path: Path, file: Any) -> Iterator[tuple[str, Any]]:
    """Name and dataset of each column in the file itself; links to other places, and their data, are left out."""
    import h5py

    groups, seen = [("", file, 0)], 0
    while groups:
        prefix, group, depth = groups.pop()
        for name in group:
            seen += 1
            if seen > _MAX_ITEMS or depth > _MAX_DEPTH:
                raise RunError(f"{path}: has more than {_MAX_ITEMS} entries, or more than {_MAX_DEPTH} nested groups")
            if name == "#refs#" or not isinstance(group.get(name, getlink=True), h5py.HardLink):
                continue
            item = group[name]
            if isinstance(item, h5py.Group):
                groups.append((f"{prefix}{name}/", item, depth + 1))
            elif isinstance(item, h5py.Dataset) and _is_column(item) and not item.external and not item.is_virtual:
                yield f"{prefix}{name}", item


def _is_column(array: Any) -> bool:
    """Whether a NumPy array, or a dataset of HDF5, has columns of numbers."""
    return array.ndim in (1, 2) and array.dtype.kind in "fiubmM" and array.size > 0


def _column(
    path: Path, name: str, array: np.ndarray[Any, Any], element: tuple[str, int] | None
) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    if element is not None:
        if array.ndim < 2 or element[1] >= array.shape[1]:
            raise RunError(f"{path}: column '{name}': got an array of shape {array.shape}")
        array = array[:, element[1]]
    if array.ndim > 1:
        raise RunError(f"{path}: column '{name}': got an array of shape {array.shape}; name a column: {name}[0]")
    if array.dtype.kind in "mM":
        return np.asarray(array.astype(f"{array.dtype.kind}8[ns]").astype(np.int64) / 1e9)
    return np.asarray(array, dtype=np.float64)
