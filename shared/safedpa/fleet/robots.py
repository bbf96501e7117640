"""Assigns recordings to the robots of a fleet: by folder, by file, or by the robot's name in a recording."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from safedpa.errors import InputError
from safedpa.fleet.robot_recordings import robots_in

By = Literal["auto", "folder", "file", "robot"]
_ENDINGS = (".csv", ".parquet", ".mcap")


@dataclass(frozen=True)
class RobotLogs:
    """Recordings of one robot; ``inside`` is its name in the recordings, None if the files have one robot only."""

    name: str
    files: tuple[Path, ...]
    inside: str | None = None


@dataclass(frozen=True)
class DiscoveredRobots:
    """The robots, how they were distinguished, and recordings without a robot, with the reason."""

    robots: tuple[RobotLogs, ...]
    by: By
    left_out: tuple[tuple[Path, str], ...] = ()


def robots_in_folder(folder: Path, by: By = "auto") -> DiscoveredRobots:
    """Finds the robots with recordings below a folder.

    ``folder``: each subfolder is a robot, with all recordings below it. ``file``: each file is a robot. ``robot``: by
    the names in MCAP recordings. ``auto``: by folder if there are subfolders with recordings, else by robot if a
    recording has several, else by file. Hidden files are ignored. Raises InputError without any recording.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: is not a folder; wanted the recordings of a fleet, such as FOLDER/ROBOT/*.csv")
    files = _recordings_below(folder)
    if not files:
        raise InputError(f"{folder}: contains no recording; wanted files that end in {', '.join(_ENDINGS)}")
    nested = any(path.parent != folder for path in files)
    return _grouped(files, folder, by if by != "auto" else "folder" if nested else _loose(files))


def robots_of_files(paths: Sequence[Path], by: By = "auto") -> DiscoveredRobots:
    """Finds the robots of the given files; with ``folder``, the folder of a file is its robot.

    Raises InputError without files, and if folders of the same name would be one robot.
    """
    if not paths:
        raise InputError("runs: missing; wanted recordings, or --fleet FOLDER")
    base = Path(os.path.commonpath([path.absolute().parent for path in paths]))
    several = len({path.absolute().parent for path in paths}) > 1
    base = base if several else base.parent
    return _grouped([path.absolute() for path in paths], base, by if by != "auto" else "folder" if several else "file")


def _loose(files: Sequence[Path]) -> By:
    """Returns ``robot`` if a recording of the bus has several robots, else ``file``."""
    # Not by the name of a single recorded robot, which is often the same, such as 'car', in all files.
    bus = [path for path in files if path.suffix.lower() == ".mcap"]
    return "robot" if any(len(robots_in(path)[0]) > 1 for path in bus) else "file"


def _recordings_below(folder: Path) -> list[Path]:
    """Returns all recordings in order, without the output of an earlier diagnosis of a fleet."""
    found = []
    for place, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith(".") and not _own(Path(place) / name))
        found += [Path(place) / name for name in sorted(names) if _is_recording(name)]
    return found


def _own(folder: Path) -> bool:
    return (folder / "fleet.json").exists()


def _is_recording(name: str) -> bool:
    return name.lower().endswith(_ENDINGS) and not name.startswith(".")


def _grouped(files: Sequence[Path], base: Path, by: By) -> DiscoveredRobots:
    if by == "robot":
        return _by_robot(files)
    groups: dict[str, list[Path]] = {}
    left: list[tuple[Path, str]] = []
    for path in files:
        parts = path.relative_to(base).parts
        if by == "folder" and len(parts) == 1:
            left.append((path, "lies next to the robots' folders"))
            continue
        name = parts[0] if by == "folder" else _joined(path.relative_to(base).with_suffix("").parts)
        if by == "file" and name in groups:
            name = _joined(path.relative_to(base).parts)  # the same name with another ending
        groups.setdefault(name, []).append(path)
    if not groups:
        raise InputError(f"{base}: by folder: got files only; wanted one folder for each robot, or --by file")
    return DiscoveredRobots(tuple(RobotLogs(name, tuple(groups[name])) for name in sorted(groups)), by, tuple(left))


def _joined(parts: Iterable[str]) -> str:
    return "_".join(parts)


def _by_robot(files: Sequence[Path]) -> DiscoveredRobots:
    groups: dict[str, list[Path]] = {}
    left: list[tuple[Path, str]] = []
    for path in files:
        names, why = robots_in(path)
        for name in names:
            groups.setdefault(name, []).append(path)
        if why:
            left.append((path, why))
    if not groups:
        path, why = left[0]
        raise InputError(f"{path}: {why}; wanted MCAP recordings of robots, or --by file")
    robots = (RobotLogs(name, tuple(groups[name]), name) for name in sorted(groups))
    return DiscoveredRobots(tuple(robots), "robot", tuple(left))
