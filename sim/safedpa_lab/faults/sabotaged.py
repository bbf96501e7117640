"""``python -m safedpa_lab.faults.sabotaged MODULE ...``: a process of the fleet whose loop can be made to hang.

Nothing of the process itself is changed: it runs as it would by ``python -m MODULE ...``. Four signals are taken
beforehand, and served on the main thread:

- SIGUSR1: the loop hangs, other threads run on. What the network library does by itself goes on, signs of life too. A
  thread that brings a message turns the loop as well, so the lock of those that turn is taken: as in a step that does
  not return;
- SIGUSR2: the loop hangs inside a C call that keeps the interpreter's lock: no thread of Python runs;
- SIGRTMIN + 1: the wall clock, as Python reports it, jumps back by an hour, and forth again at the next such signal;
- SIGRTMIN: what hangs goes on. (A lock that is held can only be waited for: that hang ends by itself after
  ``GRIPPED_SECONDS``.)
"""

from __future__ import annotations

import ctypes
import gc
import runpy
import signal
import sys
import threading
import time
from types import FrameType

HANG = signal.SIGUSR1
GRIP = signal.SIGUSR2
GO_ON = signal.SIGRTMIN
JUMP = signal.SIGRTMIN + 1
_JUMP_SECONDS = -3600
GRIPPED_SECONDS = 2
_LONGEST_HANG_SECONDS = 60.0
_LOOK_SECONDS = 0.01


class _Saboteur:
    def __init__(self) -> None:
        self._hanging = False
        self._offset = 0
        self._time, self._time_ns = time.time, time.time_ns

    def jump(self, _number: int, _frame: FrameType | None) -> None:
        self._offset = _JUMP_SECONDS - self._offset
        time.time = lambda: self._time() + self._offset
        time.time_ns = lambda: self._time_ns() + self._offset * 1_000_000_000

    def hang(self, _number: int, _frame: FrameType | None) -> None:
        self._hanging = True
        end = time.monotonic() + _LONGEST_HANG_SECONDS
        taken, free = list[threading.Lock](), _turns()
        while self._hanging and time.monotonic() < end:
            # What this very thread held when the signal came stays as it is: no one else turns then.
            taken += [lock for lock in free if lock not in taken and lock.acquire(blocking=False)]
            time.sleep(_LOOK_SECONDS)
        for lock in taken:
            lock.release()

    def grip(self, _number: int, _frame: FrameType | None) -> None:
        ctypes.PyDLL(None).sleep(GRIPPED_SECONDS)  # unlike CDLL, PyDLL does not let go of the interpreter's lock

    def go_on(self, _number: int, _frame: FrameType | None) -> None:
        self._hanging = False


def _turns() -> list[threading.Lock]:
    """The locks of this process's schedulers; empty if it runs another kind of loop."""
    module = sys.modules.get("safedpa.bus.service.service_loop")
    kinds = (module.Scheduler,) if module else ()
    return [one._running for one in gc.get_objects() if isinstance(one, kinds)]


def _main() -> None:
    saboteur = _Saboteur()
    signal.signal(HANG, saboteur.hang)
    signal.signal(GRIP, saboteur.grip)
    signal.signal(GO_ON, saboteur.go_on)
    signal.signal(JUMP, saboteur.jump)
    module, sys.argv = sys.argv[1], sys.argv[1:]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    _main()
