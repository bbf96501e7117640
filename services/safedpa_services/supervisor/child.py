"""One supervised process: start, restart and end; its output goes to a log file of its own."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from safedpa.bus.security.certificates import PemCredentials

_FIRST_PAUSE_SECONDS = 0.1
_LONGEST_PAUSE_SECONDS = 5.0
_STARTING_PRIORITY = 1
"""Real-time priority of a starting process until it sets its own: above all other processes, below the running loop. A
restarted service is then ready soon on a busy machine, while the robot brakes."""
_HEALTHY_SECONDS = 10.0
"""A process that lived this long is restarted without a pause."""
_MOST_QUICK_ENDS = 8
"""A process that ended so often in a row within 10 s of its start is not restarted any more; the pauses add up to
16 s, in which a router or a disk may return."""
_MOST_RESTARTS, _RESTART_WINDOW_SECONDS = 30, 3600.0
"""Nor is one that was restarted so often within this time [s]."""
_LONGEST_CAUSE = 300
"""Characters of the log in a cause."""
_FULL_BYTES = 1 << 16
"""Free disk space below which a log may end in the middle of a line."""
MOST_LOG_BYTES = 4 << 20
"""A log of this size is moved to ``NAME.log.1``, which replaces an older one: at most twice as much for a process."""
_PROGRAM = re.compile(r"^safedpa-[a-z_-]+: ")


@dataclass
class Child:
    """A Python module that runs as a process of its own.

    The process leads a process group: Ctrl-C in the terminal reaches only the supervisor, which ends all processes in
    order. Its standard input is a pipe from the supervisor. The pipe closes with the supervisor, even if that is
    killed, and the process then ends.
    """

    name: str
    module: str
    arguments: tuple[str, ...]
    log: Path
    essential: bool = True
    """Whether the loop fails if this process cannot be started; the loop runs without a process that is not
    essential."""
    heartbeat: bool = True
    """Whether it sends health messages on the bus."""
    waits: bool = False
    """Whether it prepares itself after its start and begins its work only on ``begin``."""
    awaited: bool = False
    """Whether the robots begin to drive only once it has sent a health message, although it is not essential."""
    restarts: int = 0
    cause: str = ""
    """Why it ended last, with the last line of its log; empty: it never did."""
    given_up: bool = False
    """Whether it is not restarted any more, because it ended too often."""
    environment: Mapping[str, str] = field(default_factory=dict)
    """Secrets for the process. Other users of the machine can read its arguments, but not its environment."""
    credentials: PemCredentials | None = None
    """Its certificate and key, passed through a pipe at each start so that no other process can read them."""
    extra_credentials: Mapping[str, PemCredentials] = field(default_factory=dict)
    """By command-line option: credentials of further roles of this process."""

    def __post_init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._started = 0.0
        self._died: float | None = None
        """Time of its death [s], noticed by ``restart_if_due``; None while it runs."""
        self._pause = 0.0
        self._quick_ends = 0
        self._restarted_at: deque[float] = deque(maxlen=_MOST_RESTARTS)
        self._killed_because = ""
        self._is_terminating = False
        self._is_released = False
        """Whether ``begin`` was called."""

    @property
    def pid(self) -> int:
        """Process id of the current or the last process; 0 before the first start."""
        return self._process.pid if self._process else 0

    @property
    def has_begun(self) -> bool:
        """Whether its work has begun or may have begun."""
        return self.pid != 0 and (self._is_released or not self.waits)

    @property
    def exit_code(self) -> int | None:
        """Exit code; None while it runs and before the first start."""
        return self._process.poll() if self._process else None

    def start(self) -> None:
        """Starts the process; a later call starts it again."""
        command = [sys.executable, "-m", self.module, *self.arguments, "--supervised"]
        command += ["--await-word"] if self.waits and not self._is_released else []
        credentials = {**({} if self.credentials is None else {"--card": self.credentials}), **self.extra_credentials}
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()  # the pipe of the process that died
        with self._opened_log() as log, _credential_pipes(credentials) as descriptors:
            command += [part for option, descriptor in descriptors.items() for part in (option, str(descriptor))]
            self._process = subprocess.Popen(
                command,
                pass_fds=tuple(descriptors.values()),
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                start_new_session=True,
                env={
                    **os.environ,
                    **self.environment,
                    "PYTHONSAFEPATH": "1",
                    "SAFEDPA_LOG": "json",
                    "OMP_NUM_THREADS": "1",
                    "OPENBLAS_NUM_THREADS": "1",
                },
            )
        if "--realtime" in self.arguments:
            with contextlib.suppress(OSError, AttributeError):  # without the permission it runs at normal priority
                os.sched_setscheduler(self._process.pid, os.SCHED_FIFO, os.sched_param(_STARTING_PRIORITY))
        self._started = time.monotonic()
        self._died, self._is_terminating, self._killed_because = None, False, ""

    def _opened_log(self) -> BinaryIO:
        """Opens the log for appending; the null device if that fails, because the loop must run even without logs."""
        with contextlib.suppress(OSError):  # the user may have removed the folder of the run
            self.log.parent.mkdir(parents=True, exist_ok=True)
            return self.log.open("ab")
        return Path(os.devnull).open("ab")

    def rotate_log(self) -> None:
        """Moves a log that has become too long; call it often.

        The process goes on writing to the same file, so its content is copied and the file emptied. Lines that are
        written meanwhile are lost. On a full disk the content is lost, because the recording needs the space.
        """
        with contextlib.suppress(OSError):
            if self.log.stat().st_size < MOST_LOG_BYTES:
                return
            with contextlib.suppress(OSError):
                shutil.copyfile(self.log, self.log.with_name(f"{self.log.name}.1"))
            os.truncate(self.log, 0)

    def begin(self) -> None:
        """Begins its work: signals the process if it waits, or starts it."""
        self._is_released = True
        if self._process is None:
            self.start()
        elif self.waits:
            self.signal()

    def signal(self) -> None:
        """Gives a process that has begun a further signal."""
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(OSError):  # it died meanwhile; its successor does not wait
                os.write(self._process.stdin.fileno(), b"begin\n")

    def restart_if_due(self) -> bool:
        """Restarts a process that died; returns whether it was restarted now.

        The pause before a restart doubles, from 0.1 s to 5 s, while the process dies within 10 s of its start. After
        too many restarts it is given up: ``given_up``, with its ``cause``.
        """
        now = time.monotonic()
        if self._died is None:
            self._note_end(now)
        if self.given_up or self._died is None or now - self._died < self._pause:
            return False
        self.restarts += 1
        self._restarted_at.append(now)
        self.start()
        return True

    def _note_end(self, now: float) -> None:
        self._died, lived = now, now - self._started
        longer = min(max(2.0 * self._pause, _FIRST_PAUSE_SECONDS), _LONGEST_PAUSE_SECONDS)
        self._pause = 0.0 if lived > _HEALTHY_SECONDS else longer
        self._quick_ends = 0 if lived > _HEALTHY_SECONDS else self._quick_ends + 1
        self.cause = self._cause()
        often = len(self._restarted_at) == _MOST_RESTARTS and now - self._restarted_at[0] < _RESTART_WINDOW_SECONDS
        self.given_up = self._quick_ends > _MOST_QUICK_ENDS or often

    def _cause(self) -> str:
        """Returns why it ended: it hung, a signal, or the last line of its log."""
        if self._killed_because:
            return self._killed_because
        code = self.exit_code or 0
        if code < 0:
            name = signal.Signals(-code).name if -code in set(signal.Signals) else "unknown"
            return f"killed by signal {-code} ({name})"
        return f"ended with code {code}: {self.last_text()[:_LONGEST_CAUSE]}"

    def last_text(self) -> str:
        """Returns the last line of its log without the program's name; JSON lines, such as events, are skipped."""
        lines: list[str] = []
        with contextlib.suppress(OSError):
            lines = self.log.read_text(errors="replace").splitlines()
        lines = [line for line in lines if line.strip() and not line.startswith("{")]
        if lines:
            return _PROGRAM.sub("", lines[-1])
        with contextlib.suppress(OSError):
            if shutil.disk_usage(self.log.parent).free < _FULL_BYTES:
                return f"it could write no message: no space is left on the disk of {self.log.parent}"
        return "it wrote no message"

    def terminate(self) -> None:
        """Sends SIGTERM once; a second signal would skip its orderly shutdown."""
        if self.exit_code is None and self._process is not None and not self._is_terminating:
            self._is_terminating = True
            self._process.terminate()

    def kill(self, because: str = "") -> None:
        """Kills it and its process group; ``because`` becomes its ``cause``."""
        if self.exit_code is None and self._process is not None:
            self._killed_because = because
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()

    def end(self, patience: float) -> None:
        """Sends SIGTERM, waits up to ``patience`` [s], then kills it and its process group."""
        if self._process is None:
            return
        self.terminate()
        try:
            self._process.wait(patience)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        if self._process.stdin is not None:
            self._process.stdin.close()


@contextlib.contextmanager
def _credential_pipes(credentials: Mapping[str, PemCredentials]) -> Iterator[dict[str, int]]:
    """Yields, by option, the descriptors of pipes that hold the credentials; closes this process's ends afterwards."""
    with contextlib.ExitStack() as closing:
        descriptors = {}
        for option, held in credentials.items():
            descriptors[option] = held.pipe()
            closing.callback(os.close, descriptors[option])
        yield descriptors
