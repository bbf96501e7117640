"""Start and end of a process of the fleet: bus options, signals, exit codes, garbage collection.

Every uncaught exception, on any thread, ends the process with exit code 70. Otherwise a thread of the network library
would keep the process, and its liveliness token, alive without a working loop. A supervised process ends with its
supervisor, however that ends, because its standard input then closes.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import io
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from enum import IntEnum
from pathlib import Path
from types import TracebackType
from typing import Final, TextIO

from safedpa.bus.logging import log_event
from safedpa.bus.messages.service_info import mark_as_supervised, software_version
from safedpa.bus.security.certificates import Certificates, PemCredentials, protect_process_memory
from safedpa.bus.security.connection_reaper import raise_descriptor_limit
from safedpa.bus.transport.bus import Bus
from safedpa.bus.transport.zenoh import Mode, ZenohSettings, ZenohTransport
from safedpa.errors import BusError, JoinError, SafedpaError
from safedpa.limits import readable

GROWTH: Final = 50_000
"""Number of new container objects after which Python's garbage collector runs. A batch of a hundred robots allocates
more than Python's default of 700 at once, and each run then scans the sliding windows of measurements: 7 % of a fleet's
CPU time, in stalls of up to 17 ms, although the code creates no reference cycles. Cycles are still found, later."""
# Collections of a generation before the next older one is collected. With Python's default of 10, cycles that survived
# for a while would stay until a million containers were allocated. A process that does not grow never collects.
_OLDER: Final = 1


def freeze_garbage_collector() -> None:
    """Excludes all existing objects from garbage collection; call it after creating the long-lived data."""
    gc.collect()
    gc.freeze()
    # CPython runs a full collection only once the new objects exceed a quarter of those that survived the last full
    # one. This collection of an empty heap sets that count to zero.
    gc.collect()
    gc.set_threshold(GROWTH, _OLDER, _OLDER)


EXIT_CRASHED = 70  # EX_SOFTWARE of sysexits.h
EXIT_BAD_INPUT = 2
EXIT_NOT_LET_IN = 75  # EX_TEMPFAIL of sysexits.h
"""The process could not join the bus; its supervisor retries."""
EXIT_INTERRUPTED = 130
"""The process ended immediately at a second signal."""


class RealtimePriority(IntEnum):
    """Real-time priorities (1 to 99) that decide who runs first when there is not enough CPU time.

    All are below the kernel's own threads. A state wakes all services at once; the more urgent a service is for the
    action, the higher its priority. The policy computes the nominal action while the filter could only prepare, and a
    latent is still useful one tick later. The robot and the router have little to do, and all others wait for them.
    """

    LAST = 9
    ADAPTATION = 10
    FILTER = 11
    POLICY = 12
    ROBOT = 13
    ROUTER = 14


class StopSignal:
    """A request to end the process: by SIGTERM, by SIGINT, or by the end of the supervisor; see ``reason``."""

    def __init__(self) -> None:
        self._event = threading.Event()
        self._started = threading.Event()
        self.reason = ""
        self.hurried = False
        """Whether a second signal arrived, at which an orderly shutdown is cut short."""
        self._signalled = False
        self.signals = 0
        """Signals of the supervisor: the first is that to start."""

    def __call__(self) -> bool:
        """Whether the process should end."""
        return self._event.is_set()

    def wait(self) -> None:
        """Blocks until the process should end."""
        self._event.wait()

    def wait_for_start(self) -> None:
        """Blocks until the supervisor gives the start signal, or the process should end."""
        self._started.wait()

    def start(self) -> None:
        """Gives the start signal, or a further one."""
        self.signals += 1
        self._started.set()

    def listen_to_signals(self, at_once: Callable[[], None] = lambda: None) -> None:
        """Handles SIGTERM and SIGINT by an orderly shutdown; only the main thread may call it.

        A second signal sets ``hurried`` and calls ``at_once``.
        """

        def heard(number: int, _frame: object) -> None:
            self.set(signal.Signals(number).name)
            self.hurried, self._signalled = self._signalled, True
            if self.hurried:
                at_once()

        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, heard)

    def set(self, reason: str) -> None:
        """Requests the end of the process; the first reason is kept."""
        self.reason = self.reason or reason
        self._event.set()
        self._started.set()  # a process that waits for its start must end, too


def add_bus_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options by which a process joins a fleet."""
    parser.add_argument("--fleet", default="fleet", help="name of the fleet")
    parser.add_argument("--mode", choices=("peer", "client", "router"), help="default: peer, with certificates client")
    parser.add_argument("--listen", action="append", default=[], metavar="ENDPOINT", help="such as tcp/0.0.0.0:7447")
    parser.add_argument("--connect", action="append", default=[], metavar="ENDPOINT", help="such as tls/router:7447")
    parser.add_argument(
        "--certificates", type=Path, metavar="DIR", help="authenticate with the certificates in DIR; see --role"
    )
    parser.add_argument("--role", default="", help="role of the certificate to use, such as robot.r1 or safety_filter")
    add_credentials_option(parser)


