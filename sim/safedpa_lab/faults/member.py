"""One process of the fleet under test: started, killed, paused, made to hang, started again."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

__all__ = ["Member"]

_STARTING_PRIORITY = 1


@dataclass
class Member:
    """A Python module run as a process of its own, with what it writes in a file."""

    name: str
    module: str
    arguments: tuple[str, ...]
    log: Path
    environment: dict[str, str] = field(default_factory=dict)
    """On top of this process's own."""

    def __post_init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def pid(self) -> int:
        """Of the process that runs now or ran last; 0 before the first start."""
        return 0 if self._process is None else self._process.pid

    @property
    def lives(self) -> bool:
        """Whether it runs, be it paused."""
        return self._process is not None and self._process.poll() is None

    def start(self) -> None:
        """Starts the process; a later call starts it again."""
        command = [sys.executable, "-m", "safedpa_lab.faults.sabotaged", self.module, *self.arguments]
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", **self.environment}
        with self.log.open("ab") as log:
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True, env=environment
            )

        if "--realtime" in self.arguments:  # as the supervisor does
            with contextlib.suppress(OSError):
                os.sched_setscheduler(self._process.pid, os.SCHED_FIFO, os.sched_param(_STARTING_PRIORITY))

    def send(self, number: int) -> None:
        """Sends a signal to the process, if it still runs."""
        if self._process is not None:
            self._process.send_signal(number)

    def kill(self) -> None:
        """With SIGKILL; returns when it is gone."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def restart(self) -> None:
        """Kills it and starts a new one at once, as a supervisor would."""
        self.kill()
        self.start()

    def end(self, patience: float) -> None:
        """Asks it to end, waits up to ``patience`` [s], then kills it and its group."""
        if self._process is None:
            return
        self.send(signal.SIGCONT)
        self.send(signal.SIGTERM)
        try:
            self._process.wait(patience)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()

    def threads(self) -> list[int]:
        """Ids of its threads now."""
        return [int(entry.name) for entry in Path(f"/proc/{self.pid}/task").iterdir()]

    def fate(self) -> str:
        """Whether it runs, or how it ended: a negative number is the signal that ended it."""
        code = None if self._process is None else self._process.poll()
        return "its process lives" if code is None else f"its process ended with {code}: {self.last_text()}"

    def last_text(self) -> str:
        """The last line that it wrote."""
        lines = [line for line in self.log.read_text(errors="replace").splitlines() if line.strip()]
        return lines[-1] if lines else "it said nothing"
