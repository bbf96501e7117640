"""Work on what strangers sent, in a process of its own: with little processor, little memory, and no key.

The process is started bare and early, while this one is small and has no links; it imports what it needs when the
first work comes, behind everybody else on the machine. Each work runs in a fork of it that the kernel ends at its
limits of processor time and memory. What comes back is JSON, and small: anyone who sent the work in cannot choose more.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import pickle
import resource
import signal
import struct
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from importlib import import_module
from typing import IO, TYPE_CHECKING, Any, final

from safedpa.errors import InputError
from safedpa.limits import parse_json

if TYPE_CHECKING:
    import subprocess

__all__ = ["AbstractJobHandle", "JobProcess", "serve"]

_PROCESSOR_SECONDS = 5
_MEMORY_BYTES = 1 << 30
_LONGEST_SECONDS = 20.0
"""For one work, waiting included: on a machine that is busy for so long nothing should be changed anyway."""
_NICENESS = 19
_LARGEST_RESULT = 1 << 17
_MOST_DYING = 4
"""Ended processes that are not gone yet, beyond which no other is started."""
_WAITING_BYTES = 1 << 20
"""Of works that the process has not read yet."""
_LENGTH = struct.Struct("<IQ")
_START = (
    "import os,sys;"
    "hasattr(os,'sched_setscheduler') and os.sched_setscheduler(0,os.SCHED_OTHER,os.sched_param(0));"
    f"os.nice({_NICENESS});"
    "first=sys.stdin.buffer.read(1);"
    "sys.path[:]=sys.argv[1].split(os.pathsep);"
    "from safedpa.bus.service.sandbox import serve;"
    "first and serve(first,sys.argv[2])"
)
"""Below real time before anything else, then asleep until there is work."""


class AbstractJobHandle(ABC):
    """A work that was handed in."""

    @abstractmethod
    def outcome(self, *, wait: bool = False) -> dict[str, Any] | None:
        """What came of it; None while it is under way, unless someone waits.

        ``{"problem": "..."}`` where there is nothing else, also because it took too long.
        """


@final
class _JobHandle(AbstractJobHandle):
    def __init__(self, apart: JobProcess, number: int, until: float) -> None:
        self._apart, self._number, self._until = apart, number, until

    def outcome(self, *, wait: bool = False) -> dict[str, Any] | None:
        while True:
            found = self._apart.take(self._number)
            if found is not None:
                return found
            if self._apart.clock() > self._until:
                self._apart.give_up()
                self._apart.take(self._number)
                return {"problem": f"it could not be tried within {_LONGEST_SECONDS:.0f} s"}
            if not wait:
                return None
            time.sleep(0.005)


@final
class JobProcess:
    """Starts the process that carries out ``function`` (``module:name``), of one picklable argument each.

    ``function`` returns what JSON can say. Not for several threads at once.
    """

    def __init__(self, function: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._function, self.clock = function, clock
        self._number = 0
        self._process: subprocess.Popen[bytes] | None = None
        self._came = b""
        self._found: dict[int, dict[str, Any]] = {}
        self._pending: set[int] = set()
        """Works that the process has, or that wait for it."""
        self._dying: list[subprocess.Popen[bytes]] = []
        self._start()

    @property
    def pid(self) -> int:
        """Of the process."""
        return 0 if self._process is None else self._process.pid

    def hand_in(self, work: object) -> AbstractJobHandle:
        """Begins a work; never waits for it."""
        self._number += 1
        content = pickle.dumps(work)
        try:
            if self._process is None or self._process.poll() is not None:
                self._start()
            self._write(_LENGTH.pack(self._number, len(content)) + content)
            self._pending.add(self._number)
        except OSError as error:
            self.give_up()
            self._found[self._number] = {"problem": f"it could not be tried ({error.strerror})"}
        return _JobHandle(self, self._number, self.clock() + _LONGEST_SECONDS)

    def take(self, number: int) -> dict[str, Any] | None:
        """The outcome of a work, if it is there."""
        if self._dying:
            self._reap()
        self._read()
        return self._found.pop(number, None)

    def give_up(self) -> None:
        """Ends the process and whatever it does; the next work starts it again.

        No one waits for it to die: at the lowest priority that may take longer than the loop has. Whose work it had is
        told at once, so that each of them does not end the next process in turn.
        """
        process, self._process, self._came = self._process, None, b""
        for number in self._pending:
            self._found[number] = {"problem": "it could not be tried: another work before it took too long"}
        self._pending.clear()
        if process is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    pipe.close()
            self._dying.append(process)
        self._reap()

    def close(self) -> None:
        """Gives up, and waits until every process is gone; not for the loop."""
        self.give_up()
        for process in self._dying:
            process.wait()
        self._dying.clear()

    def _reap(self) -> None:
        self._dying = [process for process in self._dying if process.poll() is None]

    def _start(self) -> None:
        import subprocess  # anyone who only takes tickets does without

        self.give_up()
        if len(self._dying) >= _MOST_DYING:
            raise OSError(errno.EAGAIN, f"{len(self._dying)} processes that were ended have not ended yet")
        command = [sys.executable, "-S", "-c", _START, os.pathsep.join(filter(None, sys.path)), self._function]
        environment = {**os.environ, "PYTHONSAFEPATH": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            env=environment,
            cwd="/",
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        for pipe in (self._process.stdin, self._process.stdout):
            os.set_blocking(pipe.fileno(), False)
        with contextlib.suppress(OSError, AttributeError):  # else the kernel's own 64 KiB
            fcntl.fcntl(self._process.stdin.fileno(), fcntl.F_SETPIPE_SZ, _WAITING_BYTES)

    def _write(self, content: bytes) -> None:
        """At once or not at all: who does not read in time is ended, since no one in the loop may wait for it."""
        assert self._process is not None
        assert self._process.stdin is not None
        written, until = 0, self.clock() + 0.002
        while written < len(content):
            try:
                written += os.write(self._process.stdin.fileno(), content[written:])
            except BlockingIOError:
                if self.clock() > until:
                    raise OSError(errno.EAGAIN, "its process is busy with others") from None
                time.sleep(0.0002)

    def _read(self) -> None:
        if self._process is None or self._process.stdout is None:
            return
        with contextlib.suppress(BlockingIOError):
            while piece := os.read(self._process.stdout.fileno(), _LARGEST_RESULT):
                self._came += piece
        *lines, self._came = self._came.split(b"\n")
        for line in lines:
            try:
                found = parse_json(line)
                number = int(found.pop("number"))
                self._pending.remove(number)
                self._found[number] = found
            except (InputError, KeyError, ValueError, AttributeError):
                continue


def serve(first: bytes, function: str) -> None:
    """The process's own part: reads works from standard input until it closes; one fork each."""
    os.environ["PYTHONSAFEPATH"] = "1"
    module, _, name = function.partition(":")
    work = getattr(import_module(module), name)
    source, sink = sys.stdin.buffer, sys.stdout.buffer
    while True:
        head = first + source.read(_LENGTH.size - len(first))
        first = b""
        if len(head) < _LENGTH.size:
            return
        number, length = _LENGTH.unpack(head)
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
        notice = pipe.read(_LARGEST_RESULT)
    with contextlib.suppress(ProcessLookupError):
        os.kill(child, signal.SIGKILL)  # it has said everything, or too much
    _, status = os.waitpid(child, 0)
    try:
        found = json.loads(notice)
    except ValueError:
        found = {"problem": _ending(status)}
    return found if isinstance(found, dict) else {"problem": "it answered nothing that can be read"}


def _carry_out(work: Callable[[Any], dict[str, Any]], content: bytes, pipe: IO[bytes]) -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (_PROCESSOR_SECONDS, _PROCESSOR_SECONDS))
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_BYTES, _MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    try:
        found = work(pickle.loads(content))
    except Exception as error:  # noqa: BLE001  whatever a foreign document brings about
        found = {"problem": " ".join(str(error).split())[:300] or type(error).__name__}
    pipe.write(json.dumps(found).encode())


def _ending(status: int) -> str:
    number = os.waitstatus_to_exitcode(status)
    if number in (-signal.SIGXCPU, -signal.SIGKILL):
        return f"trying it took more than {_PROCESSOR_SECONDS} s of processor time"
    return f"trying it took more than {_MEMORY_BYTES >> 20} MiB of memory, or ended its process (code {number})"
