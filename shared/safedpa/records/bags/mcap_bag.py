"""MCAP files with ROS messages: what rosbag2 writes by default, and many recorders besides."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

from safedpa.limits import limit, readable, too_much
from safedpa.records.bags.messages_log import AbstractBag, Declared
from safedpa.records.mcap_records import DamageError, channels_at_end, records_of
from safedpa.records.run import Finding
from safedpa.ros.definitions import plain_type

__all__ = ["McapBag", "is_recording_of_the_bus"]


class McapBag(AbstractBag):
    """An ``.mcap`` whose channels hold CDR or ROS 1 messages."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "MCAP file")

    def messages(self, topics: Collection[str] | None) -> Iterator[tuple[str, int, bytes]]:
        """(topic, receipt in ns, encoded message) in the file's order; a damaged end is told and left out."""
        from mcap.records import Channel, Message, Schema

        size = self.path.stat().st_size
        if size > limit("bag_bytes"):
            raise too_much("bag_bytes", f"{size} bytes", str(self.path))
        schemas: dict[int, tuple[str, str, bytes]] = {}
        names: dict[int, str] = {}
        try:
            for record in records_of(self.path):
                if isinstance(record, Message):
                    name = names.get(record.channel_id)
                    if name is not None and (topics is None or name in topics):
                        yield name, record.log_time, record.data
                elif isinstance(record, Schema):
                    schemas[record.id] = (record.name, record.encoding, record.data)
                elif isinstance(record, Channel):
                    names[record.id] = record.topic
                    kind, form, text = schemas.get(record.schema_id, ("", "", b""))
                    told = (kind, record.message_encoding, text.decode("utf-8", "replace"), form)
                    self.declared[record.topic] = Declared(readable(plain_type(told[0])), *told[1:])
        except DamageError as damage:
            where = f"is cut off or damaged at byte {damage.offset} of {damage.size}"
            self.findings.append(Finding("cut_off", f"the bag {where}; read up to there, the rest left out"))


def is_recording_of_the_bus(path: Path) -> bool:
    """Whether an MCAP file is a recording of this project's bus; so is one that cannot be read: its reader says why."""
    from mcap.records import Channel

    from safedpa.records.table import require_file

    require_file(path)
    channels = channels_at_end(path)
    if channels is None:
        channels = []
        try:
            for record in records_of(path, validate=False):
                if isinstance(record, Channel):
                    channels.append(record)
                    break
        except DamageError:
            pass
    return not channels or any(channel.message_encoding == "msgpack" for channel in channels)
