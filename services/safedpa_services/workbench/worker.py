"""The background process of one page: jobs one after another, progress, and an end at any moment."""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import os
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from safedpa.disk import why_not_written
from safedpa.errors import SafedpaError

__all__ = ["StoppedError", "Worker"]

Job = Callable[..., Any]
"""A function of a module, whose last argument is told how much is done, from 0 to 1."""


class StoppedError(SafedpaError):
    """The job was ended before it was done."""


class Worker:
    """Runs jobs in a process of low priority, which is started at the first job and after each stop."""

    def __init__(self) -> None:
        self._process: BaseProcess | None = None
        self._connection: Connection | None = None
        self._turn = asyncio.Lock()

    async def ask(
        self, job: Job, *arguments: Any, report_progress: Callable[[float], None] = lambda _share: None
    ) -> Any:
        """What the job returns.

        Raises what the job raises (SafedpaError and its like), and StoppedError when the process ends meanwhile.
        """
        async with self._turn:
            connection = self._started()
            try:
                await asyncio.to_thread(connection.send, (job, arguments))
                return await self._answer(connection, report_progress)
            except (EOFError, OSError) as error:
                raise StoppedError("the computation was ended before it was done; start it again") from error

    async def _answer(self, connection: Connection, report_progress: Callable[[float], None]) -> Any:
        while True:
            kind, content = await asyncio.to_thread(connection.recv)
            if kind == "reported":
                report_progress(content)
            elif kind == "failed":
                raise content
            else:
                return content

    def stop(self) -> None:
        """Ends the process at once, whatever it does."""
        process, self._process = self._process, None
        self._connection = None
        if process is not None:
            process.kill()
            process.join()

    def _started(self) -> Connection:
        if self._process is None or not self._process.is_alive() or self._connection is None:
            os.environ.setdefault("OMP_NUM_THREADS", "1")  # of the process to be: one search, one core
            context = multiprocessing.get_context("spawn")
            mine, theirs = context.Pipe()
            self._process = context.Process(target=_serve, args=(theirs,), daemon=True, name="safedpa workbench")
            self._process.start()
            theirs.close()
            self._connection = mine
        return self._connection


def _serve(connection: Connection) -> None:
    """The process: one job after another, until the other side is gone."""
    with contextlib.suppress(OSError):
        os.nice(10)
    from safedpa.dynamics.own import load_own_of_environment

    load_own_of_environment()
    with contextlib.suppress(EOFError, OSError, KeyboardInterrupt):
        while True:
            job, arguments = connection.recv()
            connection.send(_done(job, arguments, connection))


def _done(job: Job, arguments: tuple[Any, ...], connection: Connection) -> tuple[str, Any]:
    try:
        return "done", job(*arguments, lambda share: connection.send(("reported", share)))
    except ConnectionError:  # the page's process is gone
        raise
    except SafedpaError as error:
        return "failed", error
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return "failed", SafedpaError(f"{where}cannot be written or read ({why_not_written(error)})")
    except Exception as error:  # noqa: BLE001  the page says what went wrong and goes on
        return "failed", SafedpaError(f"the computation failed: {type(error).__name__}: {error}")
