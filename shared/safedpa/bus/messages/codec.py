"""Strict conversion of messages to and from msgpack.

Messages with wrong types, excessive sizes, NaN or infinite numbers are rejected on receipt.

A bundle is several messages of one topic about different robots, sent as one. A separate message has the overhead of a
wake-up, a packet and a call at each end, several times the time to decode it. Processes that serve or simulate many
robots therefore send bundles. A bundle has its own key, ``safedpa/{fleet}/+/{topic}`` with ``+`` in place of the robot.
Only roles that may write for the whole fleet may write under it, and a robot, which may read only its own messages,
never receives a bundle. Receivers treat each entry like a single message about the robot named next to it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any, TypeVar

import msgspec

from safedpa.bus.messages.messages import Message
from safedpa.bus.messages.requests import Answer, LeaseAnswer, LeaseRequest, Request
from safedpa.bus.messages.topics import TOPICS
from safedpa.errors import MessageError

LARGEST_BYTES: dict[type[Any], int] = {
    **{topic.message: topic.largest_bytes for topic in TOPICS.values()},
    Request: 4096,
    Answer: 8 * 1024 * 1024,  # two model files and their margins
    LeaseRequest: 1024 * 1024,  # stop orders of a thousand robots
    LeaseAnswer: 1024 * 1024,
}
"""Size limit in bytes by type of message; larger payloads are rejected before they are parsed."""

_M = TypeVar("_M", bound="Message | Request | Answer | LeaseRequest | LeaseAnswer")


def _plain(value: object) -> float:
    """Converts numpy.float64, a subclass of float that msgspec does not encode itself."""
    if isinstance(value, float):
        return float(value)
    raise TypeError(f"got {type(value).__name__}, wanted a field of a message")


# msgspec compiles one decoder per type, which checks types and ranges of the fields in C. Building them here, once,
# keeps that cost out of the loop.
_READERS: dict[type[Any], Callable[[bytes], Any]] = {
    kind: msgspec.msgpack.Decoder(kind).decode for kind in LARGEST_BYTES
}
_pack = msgspec.msgpack.Encoder(enc_hook=_plain).encode


def encode(message: Message | Request | Answer | LeaseRequest | LeaseAnswer) -> bytes:
    """Returns the message as a msgpack map from field names to values."""
    return _pack(message)


def decode(kind: type[_M], payload: bytes) -> _M:
    """Decodes a payload into a message of type ``kind``. Unknown fields are ignored.

    Raises MessageError, which names the field, if the payload is too large or not a msgpack map, if a field is missing
    or has the wrong type, or if a number is NaN, infinite or larger than LARGEST_NUMBER.
    """
    # The size is checked first, so that a large payload costs a length check and no parsing.
    if len(payload) > LARGEST_BYTES[kind]:
        raise MessageError(f"{kind.__name__}: got {len(payload)} bytes, wanted at most {LARGEST_BYTES[kind]}")
    try:
        message: _M = _READERS[kind](payload)
        return message
    except (ValueError, RecursionError) as error:
        # msgspec ends with the field, as in "Expected `float`, got `str` - at `$.values[1]`".
        reason, _, field = str(error).partition(" - at `$")
        raise MessageError(f"{kind.__name__}{field.removesuffix('`')}: {reason or type(error).__name__}") from error


Entry = tuple[str, bytes]
"""Name of a robot, and the encoded message about it."""

_MOST_ENTRIES = 256
# Total size of the entries of one bundle. With the overhead of the list it remains below the limit of a topic's
# messages (64 KiB) and below the size of one Zenoh batch.
_LARGEST_BYTES = 48 * 1024

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
