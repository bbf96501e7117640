"""What the robot itself did in every period, on its own disk: evidence that no network can lose."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType

from safedpa.errors import RecordingError

__all__ = ["TraceWriter", "TracedPeriod", "read_trace"]


@dataclass(frozen=True, slots=True)
class TracedPeriod:
    """One period, as it was lived. Times are of the machine's monotonic clock, which all its processes share, in s."""

    epoch: int
    tick: int
    published: float
    """When the state of this tick was sent."""
    applied_at: float
    """When the period began to be driven under ``applied``."""
    action_epoch: int
    """Of the accepted message; -1 without any."""
    action_tick: int
    """Of the accepted message; -1 without any."""
    applied: tuple[float, ...]
    applied_by: str
    """``filter`` or ``watchdog``."""
    values: tuple[float, ...]
    """The state that was sent."""
    collisions: int
    """Since the robot's start, this period included."""

    @property
    def age(self) -> float:
        """s between the state and the moment in which what was computed from it began to act."""
        return self.applied_at - self.published


class TraceWriter:
    """Appends one line of JSON a period to a file; each line has left the process when ``write`` returns.

    A full disk ends the trace, not the drive. Raises RecordingError when the file cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self.failed = False
        """Whether the disk refused a line; nothing is written afterwards."""
        try:
            self._file = path.open("ab", buffering=0)
        except OSError as error:
            raise RecordingError(
                f"--trace {path}: cannot be written ({error.strerror}); choose another file"
            ) from error

    def write(self, period: TracedPeriod) -> None:
        """Appends one period, as long as the disk takes it."""
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
    """The periods in a file, oldest first; a last line that a killed robot did not finish is left out."""
    for line in path.read_bytes().split(b"\n")[:-1]:
        fields = json.loads(line)
        yield TracedPeriod(**{**fields, "applied": tuple(fields["applied"]), "values": tuple(fields["values"])})
