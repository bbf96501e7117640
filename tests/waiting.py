"""Waiting for what another thread, process or machine does."""

import threading
import time
from collections.abc import Callable


def until(condition: Callable[[], object], seconds: float = 120.0, every: float = 0.02) -> bool:
    """Whether the condition comes true in time; it is asked every so many s, as events elsewhere have no caller.

    Nothing is waited for so long but on a busy machine. The pause is none that a test with a clock of its own replaces.
    """
    end, pause = time.monotonic() + seconds, threading.Event()
    while not condition():
        if time.monotonic() > end:
            return False
        pause.wait(every)
    return True
