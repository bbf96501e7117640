"""The background process: results, progress, errors, and an end at any moment."""

import asyncio
import importlib
import os

import pytest

from safedpa.errors import InputError, SafedpaError
from safedpa_services.workbench.session.worker import StoppedError, Worker

JOBS = """
import errno, os, threading
from safedpa.errors import InputError

def doubled(number, tell):
    tell(0.5)
    return 2 * number

def refused(tell):
    raise InputError("got nothing, wanted something")

def broken(tell):
    return 1 / 0

def no_room(tell):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/somewhere/model.toml")

def endless(tell):
    tell(0.1)
    threading.Event().wait()

def niceness(tell):
    return os.nice(0)
"""


@pytest.fixture
def jobs(tmp_path, monkeypatch):
    """A module of jobs that the other process finds as well."""
    (tmp_path / "workbench_test_jobs.py").write_text(JOBS, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    return importlib.import_module("workbench_test_jobs")


@pytest.fixture
def worker():
    made = Worker()
    yield made
    made.stop()


@pytest.mark.long
@pytest.mark.processes
def test_results_progress_errors_and_restarts(worker, jobs, finished):
    reported = []

    async def story():
        assert await worker.ask(jobs.doubled, 21, report_progress=reported.append) == 42
        with pytest.raises(InputError, match="wanted something"):
            await worker.ask(jobs.refused)
        with pytest.raises(SafedpaError, match="ZeroDivisionError"):
            await worker.ask(jobs.broken)
        with pytest.raises(SafedpaError, match=r"^/somewhere/model.toml: cannot be written or read \(the disk is full"):
            await worker.ask(jobs.no_room)
        assert await worker.ask(jobs.niceness) > os.nice(0)
        with pytest.raises(StoppedError):
            await worker.ask(jobs.endless, report_progress=lambda _share: worker.stop())
        assert await worker.ask(jobs.doubled, 4) == 8
        both = await asyncio.gather(worker.ask(jobs.doubled, 1), worker.ask(jobs.doubled, 2))
        assert both == [2, 4]

    finished(story())
    assert reported == [0.5]
