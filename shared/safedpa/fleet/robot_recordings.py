"""Recordings of many robots: the names of the robots, and splitting into one recording per robot.

Splitting once avoids that the diagnosis of every robot reads the recording of the whole fleet.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from safedpa.bus.messages.topics import STATE, topic_of
from safedpa.errors import InputError, SafedpaError
from safedpa.records.earlier_format import current_key
from safedpa.records.readers.mcap_recovery import DamageError, channels_at_end, records_of


def robots_in(path: Path) -> tuple[list[str], str]:
    """Returns the sorted names of the robots with states in a recording, and why there are none (else empty)."""
    try:
        names = _indexed(path)
        names = {robot for _, robot, _ in _states(path, headers=True)} if names is None else names
    except (SafedpaError, OSError) as error:
        return [], str(error)
    return sorted(names), "" if names else "contains no states of robots"


def _indexed(path: Path) -> set[str] | None:
    """Returns the robots from the recording's index; None without one (not closed, damaged, or not a recording)."""
    channels = channels_at_end(path)
    return None if channels is None else {robot for robot in map(_state_robot, channels) if robot}


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
        for key, robot, record in _states(path):
            if robot not in writers:
                paths[robot] = folder / f"{robot}.mcap"
                file = stack.enter_context(paths[robot].open("wb"))
                writers[robot] = Writer(file, chunk_size=1 << 18, compression=CompressionType.ZSTD)
                writers[robot].start()
                stack.callback(writers[robot].finish)
            if (robot, key) not in channels:
                channels[robot, key] = writers[robot].register_channel(key, "msgpack", schema_id=0)
            channel, times = channels[robot, key], (record.log_time, record.publish_time)
            writers[robot].add_message(channel, times[0], record.data, times[1], record.sequence)
    return paths


def _states(path: Path, *, headers: bool = False) -> Iterator[tuple[str, str, Any]]:
    """Yields (key, robot, record) of every state, or with ``headers`` of the channels only."""
    from mcap.records import Channel, Message

    known: dict[int, tuple[str, str]] = {}
    for record in _records(path):
        if isinstance(record, Channel):
            robot = _state_robot(record)
            if robot:
                known[record.id] = (record.topic, robot)
                if headers:
                    yield record.topic, robot, record
        elif isinstance(record, Message) and not headers and record.channel_id in known:
            yield *known[record.channel_id], record


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
