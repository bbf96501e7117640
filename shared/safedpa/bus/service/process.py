"""The cycle collector of a process that serves robots: asleep, unless what is held grows.

How a process of the fleet starts and ends: bus options, one way out, no process left behind.

A process that dies of an error must be seen dying: a thread of the network library would keep it, and its sign of life,
for ever. So every uncaught error, on any thread, ends the process with exit code 70. A process that was started by a
supervisor ends when the supervisor does, however that ended, because its standard input then closes.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from enum import IntEnum
from pathlib import Path
from types import TracebackType
from typing import Final

from safedpa.bus.logging import log_event
from safedpa.bus.messages.service_info import software_version
from safedpa.bus.security.certificates import Certificates, PemCredentials, protect_process_memory
from safedpa.bus.security.connection_reaper import raise_descriptor_limit
from safedpa.bus.transport.bus import Bus
from safedpa.bus.transport.zenoh import Mode, ZenohSettings, ZenohTransport
from safedpa.errors import BusError, JoinError, SafedpaError
from safedpa.limits import readable

__all__ = [
    "GROWTH",
    "RealtimePriority",
    "StopSignal",
    "add_bus_options",
    "add_credentials_option",
    "bus_from_options",
    "freeze_garbage_collector",
    "identity_from_options",
    "log_lifetime",
    "run_process",
    "transport_settings_from_options",
]

GROWTH: Final = 50_000
"""Containers by which what is held has to grow until the collector looks for cycles. A batch of a hundred robots holds
more than Python's 700 at once, and windows of measurements that turn over leave it all they hold to look at each time:
a fifteenth of a fleet's processor time, in stalls of up to 17 ms, for cycles that no one makes. If someone does, they
are found, but containers are counted and not what they hold."""
_OLDER: Final = 1
"""Looks at what is young, then at what is older, between two looks at what is older still. Python's 10 would leave
cycles that were held for a while to the millionth container; a process that does not grow never looks at all."""


def freeze_garbage_collector() -> None:
    """To be called when what lives has been made: it lives for ever, and the collector need not look at it again."""
    gc.collect()
    gc.freeze()
    gc.collect()  # of nothing, so that what is new need not grow to a quarter of what was there
    gc.set_threshold(GROWTH, _OLDER, _OLDER)


EXIT_CRASHED = 70
EXIT_BAD_INPUT = 2
EXIT_NOT_LET_IN = 75
"""No one let it join the bus; anyone who started it goes on trying."""
EXIT_INTERRUPTED = 130
"""A second signal: it ended at once, whatever was not finished."""


class RealtimePriority(IntEnum):
    """Who runs first where there is less processor than work: real-time priorities of 1 to 99.

    The kernel's own threads stand above all of them. A state wakes everybody at once; first come those for whom the
    action waits. The nominal action is computed before the filter prepares, and a latent serves a tick later as well. The robot
    and a router have little to do, and all others wait for it.
    """

    LAST = 9
    ADAPTATION = 10
    FILTER = 11
    POLICY = 12
    ROBOT = 13
    ROUTER = 14


class StopSignal:
    """Says when to end: after SIGTERM or SIGINT, or when the supervisor is gone. ``reason`` tells which."""

    def __init__(self) -> None:
        self._event = threading.Event()
        self._word = threading.Event()
        self.reason = ""
        self.hurried = False
        """Whether a second signal came: anyone who ends in order stops doing so."""
        self._signalled = False

    def __call__(self) -> bool:
        """True once the process shall end."""
        return self._event.is_set()

    def wait(self) -> None:
        """Returns once the process shall end."""
        self._event.wait()

    def await_word(self) -> None:
        """Returns once the supervisor said to begin, or the process shall end."""
        self._word.wait()

    def begin(self) -> None:
        """The supervisor's word: anyone who awaits it goes on."""
        self._word.set()

    def listen_to_signals(self, at_once: Callable[[], None] = lambda: None) -> None:
        """Ends in order on SIGTERM and SIGINT instead of at once; only the main thread may call it.

        At a second signal ``hurried`` is set and ``at_once`` is called.
        """

        def heard(number: int, _frame: object) -> None:
            self.set(signal.Signals(number).name)
            self.hurried, self._signalled = self._signalled, True
            if self.hurried:
                at_once()

        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, heard)

    def set(self, reason: str) -> None:
        """Asks the process to end; the first reason stays."""
        self.reason = self.reason or reason
        self._event.set()
        self._word.set()


