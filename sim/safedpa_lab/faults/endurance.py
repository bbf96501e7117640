"""Whether memory and open files of a fleet stay what they were, while it drives for long."""

from __future__ import annotations

import os
import statistics
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import final

from safedpa_lab.benchmarks.usage import usage_of
from safedpa_lab.faults.world import World

_EVERY_SECONDS = 5.0
_WARM_SECONDS = 30.0
"""Of a process's life, in which it imports, joins and fills its windows."""
_GROWN, _GROWN_MIB, _MORE_HANDLES = 1.25, 16.0, 16
"""A median of memory that grows by this factor and so many MiB, or so many open files more, is no noise of Python's."""


@final
@dataclass(frozen=True)
class Sample:
    """What one process holds at one moment."""

    at: float
    """s, monotonic."""
    name: str
    pid: int
    resident_mib: float
    handles: int
    """Open files, sockets and pipes."""
    threads: int


@final
@dataclass(frozen=True)
class Retained:
    """What the processes of one name held in the first quarter of the time, and in the last one."""

    name: str
    processes: int
    """That bore the name, one after another, and were seen when they were warm."""
    longest_life_seconds: float
    mib: tuple[float, float]
    """Median."""
    handles: tuple[int, int]
    """Most."""
    threads: tuple[int, int]
    """Most."""

    @property
    def flat(self) -> bool:
        """Whether it has not grown beyond what any Python process grows by."""
        (first, last), (few, many) = self.mib, self.handles
        return not (last > _GROWN * first and last > first + _GROWN_MIB) and many <= few + _MORE_HANDLES


def retained_by(samples: Sequence[Sample]) -> list[Retained]:
    """By name, in order of the names; of processes that live for less than half a minute nothing is reported.

    The quarters are those of the time from the first to the last warm sample of a name. Where one of them has none,
    its neighbours stand for it.
    """
    born: dict[tuple[str, int], float] = {}  # numbers of processes come again, within an hour too
    for sample in samples:
        born.setdefault((sample.name, sample.pid), sample.at)
    warm = [sample for sample in samples if sample.at - born[sample.name, sample.pid] >= _WARM_SECONDS]
    return [
        _retained(name, [sample for sample in warm if sample.name == name], born)
        for name in sorted({sample.name for sample in warm})
    ]


def _retained(name: str, samples: Sequence[Sample], born: dict[tuple[str, int], float]) -> Retained:
    begin, end = samples[0].at, samples[-1].at
    quarter = 0.25 * (end - begin)
    first = [sample for sample in samples if sample.at <= begin + quarter]
    last = [sample for sample in samples if sample.at >= end - quarter]
    return Retained(
        name,
        len({sample.pid for sample in samples}),
        round(max(sample.at - born[name, sample.pid] for sample in samples), 1),
        (_median(first), _median(last)),
        (max(one.handles for one in first), max(one.handles for one in last)),
        (max(one.threads for one in first), max(one.threads for one in last)),
    )


def _median(samples: Sequence[Sample]) -> float:
    return round(statistics.median(sample.resident_mib for sample in samples), 1)


@final
class Resources:
    """Looks at the processes of worlds, every few seconds, from a thread of its own.

    :param clock: monotonic [s].
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self.samples: list[Sample] = []

    @contextmanager
    def alongside(self, world: World) -> Iterator[None]:
        """As long as this lasts."""
        ended = threading.Event()

        def look() -> None:
            while not ended.wait(_EVERY_SECONDS):
                self.look({name: member.pid for name, member in world.members.items()})

        thread = threading.Thread(target=look, name="resources", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    def look(self, pids: dict[str, int]) -> None:
        """Once; who is gone, or was never there (pid 0), is left out."""
        at = self._clock()
        for name, pid in pids.items():
            used = usage_of(pid) if pid else None
            if used is None:
                continue
            try:
                threads = len(os.listdir(f"/proc/{pid}/task"))
            except OSError:  # it ended meanwhile
                continue
            self.samples.append(Sample(at, name, pid, used.resident_mib, used.handles, threads))
