"""Reads recordings of the bus: their messages, and the run of one robot.

Damaged chunks of a file are left out.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Collection, Generator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from safedpa.bus.messages.codec import decode
from safedpa.bus.messages.messages import Message, StateMessage, VerdictMessage
from safedpa.bus.messages.topics import STATE, TOPICS, VERDICT, Topic, topic_of
from safedpa.errors import InputError, MessageError, RunError, did_you_mean
from safedpa.records.column_map.column_map import native_map
from safedpa.records.earlier_format import current_key, current_payload
from safedpa.records.quality.quality import run_of_rows
from safedpa.records.readers.mcap_recovery import DamageError, damage_finding, undamaged_records
from safedpa.records.readers.own_process import iterated_in_own_process
from safedpa.records.readers.table import require_file
from safedpa.records.run import Finding, RawRows, Run
from safedpa.systems import System

if TYPE_CHECKING:
    from mcap.records import Channel

__all__ = [
    "Recording",
    "VerdictRow",
    "read_messages",
    "read_payloads",
    "read_recording",
    "read_rows_from_mcap",
    "read_run_from_mcap",
]

_Payload = tuple[str, int, str, bytes]
"""Key, log time [ns], name of the topic, encoded message."""
_Entry = tuple[str, int, Topic, bytes]
_BATCH_BYTES: Final = 1 << 20
"""Bytes that come at once from the process that reads the file."""
_MESSAGE_BYTES: Final = 100
"""Bytes that a message takes next to its content."""


def read_messages(
    path: str | Path, findings: list[Finding] | None = None, topics: Collection[Topic] | None = None
) -> Iterator[tuple[str, int, Message]]:
    """Yields (key, log time in ns, message) of a recording, in recorded order.

    ``topics`` limits what is decoded. Damaged chunks of a file are left out; this and messages that
    could not be decoded are appended to ``findings``. Raises RunError if the file is not an MCAP file.
    """
    found = findings if findings is not None else []
    refused: Counter[str] = Counter()
    for key, at, topic, payload in read_payloads(path, found, topics):
        try:
            message = decode(topic.message, payload)
        except MessageError as error:
            refused[str(error)] += 1
            continue
        yield key, at, message
    if refused:
        reason, _ = refused.most_common(1)[0]
        total = sum(refused.values())
        found.append(
            Finding("unreadable_message", f"{total} messages could not be decoded ({reason}) and were ignored", total)
        )


def read_payloads(
    path: str | Path, findings: list[Finding] | None = None, topics: Collection[Topic] | None = None
) -> Iterator[tuple[str, int, Topic, bytes]]:
    """Yields (key, log time in ns, topic, encoded message) of a recording, like ``read_messages`` without decoding.

    Recordings of an earlier format are converted to the names of the present one.
    """
    path = Path(path)
    require_file(path)
    names = None if topics is None else frozenset(topic.name for topic in topics)
    found = yield from _in_items(_payloads(path, names))
    if findings is not None:
        findings += found


def _in_items(batches: Generator[list[_Payload], None, list[Finding]]) -> Generator[_Entry, None, list[Finding]]:
    """Yields what batches hold, one by one, and returns what they return."""
    while True:
        try:
            batch = next(batches)
        except StopIteration as end:
            found: list[Finding] = end.value
            return found
        for key, at, name, payload in batch:
            yield key, at, TOPICS[name], payload


@iterated_in_own_process
def _payloads(path: Path, topics: Collection[str] | None) -> Generator[list[_Payload], None, list[Finding]]:
    """Yields batches of payloads, with the names of their topics; returns the findings about damage."""
    from mcap.records import Channel
    from mcap.records import Message as Record

    channels: dict[int, tuple[str, str] | None] = {}
    damage: list[DamageError] = []
    batch: list[_Payload] = []
    size = 0
    for record in undamaged_records(path, damage):
        if isinstance(record, Channel):
            channels[record.id] = _key_and_topic(record)
        elif isinstance(record, Record):
            entry = channels.get(record.channel_id)
            if entry is not None and (topics is None or entry[1] in topics):
                batch.append((entry[0], record.log_time, entry[1], current_payload(entry[1], record.data)))
                size += len(record.data) + _MESSAGE_BYTES
        if size > _BATCH_BYTES:
            yield batch
            batch, size = [], 0
    yield batch
    return [damage_finding(damage, "recording", None)] if damage else []


def _key_and_topic(channel: Channel) -> tuple[str, str] | None:
    """Present key and name of the topic of a channel; None for channels of other programs."""
    key = current_key(channel.topic)
    try:
        return (key, topic_of(key)[2].name) if channel.message_encoding == "msgpack" else None
    except InputError:
        return None


Stamp = tuple[int, int]
VerdictRow = tuple[str, float, float, float, float]


@dataclass
class Recording:
    """Ticks of one robot in order, and the verdicts that were recorded.

    ``actions[k]`` is the action applied during the period after tick k; the robot reports it with tick k + 1. It is
    NaN if that report is missing.
    """

    robot: str
    t: NDArray[np.float64]
    states: NDArray[np.float64]
    actions: NDArray[np.float64]
    stamps: list[Stamp]
    """(epoch, tick) of each row; an epoch is one start of the robot."""
    verdicts: dict[Stamp, VerdictRow] = field(default_factory=dict)
    """By stamp: status, slack, h_now, h_next, margin."""
    findings: tuple[Finding, ...] = ()


def read_run_from_mcap(path: str | Path, system: System, robot: str | None = None) -> Run:
    """Reads states and applied actions of one robot as a run; ``robot`` is required if there are several.

    Raises RunError if the file is not a recording or has no such robot, or if the robot has another system.
    """
    return run_of_rows(Path(path), system, native_map(system), *read_rows_from_mcap(Path(path), system, robot))


def read_rows_from_mcap(path: Path, system: System, robot: str | None = None) -> tuple[RawRows, tuple[Finding, ...]]:
    """Reads the rows of ``read_run_from_mcap``, before their quality is checked."""
    recording = read_recording(path, robot)
    for kind, values, names in (
        ("states", recording.states, system.state_names),
        ("actions", recording.actions, system.action_names),
    ):
        if values.shape[1] != len(names):
            raise RunError(
                f"{path}: robot '{recording.robot}': got {values.shape[1]} {kind}, wanted {len(names)} "
                f"({', '.join(names)}); name the model of that robot"
            )
    known: NDArray[np.bool_] = np.asarray(np.isfinite(recording.actions).all(axis=1))
    return RawRows(recording.t, recording.states, recording.actions).taken(known), recording.findings


def read_recording(path: Path, robot: str | None = None, *, with_verdicts: bool = False) -> Recording:
    """Reads the ticks of one robot and, on request, the verdicts; raises RunError like ``read_run_from_mcap``."""
    findings: list[Finding] = []
    topics = (STATE, VERDICT) if with_verdicts else (STATE,)
    ticks: dict[str, _Ticks] = {}
    verdicts: dict[str, dict[Stamp, VerdictRow]] = {}
    for key, _, message in read_messages(path, findings, topics):
        name = topic_of(key)[1]
        if isinstance(message, StateMessage):
            ticks.setdefault(name, _Ticks()).add(message)
        elif isinstance(message, VerdictMessage):
            row = (message.status, message.slack, message.h_now, message.h_next, message.margin)
            verdicts.setdefault(name, {}).setdefault((message.epoch, message.tick), row)
    chosen = _choose_robot(path, robot, list(ticks), findings)
    if not ticks[chosen].has_constant_width:
        raise RunError(
            f"{path}: robot '{chosen}': the number of its states or actions changes; record each robot alone"
        )
    return ticks[chosen].recording(chosen, verdicts.get(chosen, {}), tuple(findings))


def _choose_robot(path: Path, robot: str | None, robots: list[str], findings: list[Finding]) -> str:
    if not robots:
        reason = f" ({'; '.join(finding.message for finding in findings)})" if findings else ""
        raise RunError(f"{path}: contains no state of a robot{reason}; wanted a recording of a drive")
    if robot is None and len(robots) > 1:
        raise RunError(
            f"{path}: holds {len(robots)} robots: {', '.join(sorted(robots))}; name one of them, or "
            "write one to a file with: safedpa export --robot NAME"
        )
    if robot is not None and robot not in robots:
        raise RunError(f"{path}: robot '{robot}': {did_you_mean(robot, robots)}")
    return robot or robots[0]


class _Ticks:
    """States read so far, in packed arrays: a recording of ten hours must fit into memory."""

    def __init__(self) -> None:
        self._row: dict[Stamp, int] = {}
        self._t, self._values, self._applied = array("d"), array("d"), array("d")
        self._applied_row = array("q")
        self._widths: set[int] = set()
        self._applied_widths: set[int] = {0}

    @property
    def has_constant_width(self) -> bool:
        """Whether all states, and all applied actions but empty ones before the first, have the same length."""
        return len(self._widths) == 1 and len(self._applied_widths) <= 2

    def add(self, message: StateMessage) -> None:
        """Adds the first state of each tick; in lockstep a robot repeats its state until the action arrives."""
        stamp = (message.epoch, message.tick)
        if stamp in self._row:
            return
        self._row[stamp] = len(self._t)
        self._t.append(message.robot_time)
        self._values.extend(message.values)
        self._applied_row.append(len(self._applied) // max(len(message.applied), 1) if message.applied else -1)
        self._applied.extend(message.applied)
        self._widths.add(len(message.values))
        self._applied_widths.add(len(message.applied))

    def recording(self, robot: str, verdicts: dict[Stamp, VerdictRow], findings: tuple[Finding, ...]) -> Recording:
        """Returns the recording, sorted by epoch (in the order in which they began) and tick."""
        epochs = {epoch: place for place, epoch in enumerate(dict.fromkeys(epoch for epoch, _ in self._row))}
        stamps = sorted(self._row, key=lambda stamp: (epochs[stamp[0]], stamp[1]))
        order = np.array([self._row[stamp] for stamp in stamps])
        after = [self._row.get((epoch, tick + 1), -1) for epoch, tick in stamps]
        applied_row = np.array([self._applied_row[row] if row >= 0 else -1 for row in after])
        width = max(self._applied_widths)
        applied = np.array(self._applied).reshape(len(self._applied) // max(width, 1), width)
        actions = np.vstack([applied, np.full((1, applied.shape[1]), np.nan)])[applied_row]
        states = np.array(self._values).reshape(len(stamps), -1)[order]
        return Recording(robot, np.array(self._t)[order], states, actions, stamps, verdicts, findings)
