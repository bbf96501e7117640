"""One robot after the other in processes of one machine: bounded memory, and a process that dies costs one robot.

A pool that a dead process broke does not say whose fault it was: the robots that were under way are done again one at a
time, and the one with which it breaks anew is named.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from threading import Thread
from typing import Any, TypeVar

__all__ = ["available_cores", "in_processes", "one_thread_each"]

Job = TypeVar("Job")
Answer = TypeVar("Answer")

_TASKS_OF_A_PROCESS = 50
"""After so many a process makes room for a fresh one: what libraries keep does not add up over a fleet."""
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_processes(
    work: Callable[[Job], Answer], jobs: Sequence[Job], processes: int, failed: Callable[[Job, str], Answer]
) -> Iterator[Answer]:
    """Answers in the order in which they are done; ``failed(job, reason)`` for one that raises or kills its process.

    ``work`` is a function of a module. At most two jobs for each process are handed over at a time.
    """
    waiting = list(jobs)
    while waiting:
        broken: list[Job] = []
        yield from _in_pool(work, waiting, processes, failed, broken)
        for job in broken:
            alone: list[Job] = []
            yield from _in_pool(work, [job], 1, failed, alone)
            if alone:
                yield failed(job, "its process was killed, for want of memory perhaps")


def _in_pool(
    work: Callable[[Job], Answer],
    waiting: list[Job],
    processes: int,
    failed: Callable[[Job, str], Answer],
    broken: list[Job],
) -> Iterator[Answer]:
    """Answers until nothing waits or the pool breaks; jobs that were under way then are appended to ``broken``."""
    running: dict[Future[Answer], Job] = {}
    with one_thread_each(), _pool(processes) as pool:
        while waiting or running:
            while waiting and len(running) < 2 * processes:
                job = waiting.pop(0)
                running[pool.submit(work, job)] = job
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                job = running.pop(future)
                error = future.exception()
                if isinstance(error, BrokenProcessPool):
                    broken += [job, *running.values()]
                    return
                yield failed(job, f"{type(error).__name__}: {error}") if error else future.result()


@contextmanager
def _pool(processes: int) -> Iterator[ProcessPoolExecutor]:
    spawn = get_context("spawn")
    pool = ProcessPoolExecutor(processes, spawn, _end_with_parent, max_tasks_per_child=_TASKS_OF_A_PROCESS)
    try:
        yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _end_with_parent() -> None:
    """Lets a process end when the one that started it was killed: it would wait for its next job for ever."""
    Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def one_thread_each() -> Iterator[None]:
    """While it lasts, processes that are started use one thread of linear algebra each."""
    before: dict[str, Any] = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
