"""A local trace of what the robot did in each period, independent of the network."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType

from safedpa.errors import RecordingError


@dataclass(frozen=True, slots=True)
class TracedPeriod:
    """One period of the robot. Times [s] are from the monotonic clock, which all processes of the machine share."""

    epoch: int
    tick: int
    published: float
    """Time at which the state of this tick was published."""
    applied_at: float
    """Time from which ``applied`` acted."""
    action_epoch: int
    """Epoch of the accepted message; -1 without one."""
    action_tick: int
    """Tick of the accepted message; -1 without one."""
    applied: tuple[float, ...]
    applied_by: str
    """``filter`` or ``watchdog``."""
    values: tuple[float, ...]
    """The published state."""
    collisions: int
    """Number since the robot's start, including this period."""

    @property
    def age(self) -> float:
        """s between the publication of the state and the start of its action."""
        return self.applied_at - self.published


class TraceWriter:
    """Appends one line of JSON per period to a file, unbuffered, so that the trace survives a crash of the process.

    A full disk ends the trace, not the drive. Raises RecordingError when the file cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self.failed = False
        """Whether a write has failed; nothing is written afterwards."""
        try:
            self._file = path.open("ab", buffering=0)
        except OSError as error:
            raise RecordingError(
                f"--trace {path}: cannot be written ({error.strerror}); choose another file"
            ) from error

    def write(self, period: TracedPeriod) -> None:
        """Appends one period, unless an earlier write has failed."""
        if self.failed:
            return
        try:
            self._file.write(json.dumps(asdict(period)).encode() + b"\n")
        except OSError:
            self.failed = True

    def __enter__(self) -> TraceWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()


def read_trace(path: Path) -> Iterator[TracedPeriod]:
    """Yields the periods in a file, oldest first; an incomplete last line of a killed robot is skipped."""
    for line in path.read_bytes().split(b"\n")[:-1]:
        fields = json.loads(line)
        yield TracedPeriod(**{**fields, "applied": tuple(fields["applied"]), "values": tuple(fields["values"])})
