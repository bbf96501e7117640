"""Runs readers in a process of their own, with limits on processor time, memory and disk.

A file can be made so that reading it never ends. The first call starts a small server process. It forks a worker for
each file and a guard that waits for it, so that a call takes milliseconds and works from any thread. The worker also
ends if the caller stops waiting, for example at Ctrl-C. Read ``in_own_process`` first.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import os
import pickle
import select
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Generator, Iterator
from functools import wraps
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any, Concatenate, NoReturn, ParamSpec, TypeVar

import numpy as np

from safedpa.errors import InputError, RunError
from safedpa.limits import limit, too_much

__all__ = ["allow_for", "in_own_process", "in_this_process", "iterated_in_own_process", "reader_seconds", "serve"]

_Arguments = ParamSpec("_Arguments")
_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

_SECONDS_PER_BYTE = 10e-6
"""Processor time allowed for each byte beyond the base; the slowest reader, of ROS messages, needs 0.5e-6."""
_MEMORY_PER_BYTE = 30
"""Memory allowed for each byte; the most that a reader needs is 12, for a bag of short messages."""
_WAIT_PER_SECOND, _MIN_WAIT = 20.0, 300.0
"""Time [s] for which a caller waits, for each second of processor time, and at least."""
_HEADER = struct.Struct("<Q")
"""A number of parts, or the length of one."""
_TABLE = ("pyarrow.parquet", "pyarrow.csv", "pyarrow.compute")
_ROS = ("rosbags.typesys", "rosbags.serde", "mcap.records", "mcap.data_stream", "lz4.frame", "zstandard", "sqlite3")
_LIBRARIES = {
    b"\x89MCAP": _ROS, b"SQLite": _ROS, b"#ROSBAG": _ROS, b"ULog": ("pyulog.core",),
    b"MATLAB": ("scipy.io", "h5py"), b"\x89HDF": ("h5py",), b"PK": (),
}  # fmt: skip
"""Slow imports by the first bytes of a file, other than a table: the server imports them once, for all workers."""
_START = (
    "import sys;sys.path[:]=sys.argv[2].split(sys.argv[3]);"
    "from safedpa.records.readers.own_process import serve;serve(int(sys.argv[1]))"
)
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "ARROW_DEFAULT_MEMORY_POOL": "system"}
"""The libraries of a worker take only the memory that they use."""
_HEAP = "glibc.malloc.hugetlb=1:glibc.malloc.mmap_threshold=33554432:glibc.malloc.trim_threshold=1073741824:"
_HEAP += "glibc.malloc.top_pad=33554432"
"""A worker is new, so that each page of memory costs a fault: the heap grows in large pages, and is used again."""
_ALIGNMENT = 64
"""Bytes; NumPy reads aligned arrays faster."""
_MAX_FILES = 10_000
"""Files of a folder that count for its limits."""
_PATIENT, _NEXT = "+", b"."
"""Mark of a request whose worker may wait for its caller, and the message that asks for the next item."""
_STACK_BYTES = 2 << 20
"""Stack of each thread of a library, which counts as memory of the worker."""

_direct = threading.local()
_lock = threading.Lock()
_server: list[tuple[subprocess.Popen[bytes], socket.socket]] = []
_spent = [0.0]
_warned: list[bool] = []


def in_own_process(
    read: Callable[Concatenate[Path, _Arguments], _Result],
) -> Callable[Concatenate[Path, _Arguments], _Result]:
    """Decorates a reader, a module's function whose first argument is a file or folder, to run in another process.

    Arguments and result are pickled. Raises what the reader raises, and LimitError if it needs more processor time or
    memory than files of that size do. Calls inside such a process are direct, and all are on other systems than Linux.
    """

    @wraps(read)
    def called(path: Path, /, *arguments: _Arguments.args, **options: _Arguments.kwargs) -> _Result:
        if _is_direct():
            return read(path, *arguments, **options)
        with _connected(path, "") as connection:
            _send(connection, _request(read, (path, *arguments), options))
            found = _receive(connection)
        result: _Result = _result(path, found)
        return result

    return called


def iterated_in_own_process(
    read: Callable[Concatenate[Path, _Arguments], Generator[_Item, None, _Result]],
) -> Callable[Concatenate[Path, _Arguments], Generator[_Item, None, _Result]]:
    """Decorates a reader that yields, such as one of a recording of hours; otherwise like ``in_own_process``.

    Each item is pickled, so that it should hold some 1,000 messages. The worker reads one item ahead, waits while the
    caller uses it, and ends with the iteration. Errors are raised while iterating.
    """

    @wraps(read)
    def called(
        path: Path, /, *arguments: _Arguments.args, **options: _Arguments.kwargs
    ) -> Generator[_Item, None, _Result]:
        if _is_direct():
            return (yield from read(path, *arguments, **options))
        with _connected(path, _PATIENT) as connection:
            connection.settimeout(_wait())
            _send(connection, _request(read, (path, *arguments), options))
            while (found := _receive(connection)) and found[0] == "item":
                with contextlib.suppress(BrokenPipeError, ConnectionError):  # of a worker that a limit ended
                    connection.send(_NEXT)
                yield found[1]
        result: _Result = _result(path, found)
        return result

    return called


def _is_direct() -> bool:
    """Whether readers run in this process; warns once where no limits can be set."""
    on = getattr(_direct, "on", False)
    if not on and sys.platform != "linux" and not _warned:
        _warned.append(True)
        warnings.warn("log files are read without limits of time and memory on this system", stacklevel=3)
    return on or sys.platform != "linux"


def _request(read: Callable[..., Any], arguments: tuple[Any, ...], options: dict[str, Any]) -> object:
    place = (Path.cwd(), dict(os.environ), [os.path.abspath(folder) for folder in sys.path if folder])
    return place, pickle.dumps((read.__module__, read.__qualname__, arguments, options))


def _result(path: Path, found: tuple[str, Any, float] | None) -> Any:
    """The result of a worker; raises what it raised, or the error that names how it ended."""
    answer: tuple[str, Any, float] = found or ("stopped", -signal.SIGKILL, 0.0)
    kind, content, seconds = answer
    with _lock:
        _spent[0] += seconds
    if kind == "result":
        return content
    if kind == "error":
        raise content
    raise _stopped(path, content)


@contextlib.contextmanager
def in_this_process() -> Iterator[None]:
    """Within the block, readers run directly in this thread: for measurements of a reader, and inside a sandbox."""
    before = getattr(_direct, "on", False)
    _direct.on = True
    try:
        yield
    finally:
        _direct.on = before


def allow_for(size: int) -> None:
    """Raises the limits of this worker for ``size`` bytes that were unpacked; does nothing in another process."""
    if not getattr(_direct, "worker", False):
        return
    import resource

    left, _ = signal.getitimer(signal.ITIMER_PROF)
    if left > 0.0:
        signal.setitimer(signal.ITIMER_PROF, left + _SECONDS_PER_BYTE * size)
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (soft + _MEMORY_PER_BYTE * size, hard))


def reader_seconds() -> float:
    """Processor time [s] of the readers that this process has started and that have returned a result or an error."""
    return _spent[0]


# the caller


def _libraries(path: Path) -> str:
    try:
        if not path.is_file():  # opening a named pipe would wait for its writer
            return " ".join((*_ROS, *_TABLE)) if path.is_dir() else ""
        with path.open("rb") as file:
            start = file.read(8)
    except (OSError, ValueError):
        return ""
    return " ".join(next((names for magic, names in _LIBRARIES.items() if start.startswith(magic)), _TABLE))


@contextlib.contextmanager
def _connected(path: Path, mark: str) -> Iterator[socket.socket]:
    """Yields a connection to a new worker for a file; raises RunError if there is none, or it does not answer."""
    ours, theirs = socket.socketpair()
    with ours:
        try:
            with theirs:
                _submit(mark + _libraries(path), theirs)
            yield ours
        except TimeoutError as error:
            raise _stopped(path, -signal.SIGKILL) from error
        except OSError as error:
            raise RunError(f"{path}: no process can be started to read it ({error}); try again") from error


def _submit(libraries: str, connection: socket.socket) -> None:
    """Hands a connection to the server, which is started if there is none; raises OSError."""
    with _lock:
        for _ in range(2):
            if not _server:
                _server.append(_started())
            with contextlib.suppress(BrokenPipeError, ConnectionError):
                socket.send_fds(_server[0][1], [libraries.encode() or b" "], [connection.fileno()])
                return
            _stop()
    raise OSError("its server ended")


def _started() -> tuple[subprocess.Popen[bytes], socket.socket]:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)  # whole messages, also of forks of this one
    search_path = os.pathsep.join(filter(None, sys.path))
    with theirs:
        process = subprocess.Popen(
            [sys.executable, "-S", "-c", _START, str(theirs.fileno()), search_path, os.pathsep],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd="/",
            pass_fds=[theirs.fileno()], start_new_session=True,
            env={**os.environ, **_ENVIRONMENT, "GLIBC_TUNABLES": _HEAP},
        )  # fmt: skip
    return process, ours


def _stop() -> None:
    while _server:
        process, control = _server.pop()
        control.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(1.0)


atexit.register(_stop)


def _send(connection: socket.socket, item: object) -> None:
    """Sends a pickled object in a file of memory, which costs less than sending its bytes.

    It begins with the number of parts and their lengths; the parts are the pickle and the arrays.
    """
    buffers: list[pickle.PickleBuffer] = []
    content = pickle.dumps(item, protocol=5, buffer_callback=buffers.append)
    parts: list[Any] = [content, *(buffer.raw() for buffer in buffers)]
    head = b"".join(_HEADER.pack(number) for number in (len(parts), *map(len, parts)))
    with open(os.memfd_create("safedpa-reader"), "wb") as memory:
        for part in (head, *parts):
            memory.seek(-memory.tell() % _ALIGNMENT, os.SEEK_CUR)
            memory.write(part)
        memory.flush()
        socket.send_fds(connection, [b"."], [memory.fileno()])


def _receive(connection: socket.socket) -> Any:
    """The next object; None if the other side ended before it."""
    _, received, _, _ = socket.recv_fds(connection, 1, 1)
    if not received:
        return None
    with open(received[0], "rb", buffering=0) as memory:
        content = np.empty(memory.seek(0, os.SEEK_END), np.uint8)  # NumPy takes large pages for a large array
        memory.seek(0)
        view = content.data
        while view:
            view = view[memory.readinto(view) :]
    view = content.data
    (count,) = _HEADER.unpack_from(view)
    sizes = [size for (size,) in _HEADER.iter_unpack(view[_HEADER.size : _HEADER.size * (count + 1)])]
    parts, at = [], _HEADER.size * (count + 1)
    for size in sizes:
        at += -at % _ALIGNMENT
        parts.append(view[at : at + size])
        at += size
    return pickle.loads(parts[0], buffers=parts[1:])


def _stopped(path: Path, code: object) -> InputError:
    """The error for a worker that was ended by a limit, or by a library that crashed."""
    if code == -signal.SIGPROF:
        return too_much("reader_milliseconds", "more", str(path))
    if code == "memory":
        return too_much("reader_bytes", "more", str(path))
    return RunError(f"{path}: reading it ended a process ({code}); it is damaged or malicious; copy it again")


# the server, its guards and workers


def serve(control: int) -> NoReturn:
    """Runs in the server: forks a guard for each connection that it receives, until its caller ends."""
    import resource

    import_module("safedpa.records.load")
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the kernel collects guards
    resource.setrlimit(resource.RLIMIT_STACK, (_STACK_BYTES, resource.getrlimit(resource.RLIMIT_STACK)[1]))
    requests = socket.socket(fileno=control)
    while True:
        libraries, received, _, _ = socket.recv_fds(requests, 4096, 1)
        if not received:
            os._exit(0)
        names = libraries.decode()
        for name in names.removeprefix(_PATIENT).split():
            with contextlib.suppress(ImportError):
                import_module(name)
        gc.freeze()  # a collection in a worker would copy the pages of all modules
        if os.fork() == 0:
            requests.close()
            _guard(socket.socket(fileno=received[0]), patient=names.startswith(_PATIENT))
        os.close(received[0])


def _wait() -> float:
    """Time [s] after which a worker that does not answer is given up."""
    return max(_MIN_WAIT, _WAIT_PER_SECOND * limit("reader_milliseconds") / 1e3)


def _guard(connection: socket.socket, *, patient: bool) -> NoReturn:
    """Waits for a worker, removes its files, and reports how it ended; kills it if the caller hangs up.

    ``patient``: the caller limits the time, because the worker may wait for it.
    """
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    folder = tempfile.mkdtemp(prefix="safedpa-reader-")
    worker = os.fork()
    if worker == 0:
        _work(connection, folder)
    ended = os.pidfd_open(worker)
    events = select.poll()
    events.register(ended, select.POLLIN)
    events.register(connection, select.POLLRDHUP)
    if ended not in dict(events.poll(None if patient else _wait() * 1e3)):
        os.kill(worker, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(os.waitpid(worker, 0)[1])
    shutil.rmtree(folder, ignore_errors=True)
    if code:
        with contextlib.suppress(OSError):
            _send(connection, ("stopped", code, 0.0))
    os._exit(0)


def _work(connection: socket.socket, folder: str) -> NoReturn:
    import resource

    request = _receive(connection)
    if request is None:
        os._exit(0)
    (current, environment, search_path), called = request
    os.chdir(current)
    sys.path[:] = search_path
    os.environ.clear()
    os.environ.update({**environment, **_ENVIRONMENT, "SQLITE_TMPDIR": folder})
    tempfile.tempdir = folder
    answer: tuple[str, Any]
    try:
        module, name, arguments, options = pickle.loads(called)
        read = getattr(import_module(module), name).__wrapped__
        _set_limits(_size(arguments[0]))
        found = read(*arguments, **options)
        answer = ("result", _sent(connection, found) if isinstance(found, Generator) else found)
    except MemoryError:
        answer = ("stopped", "memory")
    except Exception as error:  # noqa: BLE001  raised again in the caller
        if not isinstance(error, InputError):
            error.add_note(traceback.format_exc())
        answer = ("error", error)
    signal.setitimer(signal.ITIMER_PROF, 0.0)
    for kind in (resource.RLIMIT_DATA, resource.RLIMIT_FSIZE):
        resource.setrlimit(kind, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    with contextlib.suppress(OSError):
        _send(connection, (*answer, time.process_time()))
    os._exit(0)


def _sent(connection: socket.socket, items: Generator[Any, None, Any]) -> Any:
    """Sends items, each after the one before was taken, and returns what the generator returns."""
    while True:
        try:
            item = next(items)
        except StopIteration as end:
            return end.value
        _send(connection, ("item", item))
        if not connection.recv(1):
            os._exit(0)  # the caller hung up


def _size(path: Path) -> int:
    """Bytes of a file, or of the files in a folder; 0 if it is missing."""
    try:
        if not path.is_dir():
            return path.stat().st_size
        return sum(file.stat().st_size for file in islice(path.rglob("*"), _MAX_FILES) if file.is_file())
    except OSError:
        return 0


def _set_limits(size: int) -> None:
    """Limits this process for a file of ``size`` bytes; without a handler the signal of the timer ends it."""
    import resource

    _direct.on = _direct.worker = True
    with open("/proc/self/statm", encoding="ascii") as file:
        used = int(file.read().split()[5]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_DATA, (used + limit("reader_bytes"), resource.RLIM_INFINITY))
    written = max(limit("expansion_free_bytes"), size * limit("expansion"))
    resource.setrlimit(resource.RLIMIT_FSIZE, (written, resource.RLIM_INFINITY))
    signal.setitimer(signal.ITIMER_PROF, limit("reader_milliseconds") / 1e3)
    allow_for(size)
