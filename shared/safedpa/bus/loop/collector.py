"""The cycle collector of a process that serves robots: asleep, unless what is held grows."""

from __future__ import annotations

import gc
from typing import Final

__all__ = ["GROWTH", "settle_collector"]

GROWTH: Final = 50_000
"""Containers by which what is held has to grow until the collector looks for cycles. A batch of a hundred robots holds
more than Python's 700 at once, and windows of measurements that turn over leave it all they hold to look at each time:
a fifteenth of a fleet's processor time, in stalls of up to 17 ms, for cycles that nobody makes. If somebody does, they
are found, but containers are counted and not what they hold."""
_OLDER: Final = 1
"""Looks at what is young, then at what is older, between two looks at what is older still. Python's 10 would leave
cycles that were held for a while to the millionth container; a process that does not grow never looks at all."""


def settle_collector() -> None:
    """To be called when what lives has been made: it lives for ever, and the collector need not look at it again."""
    gc.collect()
    gc.freeze()
    gc.collect()  # of nothing, so that what is new need not grow to a quarter of what was there
    gc.set_threshold(GROWTH, _OLDER, _OLDER)
