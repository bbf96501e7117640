"""One robot's run out of a recording of the bus.

Reading recordings of the bus: every message that can be read, up to where the file is damaged.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from safedpa.bus.messages.codec import decode
from safedpa.bus.messages.messages import Message, StateMessage, VerdictMessage
from safedpa.bus.messages.topics import STATE, VERDICT, Topic, topic_of
from safedpa.errors import InputError, MessageError, RunError, did_you_mean
from safedpa.records.column_map.apply import Rows
from safedpa.records.column_map.column_map import native_map
from safedpa.records.earlier_format import current_key, current_payload
from safedpa.records.quality.quality import run_of_rows
from safedpa.records.readers.mcap_recovery import DamageError, records_of
from safedpa.records.readers.table import require_file
from safedpa.records.run import Finding, Run
from safedpa.systems import System

if TYPE_CHECKING:
    from mcap.records import Channel

__all__ = [
    "Recording",
    "VerdictRow",
    "read_messages",
    "read_payloads",
    "read_recording",
    "read_run_from_mcap",
]


def read_messages(
    path: str | Path, findings: list[Finding] | None = None, topics: Collection[Topic] | None = None
) -> Iterator[tuple[str, int, Message]]:
    """(key, log time in ns, message) of a recording, in the order in which they were recorded.

    ``topics`` limits what is decoded. A file that was cut off or damaged is read up to there. What was found (cut off,
    messages that could not be decoded) is appended to ``findings``. Raises RunError when the file is no MCAP file.
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
            Finding("unreadable_message", f"{total} messages could not be decoded ({reason}); left out", total)
        )


def read_payloads(
    path: str | Path, findings: list[Finding] | None = None, topics: Collection[Topic] | None = None
) -> Iterator[tuple[str, int, Topic, bytes]]:
    """(key, log time in ns, topic, bytes as on the bus) of a recording: as ``read_messages``, but not decoded.

    A recording of an earlier format comes in the names of today.
    """
    from mcap.records import Channel
    from mcap.records import Message as Record

    path = Path(path)
    require_file(path)
    channels: dict[int, tuple[str, Topic] | None] = {}
    for record in _records(path, findings if findings is not None else []):
        if isinstance(record, Channel):
            channels[record.id] = _known(record)
        elif isinstance(record, Record):
            entry = channels.get(record.channel_id)
            if entry is not None and (topics is None or entry[1] in topics):
                yield entry[0], record.log_time, entry[1], current_payload(entry[1].name, record.data)


def _known(channel: Channel) -> tuple[str, Topic] | None:
    """Key of today and topic of a channel; None for channels of others."""
    key = current_key(channel.topic)
    try:
        return (key, topic_of(key)[2]) if channel.message_encoding == "msgpack" else None
    except InputError:
        return None


def _records(path: Path, findings: list[Finding]) -> Iterator[Any]:
    """Records of the file, chunks opened, up to its end or to the first damage."""
    try:
        yield from records_of(path)
    except DamageError as damage:
        findings.append(_damage(damage.offset, damage.size))


def _damage(offset: int, size: int) -> Finding:
    if offset >= size:
        return Finding(
            "cut_off", f"the recording was not closed: it ends at byte {size} without an index; read up to there"
        )
    return Finding(
        "damaged", f"the recording is damaged at byte {offset} of {size}; read up to there, the rest left out"
    )


Stamp = tuple[int, int]
VerdictRow = tuple[str, float, float, float, float]


@dataclass
class Recording:
    """One robot's ticks, in order, and the verdicts where they were recorded.

    ``actions`` [k] is what was applied over the period after tick k: the robot reports it with tick k + 1. It is
    NaN where that report is missing.
    """

    robot: str
    t: NDArray[np.float64]
    states: NDArray[np.float64]
    actions: NDArray[np.float64]
    stamps: list[Stamp]
    """(epoch, tick) of each row."""
    verdicts: dict[Stamp, VerdictRow] = field(default_factory=dict)
    """status, slack, h_now, h_next, margin."""
    findings: tuple[Finding, ...] = ()


