"""Runs search and calibration jobs in separate processes, so that monitoring continues meanwhile."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import final

from safedpa.live.search_jobs import AbstractWorker, SearchJob, WorkOutcome
from safedpa.systems.robots import DEFAULT_ROBOT
from safedpa_services.diagnosis.work_files import CPU_SECONDS, PAUSE_SECONDS, PAUSE_SIGNAL, read_outcome, write_work

_MOST_STARTS = 3
_LONGEST_SECONDS = 3600.0
"""A job that has not ended after this time hangs. Its processor time is limited, too; a busy machine only delays it."""


@dataclass
class _WorkerJob:
    folder: Path
    process: subprocess.Popen[bytes]
    began: float
    starts: int = 1
    paused: float = -inf
    """Start of its last pause [s]."""


@final
class ProcessWorker(AbstractWorker):
    """Runs at most one job per robot, each in a process.

    A process that dies is started again, up to three times in all.
    """

    def __init__(self, settings: str = DEFAULT_ROBOT, clock: Callable[[], float] = time.monotonic) -> None:
        self._settings = settings
        self._clock = clock
        self._jobs: dict[str, _WorkerJob] = {}

    def begin(self, robot: str, work: SearchJob) -> None:  # noqa: D102
        self.cancel(robot)
        folder = Path(tempfile.mkdtemp(prefix="safedpa-diagnosis-"))
        write_work(work, folder)
        self._jobs[robot] = _WorkerJob(folder, self._start(folder), self._clock())

    def outcome(self, robot: str) -> WorkOutcome | None:  # noqa: D102
        job = self._jobs.get(robot)
        if job is None:
            return None
        code = job.process.poll()
        if code is None and self._clock() - job.began < _LONGEST_SECONDS:
            return None
        found = read_outcome(job.folder) if code == 0 else None
        spent = code == -signal.SIGXCPU
        if found is None and code is not None and job.starts < _MOST_STARTS and not spent:
            _kill(job.process)
            job.process, job.starts = self._start(job.folder), job.starts + 1
            return None
        reason = "took too long" if code is None else f"ended with code {code}, {job.starts} times"
        reason = f"took more than {CPU_SECONDS} s of processor time" if spent else reason
        self.cancel(robot)
        return WorkOutcome(failure=f"its process {reason}") if found is None else found

    def cancel(self, robot: str) -> None:  # noqa: D102
        job = self._jobs.pop(robot, None)
        if job is None:
            return
        _kill(job.process)
        shutil.rmtree(job.folder, ignore_errors=True)

    def give_way(self) -> None:  # noqa: D102
        now = self._clock()
        for job in self._jobs.values():
            if now - job.paused >= 2.0 * PAUSE_SECONDS:
                job.paused = now
                job.process.send_signal(PAUSE_SIGNAL)

    def busy(self, robot: str) -> bool:  # noqa: D102
        return robot in self._jobs

    def process_of(self, robot: str) -> int:
        """Returns the process id of a robot's job; 0 without one."""
        job = self._jobs.get(robot)
        return 0 if job is None else job.process.pid

    def close(self) -> None:
        """Cancels all jobs."""
        for robot in tuple(self._jobs):
            self.cancel(robot)

    def _start(self, folder: Path) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "safedpa_services.diagnosis.search_worker", str(folder)]
        return subprocess.Popen(
            [*command, "--settings", self._settings],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Linux shares the processor among sessions; the monitoring needs that of its own
            env={**os.environ, "PYTHONSAFEPATH": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        )


def _kill(process: subprocess.Popen[bytes]) -> None:
    """Kills a process and releases its resources."""
    process.kill()
    process.wait()
    if process.stdin is not None:
        process.stdin.close()
