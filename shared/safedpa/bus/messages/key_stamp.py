"""A hash of the key, attached to each message, by which receivers reject messages delivered under a wrong key.

On a link, Zenoh replaces keys by numeric ids, which both ends agree on again when the link is re-established. Messages
that were queued meanwhile are decoded with the new ids: after a lost link, Zenoh 1.10.2 delivered messages under other
keys of the session (reproduced by ``deploy/zenoh_mixed_keys.py``). A robot's state could be taken for another robot's.
"""

from __future__ import annotations

from functools import lru_cache
from hashlib import blake2b

STAMP_BYTES = 8
"""Size of a stamp: large enough that two keys of a fleet do not collide by chance, small overhead per message."""


# Every message sent or received needs one; 1000 robots on 16 keys fit.
@lru_cache(maxsize=16_384)
def key_stamp(key: str) -> bytes:
    """Returns the stamp attached to messages under ``key``: BLAKE2b of the key in UTF-8, 8 bytes."""
    return blake2b(key.encode(), digest_size=STAMP_BYTES).digest()


def is_misrouted(key: str, stamp: bytes | None) -> bool:
    """Whether a message received under ``key`` was sent under another key. A message without a stamp is accepted."""
    # The stamp detects transport errors, not forgery, which the router's access control prevents. Programs in other
    # languages need not send it.
    return stamp is not None and stamp != key_stamp(key)
