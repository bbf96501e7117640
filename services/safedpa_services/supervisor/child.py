"""One supervised process: started, watched, restarted, ended; its output goes to a file of its own."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from safedpa.bus.security.certificates import PemCredentials

__all__ = ["Child"]

_FIRST_PAUSE_SECONDS = 0.1
_LONGEST_PAUSE_SECONDS = 5.0
_STARTING_PRIORITY = 1
"""Of a process of the loop until it asks for its own: before all that is not of the loop, and behind the loop. So a
busy machine does not keep the robot braking while a service comes back."""
_HEALTHY_SECONDS = 10.0
"""After living for so long a process is started again without a pause."""
_PROGRAM = re.compile(r"^safedpa-[a-z_-]+: ")


@dataclass
class Child:
    """A Python module run as a process of its own.

    It leads a process group, so that an interrupt from the terminal reaches the supervisor alone, which ends everything
    in order. Its standard input is a pipe from the supervisor and closes with it: nothing is left behind even if the
    supervisor is killed.
    """

    name: str
    module: str
    arguments: tuple[str, ...]
    log: Path
    essential: bool = True
    """Whether the loop ends when this one cannot be brought up; one that only looks on is left out then."""
    heartbeat: bool = True
    """Whether it tells its health on the bus."""
    waits: bool = False
    """Whether it makes itself ready at its start and begins its work when told to, by ``begin``."""
    restarts: int = 0
    environment: Mapping[str, str] = field(default_factory=dict)
    """What it is told and other users of the machine must not read, as they can its arguments."""
    card: PemCredentials | None = None
    """Its certificate and key, which no other process shall see: handed to it by a pipe, at each start."""
    further: Mapping[str, PemCredentials] = field(default_factory=dict)
    """By the option that takes it: cards of other roles for which this one process speaks as well."""

    def __post_init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._started = 0.0
        self._died = 0.0
        self._pause = 0.0
        self._asked = False
        self._reported = False

    @property
    def pid(self) -> int:
        """Of the process that runs now or ran last; 0 before the first start."""
        return self._process.pid if self._process else 0

    @property
    def begun(self) -> bool:
        """Whether its work has begun, or at least may have."""
        return self.pid != 0 and (self._reported or not self.waits)

    @property
    def exit_code(self) -> int | None:
        """None while it runs."""
        return self._process.poll() if self._process else None

    def start(self) -> None:
        """Starts the process; a later call starts it again."""
        command = [sys.executable, "-m", self.module, *self.arguments, "--supervised"]
        command += ["--await-word"] if self.waits and not self._reported else []
        cards = {**({} if self.card is None else {"--card": self.card}), **self.further}
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()  # of the one that died
        with self._opened_log() as log, _handed(cards) as descriptors:
            command += [word for option, descriptor in descriptors.items() for word in (option, str(descriptor))]
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
            with contextlib.suppress(OSError, AttributeError):  # not permitted: an ordinary process, then
                os.sched_setscheduler(self._process.pid, os.SCHED_FIFO, os.sched_param(_STARTING_PRIORITY))
        self._started = time.monotonic()
        self._died, self._asked = 0.0, False

    def _opened_log(self) -> BinaryIO:
        """To write to; what takes nothing where the log cannot be had: a loop without logs is better than none."""
        with contextlib.suppress(OSError):  # someone may have removed the folder of the run
            self.log.parent.mkdir(parents=True, exist_ok=True)
            return self.log.open("ab")
        return Path(os.devnull).open("ab")

    def begin(self) -> None:
        """Starts its work: by a word to the process that waits for it, else by starting the process."""
        self._reported = True
        if self._process is None:
            self.start()
        elif self.waits and self._process.stdin is not None:
            with contextlib.suppress(OSError):  # it died meanwhile; what is started in its place does not wait
                os.write(self._process.stdin.fileno(), b"begin\n")

    def restart_if_due(self) -> bool:
        """Starts a process that died, after a pause that grows with quick deaths; True when it did so now."""
        now = time.monotonic()
        if self._died == 0.0:
            self._died = now
            lived = now - self._started
            self._pause = (
                0.0
                if lived > _HEALTHY_SECONDS
                else min(max(2.0 * self._pause, _FIRST_PAUSE_SECONDS), _LONGEST_PAUSE_SECONDS)
            )
        if now - self._died < self._pause:
            return False
        self.restarts += 1
        self.start()
        return True

    def last_text(self) -> str:
        """The last line that it wrote, without its program's name; events and accounts, which are JSON, left out."""
        lines: list[str] = []
        with contextlib.suppress(OSError):
            lines = self.log.read_text(errors="replace").splitlines()
        lines = [line for line in lines if line.strip() and not line.startswith("{")]
        return _PROGRAM.sub("", lines[-1]) if lines else "it said nothing"

    def terminate(self) -> None:
        """Asks it to end, once: a second signal would end it at once."""
        if self.exit_code is None and self._process is not None and not self._asked:
            self._asked = True
            self._process.terminate()

    def kill(self) -> None:
        """Ends it and its group at once, whatever it does."""
        if self.exit_code is None and self._process is not None:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()

    def end(self, patience: float) -> None:
        """Asks it to end, waits up to ``patience`` [s], then kills it and its group."""
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
def _handed(cards: Mapping[str, PemCredentials]) -> Iterator[dict[str, int]]:
    """The descriptors at which a process finds its cards; this process closes its own when the other one has them."""
    with contextlib.ExitStack() as closing:
        descriptors = {}
        for option, card in cards.items():
            descriptors[option] = card.pipe()
            closing.callback(os.close, descriptors[option])
        yield descriptors
