"""Work spread over processes, or done here when one is enough; results come in order, as they are ready."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import AbstractContextManager
from typing import Any, TypeVar, final

__all__ = ["Workers"]

Item = TypeVar("Item")
Result = TypeVar("Result")


@final
class Workers(AbstractContextManager["Workers"]):
    """``map`` over so many processes; with one, in this process. Each works on one core alone."""

    def __init__(self, processes: int) -> None:
        self._pool: ProcessPoolExecutor | None = None
        if processes > 1:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(processes, mp_context=context, initializer=_one_thread)

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """The results of ``function`` on the items, in their order."""
        return map(function, items) if self._pool is None else self._pool.map(function, items)

    def __exit__(self, *_: Any) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)


def _one_thread() -> None:
    """Set before numpy is imported by the first task: two processes of many threads would fight for the cores."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