def add_credentials_option(parser: argparse.ArgumentParser) -> None:
    """Adds the option by which a supervisor passes a certificate and key to a process."""
    parser.add_argument(
        "--card", type=int, metavar="DESCRIPTOR", help="read the certificate and key of --role from this descriptor"
    )


def bus_from_options(options: argparse.Namespace) -> Bus:
    """Opens the bus that the options describe. Raises BusError if that fails."""
    return Bus(ZenohTransport(transport_settings_from_options(options)), options.fleet)


def identity_from_options(options: argparse.Namespace) -> PemCredentials | Certificates | None:
    """Returns the credentials that the options name; None for a bus in plain text. Raises BusError."""
    if options.card is not None:
        # Before the key is in memory: from now on, other processes of this user cannot read it there.
        protect_process_memory()
        # The descriptor can be read once. Options are published in the setup message, so it is removed from them.
        descriptor, options.card = options.card, None
        return PemCredentials.from_descriptor(descriptor, options.role)
    if options.certificates is None and options.role:
        raise BusError(f"--role {options.role}: --certificates is missing, wanted the folder of the role's certificate")
    return None if options.certificates is None else Certificates(options.certificates, options.role)


@contextlib.contextmanager
def log_lifetime(service: str, stop: StopSignal) -> Iterator[None]:
    """Logs that the service is on the bus and, unless it crashes, why it ends."""
    log_event("process.started", f"{service} is on the bus", service=service, version=software_version())
    yield
    why = stop.reason or "its work is done"
    log_event("process.ended", f"{service} shuts down: {why}", service=service)


def transport_settings_from_options(options: argparse.Namespace) -> ZenohSettings:
    """Returns the network settings that the options describe.

    Raises BusError if the certificates are missing or do not fit the other options.
    """
    certificates = identity_from_options(options)
    mode: Mode = options.mode or ("peer" if certificates is None else "client")
    return ZenohSettings(mode, tuple(options.listen), tuple(options.connect), certificates)


def run_process(
    work: Callable[[argparse.Namespace, StopSignal], int],
    parser: argparse.ArgumentParser,
    urgency: RealtimePriority = RealtimePriority.LAST,
) -> None:
    """Parses the options, runs ``work``, and ends the process with its exit code; never returns.

    ``urgency`` is the priority of a process started with ``--realtime``.
    """
    # Before anything else: from here on no exception, on no thread, leaves a half-dead process behind.
    sys.excepthook = _end_at_once
    threading.excepthook = lambda arguments: _end_at_once(
        arguments.exc_type, arguments.exc_value or arguments.exc_type(), arguments.exc_traceback
    )
    sys.stdout, sys.stderr = _LogStream(sys.stdout), _LogStream(sys.stderr)
    parser.add_argument("--realtime", action="store_true", help="use real-time scheduling if the system permits it")
    parser.add_argument("--log", choices=("text", "json"), help="default: text on a terminal, json in a pipe")
    parser.add_argument("--supervised", action="store_true", help="end when standard input closes")
    options = parser.parse_args()
    if options.log:
        os.environ["SAFEDPA_LOG"] = options.log  # the environment, so that child processes inherit the format
    raise_descriptor_limit()  # before the bus opens, which needs a descriptor per connection
    stop = StopSignal()
    stop.listen_to_signals(lambda: _leave(EXIT_INTERRUPTED))
    if options.realtime:
        # SCHED_FIFO needs CAP_SYS_NICE or an rtprio limit. Without it the process works all the same, with more jitter.
        with contextlib.suppress(OSError, AttributeError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(urgency))
    if options.supervised:
        mark_as_supervised()
        threading.Thread(target=_watch_supervisor, args=(stop,), daemon=True).start()
    try:
        code = work(options, stop)
    except SafedpaError as error:
        code = EXIT_NOT_LET_IN if isinstance(error, JoinError) else EXIT_BAD_INPUT
        sys.stderr.write(f"{parser.prog}: {readable(' '.join(str(error).split()), 2000)}\n")
    _leave(code)


class _LogStream(io.TextIOBase):
    """Standard output or error of a process whose log may be on a full disk: what cannot be written is left out.

    A message that cannot be written must not end the process, which would then be restarted and end again.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError, ValueError, AttributeError):  # also closed, or None
            self._stream.flush()

    def isatty(self) -> bool:
        return self._stream.isatty()

    def fileno(self) -> int:
        return self._stream.fileno()


def _watch_supervisor(stop: StopSignal) -> None:
    # The supervisor writes a line as the start signal, and another as a further one. End of file means that it died:
    # the kernel closes its end of the pipe even after SIGKILL.
    while data := os.read(sys.stdin.fileno(), 4096):
        for _ in range(data.count(b"\n")):
            stop.start()
    stop.set("the supervisor is gone")


def _end_at_once(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    with contextlib.suppress(OSError, ValueError):  # standard error may be a pipe to a supervisor that is gone
        traceback.print_exception(kind, error, trace)
    _leave(EXIT_CRASHED)


def _leave(code: int) -> None:
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError, AttributeError):  # closed, a broken pipe, or None
            stream.flush()
    # Not sys.exit, which waits for the threads of the network library: they delay the end or prevent it.
    os._exit(code)
