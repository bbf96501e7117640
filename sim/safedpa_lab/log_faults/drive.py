"""A drive whose true pairing of states and commands is known, as a table and as topics."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from safedpa.arrays import FloatArray

__all__ = ["COMMAND", "NAMES", "PERIOD", "STATE", "Drive", "Message", "Table", "Topics", "drive_of"]

NAMES: Final = ("t", "x", "y", "yaw", "speed", "target_speed", "steer")
PERIOD: Final = 0.05
"""s between two rows."""
STATE, COMMAND = "/odom", "/cmd"
_LATENCY: Final = 0.003
"""s from a stamp to its receipt."""
_LEAD: Final = 0.005
"""s by which a command precedes the state of its row."""
_WHEELBASE: Final = 0.32


@dataclass(frozen=True)
class Drive:
    """``values`` (rows, 7) in the order of ``NAMES``; every row is unlike every other, so that it is recognised."""

    values: FloatArray

    def __len__(self) -> int:
        return len(self.values)

    def column(self, name: str) -> FloatArray:
        """One column, shape (rows,)."""
        return self.values[:, NAMES.index(name)]


def drive_of(seed: int, rows: int = 400) -> Drive:
    """A kinematic car at 20 Hz along a random curve."""
    rng = np.random.default_rng(seed)
    t = PERIOD * np.arange(rows)
    rates, phases = rng.uniform(0.4, 1.1, 4), rng.uniform(0.0, 6.0, 4)
    target = 1.2 + 0.3 * np.sin(rates[0] * t + phases[0]) + 0.1 * np.sin(2.3 * rates[1] * t) + rng.normal(0, 0.01, rows)
    steer = 0.2 * np.sin(rates[2] * t + phases[2]) + 0.05 * np.sin(3.1 * rates[3] * t) + rng.normal(0, 0.004, rows)
    state = np.zeros((rows, 4))
    state[0] = [*rng.uniform(-2.0, 2.0, 2), rng.uniform(-1.0, 1.0), 1.0]
    for row in range(rows - 1):
        yaw, speed = state[row, 2:]
        slope = [speed * np.cos(yaw), speed * np.sin(yaw), speed * np.tan(steer[row]) / _WHEELBASE]
        state[row + 1] = state[row] + PERIOD * np.array([*slope, 3.0 * (target[row] - speed)])
    return Drive(np.column_stack([t, state, target, steer]))


@dataclass
class Table:
    """A log as a table: ``cells`` by name, and the row of the drive in each line; written as CSV or Parquet."""

    cells: dict[str, list[Any]]
    map: str = ""
    """The column map; empty for native names."""
    delimiter: str = ","
    decimal: str = "."
    header: list[str] | None = None
    before: tuple[str, ...] = ()
    """Lines before the header."""
    tail: str = ""
    """Appended to each line of cells."""
    lines: dict[int, str] = field(default_factory=dict)
    """Foreign lines by the row before which they stand."""
    quoted: bool = False
    encoding: str = "utf-8"
    packed: bool = False

    @classmethod
    def of(cls, drive: Drive) -> Table:
        """The intact table."""
        return cls({name: drive.column(name).tolist() for name in NAMES})

    def ordered(self, rows: list[int]) -> None:
        """Takes lines by number; a number may occur twice or never."""
        self.cells = {name: [column[row] for row in rows] for name, column in self.cells.items()}


@dataclass(frozen=True)
class Message:
    """One message: the row of the drive that it holds, its receipt and stamp [s], and which form of type it has."""

    topic: str
    row: int
    receipt: float
    stamp: float
    form: str = ""
    """Of a command: Twist if "plain", else TwistStamped."""


@dataclass
class Topics:
    """A log as topics, in the order of the file; written as MCAP, SQLite or ULog."""

    messages: list[Message]
    field: str = "twist.linear.x"
    """Field of the command with the target speed, in ROS."""
    resubscribed: int | None = None
    """ULog: number of the message from which on the commands have another identifier."""

    @classmethod
    def of(cls, drive: Drive, start: float) -> Topics:
        """The intact log; ``start`` is the time of the first row since 1970, s."""
        found = []
        for row, t in enumerate(drive.column("t").tolist()):
            for topic, at in ((COMMAND, start + t - _LEAD), (STATE, start + t)):
                found.append(Message(topic, row, at + _LATENCY, at))
        return cls(found)
