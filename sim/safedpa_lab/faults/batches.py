"""Zenoh's bytes on a TCP connection, cut into its own units, so that whole messages can be lost and nothing else.

TCP loses nothing: a lost packet is a pause. What loses messages is a sender that drops under congestion, a radio link
that carries datagrams, a full queue. To stand for those, whole batches are taken out of the stream: a batch is what
Zenoh writes at once, two bytes of length (little-endian) and then one transport message. Messages of the control loop
are sent `express`, one a batch. Left out are only batches that carry data, questions or answers (a frame whose first
network message is a push, request or response, or a fragment of one); handshakes, signs of life and declarations of
subscribers arrive, as Zenoh sends them once per connection and relies on it.
Source: Zenoh protocol 1.x, `commons/zenoh-protocol` (identifiers in `transport/mod.rs` and `network/mod.rs`).
"""

from __future__ import annotations

from typing import final

__all__ = ["Batches", "carries_data"]

_LENGTH_BYTES = 2
_IDENTIFIER = 0x1F
_FRAME, _FRAGMENT = 0x05, 0x06
_MORE = 0x80
"""A continuation bit of a number, and the flag that extensions follow."""
_DATA = (0x1D, 0x1C, 0x1B)
"""push, request, response"""


@final
class Batches:
    """Cuts a stream of bytes into batches, each with its length in front."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, chunk: bytes) -> list[bytes]:
        """The batches that are complete now, in order."""
        self._rest += chunk
        whole = []
        while len(self._rest) >= _LENGTH_BYTES:
            end = _LENGTH_BYTES + int.from_bytes(self._rest[:_LENGTH_BYTES], "little")
            if len(self._rest) < end:
                break
            whole.append(self._rest[:end])
            self._rest = self._rest[end:]
        return whole


def carries_data(batch: bytes) -> bool:
    """Whether a batch carries what a publisher, an asker or an answerer said; False for what cannot be read."""
    body = batch[_LENGTH_BYTES:]
    if not body:
        return False
    kind = body[0] & _IDENTIFIER
    if kind == _FRAGMENT:
        return True
    if kind != _FRAME:
        return False
    try:
        position = _after_number(body, 1)  # behind the sequence number
        extended = bool(body[0] & _MORE)
        while extended:
            extended = bool(body[position] & _MORE)
            position = _after_extension(body, position)
        return body[position] & _IDENTIFIER in _DATA
    except IndexError:
        return False


def _after_number(body: bytes, position: int) -> int:
    while body[position] & _MORE:
        position += 1
    return position + 1


def _after_extension(body: bytes, position: int) -> int:
    """Two bits of its header say what follows: nothing, a number, or a number of bytes."""
    encoding = (body[position] >> 5) & 0x03
    if encoding == 0:
        return position + 1
    behind = _after_number(body, position + 1)
    if encoding == 1:
        return behind
    size = sum((byte & 0x7F) << (7 * index) for index, byte in enumerate(body[position + 1 : behind]))
    return behind + size
