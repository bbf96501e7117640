"""What the functions accept: a model, recordings and column maps, each as an object or as a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeAlias

from safedpa.comparison.comparison import with_distinct_names
from safedpa.dynamics import PhysicsModel, load_model, load_user_file
from safedpa.errors import InputError
from safedpa.extras import need
from safedpa.progress import progress
from safedpa.records import ColumnMap, load_run
from safedpa.records.column_map.file import column_map_of
from safedpa.records.run import Run
from safedpa.records.store import matching, url_of
from safedpa.systems import System

__all__ = ["Columns", "Logs", "Model", "files_of", "model_of", "read_log", "runs_of", "title_of"]

Model: TypeAlias = PhysicsModel | str | Path
"""A model, its file, or the name of one that ships."""
Logs: TypeAlias = Run | str | Path | Sequence[Run | str | Path]
"""One or several recordings: runs or files."""


class _HasColumnMap(Protocol):
    @property
    def column_map(self) -> ColumnMap: ...


Columns: TypeAlias = ColumnMap | _HasColumnMap | Mapping[str, Any] | str | Path | None
"""A column map, the result of ``columns()``, ``[columns]`` as a dictionary, a file or shipped name, or None."""


def read_log(log: str | Path, model: Model | System, columns: Columns = None) -> Run:
    """Reads a recording: a table, a ROS bag, a PX4 flight log, or a recording of the bus.

    A table is CSV (also ``.csv.gz``), Parquet, NumPy ``.npz``, MATLAB ``.mat``, HDF5, or a LeRobot dataset; a bag is
    rosbag2 (MCAP, SQLite, folder) or ROS 1. ``log`` is a path, a URL such as ``s3://``, or ``-`` for standard input.
    ``model`` says which states and actions the log has. Without ``columns`` the columns have the native names: ``t``
    [s], then states and actions in SI units. ``columns`` is a column map: a file, a shipped name, the result of
    ``columns()``, or a dictionary with the columns that have another name or unit. Defective rows are cut out and
    reported in ``findings``. Raises RunError for an unusable file, ColumnMapError for a map that does not fit.

    Example:

        >>> names = {"t": "time", "angle": {"from": "theta_deg", "unit": "deg"}}
        >>> run = safedpa.read_log("degrees.csv", "pendulum", names)
        >>> run.system.state_names, run.states.shape
        (('angle', 'rate'), (600, 2))
    """
    need("diagnosis", what="read_log()")
    system = model if isinstance(model, System) else model_of(model).system
    mapping = None if columns is None else column_map_of(getattr(columns, "column_map", columns), system)
    return load_run(log, system, mapping)


def model_of(model: Model, effects: str | Path | None = None) -> PhysicsModel:
    """Returns the model; first loads the user's own effects, systems and robots from the file ``effects``."""
    if effects is not None:
        load_user_file(Path(effects))
    return model if isinstance(model, PhysicsModel) else load_model(model)


def title_of(model: Model) -> str:
    """Returns the name of a model in reports: that of its file, or of its robot."""
    return model.system.name if isinstance(model, PhysicsModel) else Path(model).stem


def runs_of(logs: Logs, model: PhysicsModel, columns: Columns) -> list[Run]:
    """Returns the runs, reading files with a progress bar; several files get distinct names. URLs may have a ``*``."""
    named_logs = [logs] if isinstance(logs, (Run, str, Path)) else list(logs)
    given = [one for log in named_logs for one in ([log] if isinstance(log, Run) or not url_of(log) else matching(log))]
    if not given:
        raise InputError("runs: got none; wanted recordings of a robot")
    paths = [item for item in given if not isinstance(item, Run)]
    read = []
    with progress("reading") as report_progress:
        for number, path in enumerate(paths):
            report_progress(number, len(paths))
            read.append(read_log(path, model, columns))
        report_progress(len(paths), len(paths))
    named = iter(with_distinct_names(read, paths) if read else [])
    return [item if isinstance(item, Run) else next(named) for item in given]


def files_of(*sources: object) -> list[str | Path]:
    """Returns the names of files among what a function was given, so that it does not replace them."""
    flat = [item for source in sources for item in (source if isinstance(source, (list, tuple)) else [source])]
    return [item for item in flat if isinstance(item, (str, Path))]
