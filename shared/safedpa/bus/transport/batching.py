"""Bundles: several messages of one topic about different robots, sent as one message.

A separate message has the overhead of a wake-up, a packet and a call at each end, several times the time to decode it.
Processes that serve or simulate many robots therefore send bundles. A bundle has its own key,
``safedpa/{fleet}/+/{topic}`` with ``+`` in place of the robot. Only roles that may write for the whole fleet may write
under it, and a robot, which may read only its own messages, never receives a bundle. Receivers treat each entry like a
single message about the robot named next to it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated

import msgspec

from safedpa.errors import MessageError

Entry = tuple[str, bytes]
"""Name of a robot, and the encoded message about it."""

_MOST_ENTRIES = 256
# Total size of the entries of one bundle. With the overhead of the list it remains below the limit of a topic's
# messages (64 KiB) and below the size of one Zenoh batch.
_LARGEST_BYTES = 48 * 1024

_pack = msgspec.msgpack.Encoder().encode
# The decoder rejects a longer list while it reads, before it has allocated the entries.
_unpack = msgspec.msgpack.Decoder(Annotated[list[tuple[str, bytes]], msgspec.Meta(max_length=_MOST_ENTRIES)]).decode


def split_into_bundles(entries: Sequence[Entry]) -> Iterator[list[Entry]]:
    """Splits the entries, in order, into parts that each fit into one bundle."""
    part: list[Entry] = []
    size = 0
    for entry in entries:
        length = len(entry[0]) + len(entry[1])
        if part and (size + length > _LARGEST_BYTES or len(part) == _MOST_ENTRIES):
            yield part
            part, size = [], 0
        part.append(entry)
        size += length
    if part:
        yield part


def pack_bundle(entries: Sequence[Entry]) -> bytes:
    """Returns the payload of a bundle: a msgpack list of pairs."""
    return _pack(entries)


def unpack_bundle(payload: bytes) -> list[Entry]:
    """Returns the entries of a bundle. Raises MessageError for malformed bundles and those of more than 256 entries."""
    try:
        entries: list[Entry] = _unpack(payload)
        return entries
    except (ValueError, RecursionError) as error:
        raise MessageError(f"bundle: malformed ({error}), wanted a list of names and messages") from error
