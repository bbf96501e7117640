"""The same work on a cluster through Ray: an optional extra of the package, tested on a local instance.

Ray's workers need this package installed, and the recordings under the same paths.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from safedpa.diagnosis.fleet.workers import available_cores
from safedpa.dynamics.own import EFFECTS_VARIABLE
from safedpa.errors import InputError
from safedpa.extras import need

__all__ = ["on_cluster"]

Job = TypeVar("Job")
Answer = TypeVar("Answer")

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
