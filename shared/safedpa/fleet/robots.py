"""Assigns recordings to the robots of a fleet: by folder, by file, or by the robot's name in a recording.

A recording of many robots is split into one per robot first, so that the diagnosis of every robot does not read the
recording of the whole fleet.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from safedpa.bus.messages.topics import STATE, topic_of
from safedpa.errors import InputError, SafedpaError
from safedpa.records.earlier_format import current_key
from safedpa.records.readers.mcap_recovery import DamageError, channels_at_end, records_of
from safedpa.records.readers.own_process import in_own_process, iterated_in_own_process
from safedpa.records.readers.table import regular_file
from safedpa.records.store import find_files, url_of

By = Literal["auto", "folder", "file", "robot"]
_ENDINGS = (".csv", ".parquet", ".mcap")
_BATCH = 1000
"""States that come at once from the process that reads a recording."""


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
    recording has several, else by file. Hidden files are ignored. The folder may be a URL such as ``s3://bucket/logs``.
    Raises InputError without any recording, TransferError if the store cannot be asked.
    """
    if not url_of(folder) and not folder.is_dir():
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
    full = [path if url_of(path) else path.absolute() for path in paths]
    if len({path.parts[:2] if url_of(path) else "" for path in full}) > 1:
        raise InputError("runs: got several stores; wanted all runs in one bucket, or all on this machine")
    base = Path(os.path.commonpath([path.parent for path in full]))
    several = len({path.parent for path in full}) > 1
    base = base if several else base.parent
    return _grouped(full, base, by if by != "auto" else "folder" if several else "file")


def _loose(files: Sequence[Path]) -> By:
    """Returns ``robot`` if a recording of the bus has several robots, else ``file``."""
    # Not by the name of a single recorded robot, which is often the same, such as 'car', in all files.
    bus = [path for path in files if path.suffix.lower() == ".mcap"]
    return "robot" if any(len(robots_in(path)[0]) > 1 for path in bus) else "file"


def _recordings_below(folder: Path) -> list[Path]:
    """Returns all recordings in order, without the output of an earlier diagnosis of a fleet."""
    if url := url_of(folder):
        return _recordings_in_store(url)
    found = []
    for place, folders, names in os.walk(folder):
        folders[:] = sorted(
            name for name in folders if not name.startswith(".") and not (Path(place) / name / "fleet.json").exists()
        )
        recordings = (name for name in names if name.lower().endswith(_ENDINGS) and not name.startswith("."))
        paths = (Path(place) / name for name in sorted(recordings))
        found += [path for path in paths if path.is_file()]  # opening a pipe would wait for its writer
    return found


def _recordings_in_store(url: str) -> list[Path]:
    base = url.rstrip("/")
    names = [name.removeprefix(f"{base}/") for name in find_files(base, remembers=True)]
    earlier = tuple(f"{name.removesuffix('fleet.json')}" for name in names if name.endswith("/fleet.json"))
    recordings = (name for name in names if name.lower().endswith(_ENDINGS) and not f"/{name}".count("/."))
    return [Path(f"{base}/{name}") for name in recordings if not name.startswith(earlier)]


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
        name = parts[0] if by == "folder" else "_".join(path.relative_to(base).with_suffix("").parts)
        if by == "file" and name in groups:
            name = "_".join(path.relative_to(base).parts)  # the same name with another ending
        groups.setdefault(name, []).append(path)
    if not groups:
        raise InputError(f"{base}: by folder: got files only; wanted one folder for each robot, or --by file")
    return DiscoveredRobots(tuple(RobotLogs(name, tuple(groups[name])) for name in sorted(groups)), by, tuple(left))


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


def robots_in(path: Path) -> tuple[list[str], str]:
    """Returns the sorted names of the robots with states in a recording, and why there are none (else empty)."""
    try:
        with regular_file(path) as local:
            names = _names_in(local)
    except (SafedpaError, OSError) as error:
        return [], str(error)
    return names, "" if names else "contains no states of robots"


@in_own_process
def _names_in(path: Path) -> list[str]:
    # The index at the end; None if the recording was not closed, or is damaged.
    channels = channels_at_end(path)
    found = _channels(path) if channels is None else channels
    return sorted(set(filter(None, map(_state_robot, found))))


def split_recording(path: Path, folder: Path) -> dict[str, Path]:
    """Copies each robot's states without decoding into ``folder/ROBOT.mcap``; returns the files by robot.

    Memory does not grow with the recording. Stops at the first damage. Raises RunError if the file is not a recording,
    OSError if the folder cannot be written.
    """
    from mcap.writer import CompressionType, Writer

    folder.mkdir(parents=True, exist_ok=True)
    paths: dict[str, Path] = {}
    writers: dict[str, Any] = {}
    channels: dict[tuple[str, str], int] = {}
    with ExitStack() as stack:
        for batch in _states(path):
            for key, robot, logged, published, sequence, data in batch:
                if robot not in writers:
                    paths[robot] = folder / f"{robot}.mcap"
                    file = stack.enter_context(paths[robot].open("wb"))
                    writers[robot] = Writer(file, chunk_size=1 << 18, compression=CompressionType.ZSTD)
                    writers[robot].start()
                    stack.callback(writers[robot].finish)
                if (robot, key) not in channels:
                    channels[robot, key] = writers[robot].register_channel(key, "msgpack", schema_id=0)
                writers[robot].add_message(channels[robot, key], logged, data, published, sequence)
    return paths


@iterated_in_own_process
def _states(path: Path) -> Generator[list[tuple[str, str, int, int, int, bytes]], None, None]:
    """Yields batches of states: key, robot, log time [ns], publish time [ns], sequence number, encoded message."""
    from mcap.records import Channel, Message

    known: dict[int, tuple[str, str]] = {}
    batch: list[tuple[str, str, int, int, int, bytes]] = []
    for record in _records(path):
        if isinstance(record, Channel) and (robot := _state_robot(record)):
            known[record.id] = (record.topic, robot)
        elif isinstance(record, Message) and record.channel_id in known:
            batch.append(
                (*known[record.channel_id], record.log_time, record.publish_time, record.sequence, record.data)
            )
        if len(batch) >= _BATCH:
            yield batch
            batch = []
    yield batch


def _channels(path: Path) -> Iterator[Any]:
    from mcap.records import Channel

    return (record for record in _records(path) if isinstance(record, Channel))


def _state_robot(channel: Any) -> str:
    """Returns the robot whose states a channel contains; empty for other channels."""
    try:
        _, robot, topic = topic_of(current_key(channel.topic))
    except InputError:
        return ""
    return robot if topic == STATE and channel.message_encoding == "msgpack" else ""


def _records(path: Path) -> Iterator[Any]:
    """Yields the records up to the end or the first damage. Raises InputError if the file is not a recording."""
    with contextlib.suppress(DamageError):
        yield from records_of(path, validate=False)
