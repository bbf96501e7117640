"""A background process that runs jobs one after another, reports progress and can be stopped at any time."""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import os
import pickle
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from safedpa.disk import why_not_written
from safedpa.errors import SafedpaError

Job = Callable[..., Any]
"""A module-level function whose last argument is a callback for the share that is done, from 0 to 1."""


class StoppedError(SafedpaError):
    """The job was stopped before it was done."""


class Worker:
    """Runs jobs in a low-priority process, which is started at the first job and again after each stop."""

    def __init__(self) -> None:
        self._process: BaseProcess | None = None
        self._connection: Connection | None = None
        self._lock = asyncio.Lock()

    async def ask(
        self, job: Job, *arguments: Any, report_progress: Callable[[float], None] = lambda _share: None
    ) -> Any:
        """Runs a job and returns its result.

        Raises SafedpaError if the job fails, and StoppedError if the process ends meanwhile.
        """
        async with self._lock:
            connection = self._ensure_process()
            try:
                await asyncio.to_thread(_send, connection, (job, arguments))
                return await self._receive(connection, report_progress)
            except (EOFError, OSError) as error:
                raise StoppedError("the computation was stopped before it was done; start it again") from error

    async def _receive(self, connection: Connection, report_progress: Callable[[float], None]) -> Any:
        while True:
            kind, content = await asyncio.to_thread(_receive, connection)
            if kind == "reported":
                report_progress(content)
            elif kind == "failed":
                raise content
            else:
                return content

    def stop(self) -> None:
        """Kills the process at once, whatever it is doing."""
        process, self._process = self._process, None
        self._connection = None
        if process is not None:
            process.kill()
            process.join()

    def _ensure_process(self) -> Connection:
        if self._process is None or not self._process.is_alive() or self._connection is None:
            os.environ.setdefault("OMP_NUM_THREADS", "1")  # inherited by the child: a search uses one core
            os.environ["PYTHONSAFEPATH"] = "1"  # it imports nothing of the working directory, which may be a stranger's
            context = multiprocessing.get_context("spawn")
            parent_end, child_end = context.Pipe()
            self._process = context.Process(target=_serve, args=(child_end,), daemon=True, name="safedpa workbench")
            self._process.start()
            child_end.close()
            self._connection = parent_end
        return self._connection


def _send(connection: Connection, item: object) -> None:
    """Sends a pickled object, and its arrays apart: a copy of a long recording would stop the page for seconds."""
    arrays: list[pickle.PickleBuffer] = []
    content = pickle.dumps(item, protocol=5, buffer_callback=arrays.append)
    connection.send((content, len(arrays)))
    for array in arrays:
        connection.send_bytes(array.raw())


def _receive(connection: Connection) -> Any:
    content, count = connection.recv()
    return pickle.loads(content, buffers=[bytearray(connection.recv_bytes()) for _ in range(count)])


def _serve(connection: Connection) -> None:
    """Main loop of the child process: runs jobs until the parent closes its end."""
    with contextlib.suppress(OSError):
        os.nice(10)
    from safedpa.dynamics.user_files import load_user_files

    load_user_files()
    with contextlib.suppress(EOFError, OSError, KeyboardInterrupt):
        while True:
            job, arguments = _receive(connection)
            _send(connection, _run(job, arguments, connection))


def _run(job: Job, arguments: tuple[Any, ...], connection: Connection) -> tuple[str, Any]:
    try:
        return "done", job(*arguments, lambda share: _send(connection, ("reported", share)))
    except ConnectionError:  # the parent process has ended
        raise
    except SafedpaError as error:
        return "failed", error
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return "failed", SafedpaError(f"{where}cannot be written or read ({why_not_written(error)})")
    except Exception as error:  # noqa: BLE001  the page reports the error and continues
        return "failed", SafedpaError(f"the computation failed: {type(error).__name__}: {error}")
