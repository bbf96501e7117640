"""Workers that diagnose the robots of a fleet: processes on one machine, or a cluster through Ray.

On one machine, each process handles one robot after the other with bounded memory. If a process dies, the pool does not
report which job caused that. The jobs that were running are therefore repeated one at a time, and a job with which the
process dies again is reported as failed.

On a cluster, Ray's workers need this package installed, and the recordings under the same paths or by URL. Ray is an
optional extra; the tests use a local instance.
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

from safedpa.dynamics.user_files import EFFECTS_VARIABLE
from safedpa.errors import InputError
from safedpa.extras import need

# The object store of a local instance only has answers of a few hundred kilobytes, no recordings.
_LOCAL: dict[str, Any] = {"object_store_memory": 128 * 1024 * 1024, "include_dashboard": False}
# Jobs submitted per core of the cluster, which limits the answers in the object store.
_PER_CORE = 2


def on_cluster(
    work: Callable[[Job], Answer],
    jobs: Sequence[Job],
    address: str,
    failed: Callable[[Job, str], Answer],
    cores: int | None = None,
) -> Iterator[Answer]:
    """Runs jobs on a Ray cluster; yields answers in order of completion, ``failed(job, reason)`` for a failed job.

    ``address`` is that of a running cluster (``auto``, ``ray://HOST:10001``), or ``local`` for a new local instance
    with ``cores``. Raises MissingExtraError if Ray is not installed, InputError if no cluster answers.
    """
    ray = _started(address, cores)

    def answer(job: Job) -> Answer:  # Ray accepts Python functions only, and `work` may be a compiled one
        return work(job)

    try:
        remote = ray.remote(num_cpus=1, max_retries=1, max_calls=_TASKS_OF_A_PROCESS)(answer)
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
    """Returns the answer of one job; an exception in the job is reported by ``failed``."""
    try:
        found: Answer = ray.get(reference)
    except ray.exceptions.RayError as error:
        cause = getattr(error, "cause", None) or error
        return failed(job, f"{type(cause).__name__}: {' '.join(str(cause).split())[:300]}")
    return found


def _started(address: str, cores: int | None) -> Any:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # no telemetry
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    need("cluster", what="--ray")
    import ray

    own = {name: os.environ[name] for name in (EFFECTS_VARIABLE,) if name in os.environ}
    environment = {"env_vars": {**_ENVIRONMENT, **own}}
    settings: dict[str, Any] = {"runtime_env": environment, "log_to_driver": False, "logging_level": "error"}
    if address == "local":
        local = {"address": "local", "num_cpus": cores or available_cores(), **_LOCAL, **settings}
        try:
            _begun(ray, local)
        except InputError:  # Ray's limit of half a minute may be too short: a second attempt
            ray.shutdown()
            _begun(ray, local)
    else:
        _begun(ray, {"address": address, **settings})
    return ray


def _begun(ray: Any, settings: dict[str, Any]) -> None:
    try:
        ray.init(**settings)
    except Exception as error:  # Ray raises a plain Exception if a node does not start in time
        address, reason = settings["address"], " ".join(str(error).split())[:200]
        raise InputError(f"--ray {address}: no cluster answers ({reason}); name its address, or 'local'") from error


Job = TypeVar("Job")
Answer = TypeVar("Answer")

# Jobs after which a worker process is replaced, so that memory retained by libraries does not accumulate.
_TASKS_OF_A_PROCESS = 50
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_ENVIRONMENT = {**dict.fromkeys(_THREADS, "1"), "PYTHONSAFEPATH": "1"}


def available_cores() -> int:
    """Returns the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_processes(
    work: Callable[[Job], Answer], jobs: Sequence[Job], processes: int, failed: Callable[[Job, str], Answer]
) -> Iterator[Answer]:
    """Runs jobs in processes; yields answers in order of completion, ``failed(job, reason)`` for a failed job.

    ``work`` is a module-level function. At most two jobs per process are submitted at a time.
    """
    waiting = list(jobs)
    while waiting:
        broken: list[Job] = []
        yield from _in_pool(work, waiting, processes, failed, broken)
        for job in broken:
            alone: list[Job] = []
            yield from _in_pool(work, [job], 1, failed, alone)
            if alone:
                yield failed(job, "its process was killed, possibly for lack of memory")


def _in_pool(
    work: Callable[[Job], Answer],
    waiting: list[Job],
    processes: int,
    failed: Callable[[Job, str], Answer],
    broken: list[Job],
) -> Iterator[Answer]:
    """Yields answers until no job is left or the pool breaks; appends the jobs running then to ``broken``."""
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
    """Ends this worker process if its parent is killed; otherwise it would wait for its next job forever."""
    Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Limits the linear algebra of processes started in this context to one thread each.

    They import no module of the working directory either: that may be someone else's folder of logs.
    """
    before: dict[str, Any] = {name: os.environ.get(name) for name in _ENVIRONMENT}
    os.environ.update(_ENVIRONMENT)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
