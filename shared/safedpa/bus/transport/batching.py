"""Many messages of one topic in one: what a process that serves or simulates many robots says at one moment.

A message that travels alone costs a wake-up, a packet and a call at each end, several times what reading it costs. A
bundle travels under a key of its own, ``safedpa/{fleet}/+/{topic}``, with ``+`` in the place of the robot: only who may
speak for the whole fleet has the right to it, and a robot, which may read what is said of itself alone, is never sent
one. Each message in it is then treated as if it had come alone, under the name that stands next to it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated

import msgspec

from safedpa.errors import MessageError

__all__ = ["Entry", "pack_bundle", "split_into_bundles", "unpack_bundle"]

Entry = tuple[str, bytes]
"""Name of the robot, and a message about it as it would travel alone."""

_MOST_ENTRIES = 256
_LARGEST_BYTES = 48 * 1024
"""Of the messages in one bundle: it stays below what one message may have, and one of Zenoh's batches."""

_pack = msgspec.msgpack.Encoder().encode
_unpack = msgspec.msgpack.Decoder(Annotated[list[tuple[str, bytes]], msgspec.Meta(max_length=_MOST_ENTRIES)]).decode


def split_into_bundles(entries: Sequence[Entry]) -> Iterator[list[Entry]]:
    """The entries in order, in parts of which each fits into one bundle."""
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
    """The payload of one bundle: a msgpack list of pairs."""
    return _pack(entries)


def unpack_bundle(payload: bytes) -> list[Entry]:
    """The entries of a bundle. Raises MessageError where it is none, or holds more than 256 messages."""
    try:
        entries: list[Entry] = _unpack(payload)
        return entries
    except (ValueError, RecursionError) as error:
        raise MessageError(f"bundle: got none ({error}), wanted a list of names and messages") from error
