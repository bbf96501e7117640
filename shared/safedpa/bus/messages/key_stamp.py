"""The key again, next to each message: what comes under another one than it was sent under is no message.

Zenoh names keys on a link by numbers that both ends agree on again whenever the link is made again, and reads what waited
meanwhile by the new numbers: after a lost link messages were handed on under other keys of the session
(``deploy/zenoh_mixed_keys.py``, of version 1.10.2). A state of one robot would be taken for another's.
"""

from __future__ import annotations

from functools import lru_cache
from hashlib import blake2b

__all__ = ["STAMP_BYTES", "is_misrouted", "key_stamp"]

STAMP_BYTES = 8
"""Enough that no two keys of a fleet share a stamp by chance, and as little as goes next to every message."""


@lru_cache(maxsize=16_384)
def key_stamp(key: str) -> bytes:
    """What goes next to a message under ``key``: BLAKE2b of the key in UTF-8, 8 bytes."""
    return blake2b(key.encode(), digest_size=STAMP_BYTES).digest()


def is_misrouted(key: str, stamp: bytes | None) -> bool:
    """Whether what came under ``key`` was sent under another one.

    Who sends no stamp is believed: the stamp guards against mistakes on the way, not against forgers, whom the router
    stops, and programs in other languages need not know of it.
    """
    return stamp is not None and stamp != key_stamp(key)
