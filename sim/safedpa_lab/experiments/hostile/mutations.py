"""Changes good bytes into bad ones: what a stranger, a broken disk or a broken program would send."""

from __future__ import annotations

import random
from collections.abc import Sequence

_TOKENS = (
    b"\x00", b"\xff" * 4, b"\xff" * 8, b"\x7f\xff\xff\xff", b"\x80\x00\x00\x00", b"\xdd\xff\xff\xff\xff", b"\xc1",
    b"nan", b"inf", b"-1e309", b"9" * 400, b"[" * 60, b"{" * 60, b"." * 60, b'"""', b"'''", b"\\u202e", b"\x1b[2J",
    b"../" * 8, b"%2e%2e%2f", b"\r\n", b"\r\nX: y", b"\xed\xa0\x80", b"\xef\xbb\xbf", b",", b";", b"\n", b"=", b"#",
)  # fmt: skip
"""What breaks readers."""
_LARGEST = 1 << 18


def mutated(chance: random.Random, seeds: Sequence[bytes]) -> bytes:
    """One of the seeds, changed one to six times; the same chance gives the same bytes."""
    data = bytearray(chance.choice(seeds))
    for _ in range(chance.randint(1, 6)):
        at = chance.randrange(len(data) + 1)
        kind = chance.randrange(7)
        if kind == 0 and data:
            data[at % len(data)] ^= 1 << chance.randrange(8)
        elif kind == 1:
            data[at:at] = chance.choice(_TOKENS)
        elif kind == 2:
            del data[at : at + chance.randint(1, 64)]
        elif kind == 3:
            other = chance.choice(seeds)
            begin = chance.randrange(len(other) + 1)
            data[at : at + 32] = other[begin : begin + chance.randint(1, 256)]
        elif kind == 4:
            piece = bytes(data[at : at + chance.randint(1, 32)])
            data[at:at] = piece * chance.randint(2, 200)
        elif kind == 5:
            data[at : at + 8] = chance.randbytes(8)
        else:
            del data[at:]
    return bytes(data[:_LARGEST])
