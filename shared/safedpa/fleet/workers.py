"""Who diagnoses the robots of a fleet: processes of one machine, or a cluster through Ray.

On one machine: one robot after the other in each process, bounded memory, and a process that dies costs one robot. A
pool that a dead process broke does not say whose fault it was: the robots that were under way are done again one at a
time, and the one with which it breaks again is named.

On a cluster the same work, by an optional extra of the package, tested on a local instance. Ray's workers need this
package installed, and the recordings under the same paths.
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

from safedpa.dynamics.own import EFFECTS_VARIABLE
from safedpa.errors import InputError
from safedpa.extras import need

__all__ = ["available_cores", "in_processes", "on_cluster", "one_thread_each"]


_LOCAL: dict[str, Any] = {"object_store_memory": 128 * 1024 * 1024, "include_dashboard": False}
"""A local instance keeps no recordings in its store, only answers of a few hundred kilobytes."""
_PER_CORE = 2
"""Jobs handed over for each core of the cluster: the store holds no more answers than that."""


def on_cluster(
    work: Callable[[Job], Answer],
    jobs: Sequence[Job],
    address: str,
    failed: Callable[[Job, str], Answer],
    cores: int | None = None,
) -> Iterator[Answer]:
    """Answers in the order in which they are done; ``failed(job, reason)`` for one that raises or kills its process.

    ``address``: of a running cluster (``auto``, ``ray://HOST:10001``), or ``local`` for an instance of its own with
    ``cores``. Raises MissingExtraError when Ray is not installed, InputError when no cluster answers.
    """
    ray = _started(address, cores)

    def answer(job: Job) -> Answer:  # Ray takes nothing but functions that are written in Python
        return work(job)

    try:
        remote = ray.remote(num_cpus=1, max_retries=1)(answer)
        waiting: list[Job] = list(jobs)
        running: dict[Any, Job] = {}
        most = _PER_CORE * max(1, int(ray.cluster_resources().get("CPU", 1)))
        while waiting or running:
            while waiting and len(running) < most:
                job = waiting.pop(0)
                running[remote.remote(job)] = job
            done, _ = ray.wait(list(running), num_returns=1)
            for reference in done:
                yield _answer(ray, reference, running.pop(reference), failed)
    finally:
        ray.shutdown()


def _answer(ray: Any, reference: Any, job: Job, failed: Callable[[Job, str], Answer]) -> Answer:
    """The answer of one job. Whatever it raised there is its failure, not that of the fleet."""
    try:
        found: Answer = ray.get(reference)
    except ray.exceptions.RayError as error:
        cause = getattr(error, "cause", None) or error
        return failed(job, f"{type(cause).__name__}: {' '.join(str(cause).split())[:300]}")
    return found


def _started(address: str, cores: int | None) -> Any:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is told to anybody
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    need("cluster", what="--ray")
    import ray

    own = {name: os.environ[name] for name in (EFFECTS_VARIABLE,) if name in os.environ}
    environment = {"env_vars": {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", **own}}
    settings: dict[str, Any] = {"runtime_env": environment, "log_to_driver": False, "logging_level": "error"}
    if address == "local":
        _patiently(ray, {"address": "local", "num_cpus": cores or available_cores(), **_LOCAL, **settings})
    else:
        _begun(ray, {"address": address, **settings})
    return ray


def _patiently(ray: Any, settings: dict[str, Any]) -> None:
    """A local instance; Ray gives it half a minute, which a busy machine may need twice."""
    try:
        _begun(ray, settings)
    except InputError:
        ray.shutdown()
        _begun(ray, settings)


def _begun(ray: Any, settings: dict[str, Any]) -> None:
    try:
        ray.init(**settings)
    except Exception as error:  # Ray raises just that when a node does not start in time
        address, reason = settings["address"], " ".join(str(error).split())[:200]
        raise InputError(f"--ray {address}: no cluster answers ({reason}); name its address, or 'local'") from error


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
