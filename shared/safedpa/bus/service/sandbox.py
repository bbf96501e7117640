"""A sandbox for untrusted input: a separate process with limits on CPU time and memory, and without keys.

The worker process starts early, while this process is small and has no connections. It imports what it needs some
seconds later, or with the first job, at a low priority. Each job runs in a fork of the worker, which the kernel kills
at its limits of CPU time and memory. The result is a small JSON document, so that untrusted input cannot reach this
process in another form.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import pickle
import signal
import struct
import sys
import time
from collections.abc import Callable
from importlib import import_module
from typing import IO, TYPE_CHECKING, Any, final

from safedpa.errors import InputError
from safedpa.limits import parse_json

if TYPE_CHECKING:
    import subprocess

# Limits of one job. The check of a legitimate model takes a fraction of a second.
_CPU_SECONDS = 5
_MEMORY_BYTES = 1 << 30
OFFER_SECONDS = 20.0
"""Time limit [s] of a job, including the time in the queue. The diagnosis waits for the answer a little longer."""
# Three busy processes at normal priority on two cores leave a process of niceness 5 a fifth of a core, one of niceness
# 10 a fifteenth, and one of niceness 19 a hundredth. A check takes 0.3 s of processor time.
_NICENESS = 5
# Time after its start in which the worker imports what its jobs need, so that the first one does not wait for that.
_WARM_AFTER_SECONDS = 10.0
# Bytes of a result: a model file in canonical form fits.
_LARGEST_RESULT = 1 << 17
# Killed workers that have not exited yet (a process in uninterruptible sleep may take long). Beyond this number no
# other worker is started, so that they cannot accumulate.
_MOST_DYING = 4
# Size of the pipe to the worker. It buffers jobs that the worker has not read yet, so that the loop need not wait.
_PIPE_BYTES = 1 << 20
# Header of a job, because a pipe has no message boundaries: its number, and the length of the pickled argument.
_HEADER = struct.Struct("<IQ")
# The worker inherits real-time scheduling from a service that has it and gives it up first, before it imports anything.
# The imports begin with the first job, or some seconds after the start of the loop, which they must not delay.
_START = (
    "import os,sys;"
    "hasattr(os,'sched_setscheduler') and os.sched_setscheduler(0,os.SCHED_OTHER,os.sched_param(0));"
    f"os.nice({_NICENESS});"
    "sys.path[:]=sys.argv[1].split(os.pathsep);"
    "import select;"
    f"select.select([0],[],[],{_WARM_AFTER_SECONDS});"
    "from safedpa.bus.service.sandbox import serve;"
    "serve(sys.argv[2])"
)


@final
class JobHandle:
    """A submitted job."""

    def __init__(self, worker: JobProcess, number: int, until: float) -> None:
        self._worker, self._number, self._until = worker, number, until

    def outcome(self, *, wait: bool = False) -> dict[str, Any] | None:
        """Returns the result, or None while the job is running; with ``wait``, blocks until there is one.

        A failed job, or one that took too long, has the result ``{"problem": "..."}``.
        """
        while True:
            found = self._worker.take(self._number)
            if found is not None:
                return found
            if self._worker.clock() > self._until:
                self._worker.kill()
                self._worker.take(self._number)  # discard what kill reported for this job
                return {"problem": f"it could not be tried within {OFFER_SECONDS:.0f} s"}
            if not wait:
                return None
            time.sleep(0.005)


@final
class JobProcess:
    """Starts the worker process and submits jobs to it. Not thread-safe.

    A job calls ``function`` (``module:name``) with one picklable argument; the result must be JSON serialisable.
    """

    def __init__(self, function: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._function, self.clock = function, clock
        self._number = 0
        self._process: subprocess.Popen[bytes] | None = None
        self._received = b""
        self._results: dict[int, dict[str, Any]] = {}
        self._pending: set[int] = set()
        """Numbers of the jobs that are running or queued."""
        self._dying: list[subprocess.Popen[bytes]] = []
        self._start()

    @property
    def pid(self) -> int:
        """Process id of the worker; 0 without one."""
        return 0 if self._process is None else self._process.pid

    def submit(self, work: object) -> JobHandle:
        """Submits a job with this argument; never blocks."""
        self._number += 1
        # Pickle only towards the worker, which already has fewer rights than this process. Results come back as JSON.
        content = pickle.dumps(work)
        try:
            if self._process is None or self._process.poll() is not None:
                self._start()
            self._write(_HEADER.pack(self._number, len(content)) + content)
            self._pending.add(self._number)
        except OSError as error:
            # A job may be written in part; after that the stream has no boundaries the worker could find.
            self.kill()
            self._results[self._number] = {"problem": f"it could not be tried ({error.strerror})"}
        return JobHandle(self, self._number, self.clock() + OFFER_SECONDS)

    def take(self, number: int) -> dict[str, Any] | None:
        """Returns and removes the result of a job; None if there is none yet."""
        if self._dying:
            self._reap()
        self._read()
        return self._results.pop(number, None)

    def kill(self) -> None:
        """Kills the worker with all its jobs; the next job starts another worker."""
        process, self._process, self._received = self._process, None, b""
        # Fail all queued jobs now. If each of them waited for its own time-out instead, each would kill the next
        # worker.
        for number in self._pending:
            self._results[number] = {"problem": "it could not be tried: another work before it took too long"}
        self._pending.clear()
        if process is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # the group, which includes the fork that runs the job
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    pipe.close()
            # Not waited for: at the lowest priority its end may take longer than the loop has.
            self._dying.append(process)
        self._reap()

    def close(self) -> None:
        """Kills the worker and waits until all workers have exited; blocks, so not for use in a loop."""
        self.kill()
        for process in self._dying:
            process.wait()
        self._dying.clear()

    def _reap(self) -> None:
        self._dying = [process for process in self._dying if process.poll() is None]

    def _start(self) -> None:
        import subprocess  # slow to import, and not needed by modules that only use job handles

        self.kill()
        if len(self._dying) >= _MOST_DYING:
            raise OSError(errno.EAGAIN, f"{len(self._dying)} killed workers have not exited yet")
        # -S skips site-packages' start-up files; sys.path is passed on explicitly. One thread each for the numerical
        # libraries: they would otherwise start one per core.
        command = [sys.executable, "-S", "-c", _START, os.pathsep.join(filter(None, sys.path)), self._function]
        environment = {**os.environ, "PYTHONSAFEPATH": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # a process group of its own, for killpg; and no signals from the terminal
            env=environment,
            cwd="/",  # keeps no directory busy, and imports nothing from the current one
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        for pipe in (self._process.stdin, self._process.stdout):
            os.set_blocking(pipe.fileno(), False)
        # Linux only, and subject to a per-user limit. Without it the pipe has the default of 64 KiB, and larger jobs
        # fail more often on a busy machine.
        import fcntl

        with contextlib.suppress(OSError, AttributeError):
            fcntl.fcntl(self._process.stdin.fileno(), fcntl.F_SETPIPE_SZ, _PIPE_BYTES)

    def _write(self, content: bytes) -> None:
        """Writes to the worker without blocking. Raises OSError if the worker does not read in time."""
        assert self._process is not None
        assert self._process.stdin is not None
        # The loop has other robots to serve; 2 ms are enough for a worker that is reading.
        written, until = 0, self.clock() + 0.002
        while written < len(content):
            try:
                written += os.write(self._process.stdin.fileno(), content[written:])
            except BlockingIOError:
                if self.clock() > until:
                    raise OSError(errno.EAGAIN, "the worker is busy with other jobs") from None
                time.sleep(0.0002)

    def _read(self) -> None:
        if self._process is None or self._process.stdout is None:
            return
        with contextlib.suppress(BlockingIOError):
            while piece := os.read(self._process.stdout.fileno(), _LARGEST_RESULT):
                self._received += piece
        *lines, self._received = self._received.split(b"\n")
        for line in lines:
            try:
                found = parse_json(line)
                number = int(found.pop("number"))
                self._pending.remove(number)  # KeyError for a number that was not submitted
                self._results[number] = found
            except (InputError, KeyError, ValueError, AttributeError):
                # The worker is not trusted either. A job without a valid result ends with its time-out.
                continue


def serve(function: str) -> None:
    """Runs in the worker: reads jobs from standard input until it closes, and runs each in a fork.

    A function ``prepare`` of the job's module, if there is one, is called first: it imports what the jobs need.
    """
    os.environ["PYTHONSAFEPATH"] = "1"
    module, _, name = function.partition(":")
    loaded = import_module(module)
    work = getattr(loaded, name)
    getattr(loaded, "prepare", lambda: None)()
    source, sink = sys.stdin.buffer, sys.stdout.buffer
    while True:
        header = source.read(_HEADER.size)
        if len(header) < _HEADER.size:
            return
        number, length = _HEADER.unpack(header)
        content = source.read(length)
        found = _forked(work, content)
        sink.write(json.dumps({**found, "number": number}).encode() + b"\n")
        sink.flush()


def _forked(work: Callable[[Any], dict[str, Any]], content: bytes) -> dict[str, Any]:
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        with os.fdopen(writing, "wb") as pipe:
            _carry_out(work, content, pipe)
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as pipe:
        output = pipe.read(_LARGEST_RESULT)
    # The pipe is at its end, or has more than the limit: in the second case the child would block on it forever.
    with contextlib.suppress(ProcessLookupError):
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    try:
        found = json.loads(output)
    except ValueError:
        found = {"problem": _reason_of_exit(status)}
    return found if isinstance(found, dict) else {"problem": "its answer cannot be read"}


def _carry_out(work: Callable[[Any], dict[str, Any]], content: bytes, pipe: IO[bytes]) -> None:
    import resource

    # Hard limits, which the child cannot raise again. No core dumps and no files: a job only computes.
    resource.setrlimit(resource.RLIMIT_CPU, (_CPU_SECONDS, _CPU_SECONDS))
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_BYTES, _MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    try:
        found = work(pickle.loads(content))
    except Exception as error:  # noqa: BLE001
        # A foreign document may cause any exception; its text is the reason of the refusal.
        found = {"problem": " ".join(str(error).split())[:300] or type(error).__name__}
    pipe.write(json.dumps(found).encode())


def _reason_of_exit(status: int) -> str:
    number = os.waitstatus_to_exitcode(status)
    # With equal soft and hard limits Linux sends SIGKILL at RLIMIT_CPU, other systems SIGXCPU.
    if number in (-signal.SIGXCPU, -signal.SIGKILL):
        return f"trying it took more than {_CPU_SECONDS} s of processor time"
    return f"trying it took more than {_MEMORY_BYTES >> 20} MiB of memory, or ended its process (code {number})"
