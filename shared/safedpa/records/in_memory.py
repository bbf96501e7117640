"""Makes runs of data in memory: arrays and data frames, with the checks of a file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safedpa.errors import InputError, RunError
from safedpa.limits import readable
from safedpa.records.column_map.apply import check_map, mapped_rows
from safedpa.records.column_map.column_map import native_map
from safedpa.records.column_map.file import column_map_of
from safedpa.records.quality.quality import run_of_rows
from safedpa.records.readers.table import Table, require_columns
from safedpa.records.run import RawRows, Run
from safedpa.systems import System
from safedpa.systems.robots import robot_named

__all__ = ["run_of_arrays", "run_of_frame", "system_of"]


def system_of(source: Any) -> System:
    """Returns a system: itself, that of a model, or that of a robot by its name. Raises InputError."""
    found = robot_named(source).system if isinstance(source, str) else getattr(source, "system", source)
    if not isinstance(found, System):
        raise InputError(f"system: got {type(source).__name__}, wanted a System, a model or the name of a robot")
    return found


def run_of_arrays(t: ArrayLike, states: ArrayLike, actions: ArrayLike, source: Any, name: str) -> Run:
    """As ``Run.from_arrays``."""
    system = system_of(source)
    time = _numbers(t, name, "t")
    wanted = {"states": (states, system.state_names), "actions": (actions, system.action_names)}
    found = {}
    for what, (values, names) in wanted.items():
        found[what] = _numbers(values, name, what)
        if time.ndim != 1 or found[what].shape != (len(time), len(names)):
            raise RunError(
                f"{name}: {what}: got shape {found[what].shape} with t of shape {time.shape}, wanted one row per time "
                f"and the columns {', '.join(names)}"
            )
    # Copies: a run is immutable, and the caller may change the arrays.
    rows = RawRows(time.copy(), found["states"].copy(), found["actions"].copy())
    return _named(run_of_rows(Path(name), system, native_map(system), rows, ()), name)


def run_of_frame(frame: Any, source: Any, columns: Any, name: str) -> Run:
    """As ``Run.from_dataframe``."""
    system = system_of(source)
    mapping = column_map_of(columns, system)
    check_map(mapping, system)
    require_columns(Path(name), mapping.sources, _names(frame))
    table = Table({source: _numbers(frame[source], name, source) for source in mapping.sources})
    return _named(run_of_rows(Path(name), system, mapping, *mapped_rows(table, mapping, system)), name)


def _named(run: Run, name: str) -> Run:
    return replace(run, name=readable(name))  # the whole name: that of a file would lose its ending


def _names(frame: Any) -> list[str]:
    for attribute in ("column_names", "columns"):  # of Arrow tables; of pandas and polars
        if hasattr(frame, attribute):
            return [str(column) for column in getattr(frame, attribute)]
    if isinstance(frame, Mapping):
        return [str(column) for column in frame]
    raise RunError(f"frame: got {type(frame).__name__}, wanted a data frame, an Arrow table or a dictionary of columns")


def _numbers(values: Any, name: str, column: str) -> NDArray[np.float64]:
    """Returns an array of numbers; dates become seconds since 1970, missing values NaN."""
    try:
        array = np.asarray(values)
        if array.dtype.kind in "mM":  # dates and durations
            missing = np.isnat(array)
            kind = "datetime64[ns]" if array.dtype.kind == "M" else "timedelta64[ns]"
            return np.where(missing, np.nan, array.astype(kind).astype(np.int64) / 1e9)
        return np.asarray(values if array.dtype.kind == "O" else array, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise RunError(f"{name}: column '{column}': {' '.join(str(error).split())[:120]}; wanted numbers") from error