def add_bus_options(parser: argparse.ArgumentParser) -> None:
    """The options by which a process joins a fleet."""
    parser.add_argument("--fleet", default="fleet", help="name of the fleet")
    parser.add_argument("--mode", choices=("peer", "client", "router"), help="default: peer, with certificates client")
    parser.add_argument("--listen", action="append", default=[], metavar="ENDPOINT", help="such as tcp/0.0.0.0:7447")
    parser.add_argument("--connect", action="append", default=[], metavar="ENDPOINT", help="such as tls/router:7447")
    parser.add_argument(
        "--certificates", type=Path, metavar="DIR", help="prove by the certificates there who this is; see --role"
    )
    parser.add_argument("--role", default="", help="whose certificate to show, such as robot.r1 or safety_filter")
    add_credentials_option(parser)


def add_credentials_option(parser: argparse.ArgumentParser) -> None:
    """The option by which a supervisor hands a process its certificate and key."""
    parser.add_argument("--card", type=int, metavar="DESCRIPTOR", help="read the certificate and key of --role there")


def bus_from_options(options: argparse.Namespace) -> Bus:
    """The bus that the options describe. Raises BusError when it cannot be opened."""
    return Bus(ZenohTransport(transport_settings_from_options(options)), options.fleet)


def identity_from_options(options: argparse.Namespace) -> PemCredentials | Certificates | None:
    """Who the options say that this process is; None: no one, in plain text.

    A card is read once and not kept here, since options are told and handed on; from before that on no other process
    of this user looks into this one. Raises BusError.
    """
    if options.card is not None:
        protect_process_memory()
        descriptor, options.card = options.card, None
        return PemCredentials.from_descriptor(descriptor, options.role)
    if options.certificates is None and options.role:
        raise BusError(f"--role {options.role}: got no --certificates, wanted the folder of that role's certificate")
    return None if options.certificates is None else Certificates(options.certificates, options.role)


@contextlib.contextmanager
def log_lifetime(service: str, stop: StopSignal) -> Iterator[None]:
    """Writes to the log that the service is on the bus, and why it ends where it does so in order."""
    log_event("process.started", f"{service} is on the bus", service=service, version=software_version())
    yield
    why = stop.reason or "its work is done"
    log_event("process.ended", f"{service} ends in order: {why}", service=service)


def transport_settings_from_options(options: argparse.Namespace) -> ZenohSettings:
    """How the options say that this process joins the network.

    Raises BusError when the certificates are not there, or do not fit the rest.
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

    ``urgency`` counts where it is started with ``--realtime``.
    """
    sys.excepthook = _end_at_once
    threading.excepthook = lambda arguments: _end_at_once(
        arguments.exc_type, arguments.exc_value or arguments.exc_type(), arguments.exc_traceback
    )
    parser.add_argument("--realtime", action="store_true", help="ask for real-time scheduling, where it is permitted")
    parser.add_argument("--log", choices=("text", "json"), help="default: text on a terminal, json in a pipe")
    parser.add_argument("--supervised", action="store_true", help="end when standard input closes")
    options = parser.parse_args()
    if options.log:
        os.environ["SAFEDPA_LOG"] = options.log  # for what this process starts, too
    raise_descriptor_limit()
    stop = StopSignal()
    stop.listen_to_signals(lambda: _leave(EXIT_INTERRUPTED))
    if options.realtime:
        _ask_for_real_time(urgency)
    if options.supervised:
        threading.Thread(target=_watch_supervisor, args=(stop,), daemon=True).start()
    try:
        code = work(options, stop)
    except SafedpaError as error:
        code = EXIT_NOT_LET_IN if isinstance(error, JoinError) else EXIT_BAD_INPUT
        sys.stderr.write(f"{parser.prog}: {readable(' '.join(str(error).split()), 2000)}\n")
    _leave(code)


def _ask_for_real_time(urgency: RealtimePriority) -> None:
    """Before all ordinary processes and those of less urgency; an ordinary one where that is not permitted."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(urgency))


def _watch_supervisor(stop: StopSignal) -> None:
    while os.read(sys.stdin.fileno(), 4096):
        stop.begin()
    stop.set("the supervisor is gone")


def _end_at_once(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    with contextlib.suppress(OSError, ValueError):  # the supervisor may be gone, and our standard error with it
        traceback.print_exception(kind, error, trace)
    _leave(EXIT_CRASHED)


def _leave(code: int) -> None:
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError, AttributeError):  # closed, broken, or never there
            stream.flush()
    os._exit(code)  # threads of the network library would delay or prevent an ordinary end
