"""Reading recordings of the bus: every message that can be read, up to where the file is damaged."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safedpa.bus.wire.codec import decode
from safedpa.bus.wire.messages import Message
from safedpa.bus.wire.topics import Topic, topic_of
from safedpa.errors import InputError, MessageError
from safedpa.records.mcap_records import DamageError, records_of
from safedpa.records.run import Finding
from safedpa.records.table import require_file

if TYPE_CHECKING:
    from mcap.records import Channel

__all__ = ["read_messages", "read_payloads"]


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
    """(key, log time in ns, topic, bytes as on the bus) of a recording: as ``read_messages``, but not decoded."""
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
                yield entry[0], record.log_time, entry[1], record.data


def _known(channel: Channel) -> tuple[str, Topic] | None:
    """Key and topic of a channel; None for channels of others."""
    try:
        return (channel.topic, topic_of(channel.topic)[2]) if channel.message_encoding == "msgpack" else None
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
