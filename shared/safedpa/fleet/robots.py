"""Which recordings belong to which robot of a fleet: by folder, by file, or by the robot's name inside a recording."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from safedpa.errors import InputError
from safedpa.fleet.robot_recordings import robots_in

__all__ = ["By", "DiscoveredRobots", "RobotLogs", "robots_in_folder", "robots_of_files"]

By = Literal["auto", "folder", "file", "robot"]
_ENDINGS = (".csv", ".parquet", ".mcap")


@dataclass(frozen=True)
class RobotLogs:
    """One robot's recordings; ``inside`` is its name inside a recording, None where a file is one robot."""

    name: str
    files: tuple[Path, ...]
    inside: str | None = None


@dataclass(frozen=True)
class DiscoveredRobots:
    """The robots by name, what a robot is told by, and recordings that belong to none, with the reason."""

    robots: tuple[RobotLogs, ...]
    by: By
    left_out: tuple[tuple[Path, str], ...] = ()


def robots_in_folder(folder: Path, by: By = "auto") -> DiscoveredRobots:
    """The robots whose recordings lie below a folder.

    ``folder``: each folder in it is a robot, with every recording below it. ``file``: each file is one. ``robot``: the
    names inside MCAP recordings. ``auto``: by folder where there are such folders, else by robot where a recording
    holds several, else by file. Hidden files are no recordings. Raises InputError where there is none.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: is no folder; wanted one with the recordings of a fleet, FOLDER/ROBOT/*.csv, say")
    files = _recordings_below(folder)
    if not files:
        raise InputError(f"{folder}: holds no recording; wanted files that end in {', '.join(_ENDINGS)}")
    nested = any(path.parent != folder for path in files)
    return _grouped(files, folder, by if by != "auto" else "folder" if nested else _loose(files))


def robots_of_files(paths: Sequence[Path], by: By = "auto") -> DiscoveredRobots:
    """The robots of files that were named one by one; by folder, the folder that holds a file is its robot.

    Raises InputError where there is no file, or where folders of the same name would be one robot.
    """
    if not paths:
        raise InputError("runs: got none; wanted recordings, or --fleet FOLDER")
    base = Path(os.path.commonpath([path.absolute().parent for path in paths]))
    several = len({path.absolute().parent for path in paths}) > 1
    base = base if several else base.parent
    return _grouped([path.absolute() for path in paths], base, by if by != "auto" else "folder" if several else "file")


def _loose(files: Sequence[Path]) -> By:
    """By file, unless a recording of the bus holds several: a robot that is recorded alone is often just 'car'."""
    bus = [path for path in files if path.suffix.lower() == ".mcap"]
    return "robot" if any(len(robots_in(path)[0]) > 1 for path in bus) else "file"


def _recordings_below(folder: Path) -> list[Path]:
    """Every recording, in order; what a fleet's diagnosis wrote there itself is none."""
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