def read_run_from_mcap(path: str | Path, system: System, robot: str | None = None) -> Run:
    """States and applied actions of one robot as a run; ``robot`` is needed when the recording holds several.

    Raises RunError when the file is no recording, holds no such robot, or one of another system.
    """
    path = Path(path)
    recording = read_recording(path, robot)
    for what, values, names in (
        ("states", recording.states, system.state_names),
        ("actions", recording.actions, system.action_names),
    ):
        if values.shape[1] != len(names):
            raise RunError(
                f"{path}: robot '{recording.robot}': got {values.shape[1]} {what}, wanted {len(names)} "
                f"({', '.join(names)}); name the model of that robot"
            )
    known: NDArray[np.bool_] = np.asarray(np.isfinite(recording.actions).all(axis=1))
    rows = Rows(recording.t, recording.states, recording.actions).taken(known)
    return run_of_rows(path, system, native_map(system), rows, recording.findings)


def read_recording(path: Path, robot: str | None = None, *, with_verdicts: bool = False) -> Recording:
    """Ticks of one robot, and the safety filter's verdicts when wanted. Raises RunError as ``read_run_from_mcap``."""
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
    chosen = _chosen(path, robot, list(ticks), findings)
    if not ticks[chosen].even:
        raise RunError(
            f"{path}: robot '{chosen}': the number of its states or actions changes; record each robot alone"
        )
    return ticks[chosen].recording(chosen, verdicts.get(chosen, {}), tuple(findings))


def _chosen(path: Path, robot: str | None, robots: list[str], findings: list[Finding]) -> str:
    if not robots:
        reason = f" ({'; '.join(finding.message for finding in findings)})" if findings else ""
        raise RunError(f"{path}: no robot's states in it{reason}; wanted a recording of a drive")
    if robot is None and len(robots) > 1:
        raise RunError(
            f"{path}: holds {len(robots)} robots: {', '.join(sorted(robots))}; name one of them, or "
            "write one to a file with: safedpa export --robot NAME"
        )
    if robot is not None and robot not in robots:
        raise RunError(f"{path}: robot '{robot}': {did_you_mean(robot, robots)}")
    return robot or robots[0]


class _Ticks:
    """Numbers of the states seen so far, packed: ten hours of drive must fit into memory."""

    def __init__(self) -> None:
        self._row: dict[Stamp, int] = {}
        self._t, self._values, self._applied = array("d"), array("d"), array("d")
        self._applied_row = array("q")
        self._widths: set[int] = set()
        self._applied_widths: set[int] = {0}

    @property
    def even(self) -> bool:
        """Whether every state had as many numbers as the others; before its first action a robot may report none."""
        return len(self._widths) == 1 and len(self._applied_widths) <= 2

    def add(self, message: StateMessage) -> None:
        """Keeps the first state of each tick; a robot in lockstep repeats it until the action is there."""
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
        """By epoch in the order in which the epochs began, then by tick."""
        epochs = {epoch: place for place, epoch in enumerate(dict.fromkeys(epoch for epoch, _ in self._row))}
        stamps = sorted(self._row, key=lambda stamp: (epochs[stamp[0]], stamp[1]))
        order = np.array([self._row[stamp] for stamp in stamps])
        after = [self._row.get((epoch, tick + 1), -1) for epoch, tick in stamps]
        reported = np.array([self._applied_row[row] if row >= 0 else -1 for row in after])
        width = max(self._applied_widths)
        applied = np.array(self._applied).reshape(len(self._applied) // max(width, 1), width)
        actions = np.vstack([applied, np.full((1, applied.shape[1]), np.nan)])[reported]
        states = np.array(self._values).reshape(len(stamps), -1)[order]
        return Recording(robot, np.array(self._t)[order], states, actions, stamps, verdicts, findings)
