"""The cycle collector of a process that serves robots: asleep, unless what is held grows."""

from __future__ import annotations

import gc
from typing import Final

__all__ = ["GROWTH", "settle_collector"]

GROWTH: Final = 50_000
"""Containers by which what is held has to grow until the collector looks for cycles. A batch of a hundred robots holds
more than Python's 700 at once, and windows of measurements that turn over leave it all they hold to look at each time:
a fifteenth of a fleet's processor time, in stalls of up to 17 ms, for cycles that nobody makes. If somebody does, so
many objects take some 10 MiB until they are found."""


def settle_collector() -> None:
    """To be called when what lives has been made: it lives for ever, and the collector need not look at it again."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(GROWTH, *gc.get_threshold()[1:])
