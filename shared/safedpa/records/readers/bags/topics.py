"""Logs of topics in any format: their topics, and series of selected fields."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import RunError, did_you_mean
from safedpa.limits import readable
from safedpa.records.run import Finding

__all__ = [
    "CLOCKS",
    "HEADER",
    "RECEIPT",
    "STAMP",
    "AbstractLog",
    "LoggedTopic",
    "Series",
    "split_source",
]

RECEIPT, HEADER, STAMP = "@receipt", "@header", "@stamp"
"""Clocks of a topic, used in place of a field path: time of receipt by the recorder; stamp in the message header; the
stamp if there is one, else the receipt."""
CLOCKS = (RECEIPT, HEADER, STAMP)


@dataclass(frozen=True)
class LoggedTopic:
    """One topic of a log."""

    name: str
    type: str
    count: int
    first: int
    """Receipt time of the first message, ns; 0 for a topic without messages."""
    last: int
    fields: Mapping[str, str] = field(default_factory=dict)
    """Type by path of every field that can become a column; empty if the message type is unknown."""
    problem: str = ""
    """Why the topic cannot be read; empty if it can."""

    @property
    def rate(self) -> float:
        """Messages per second; 0 for fewer than two messages."""
        return (
            (self.count - 1) / ((self.last - self.first) * 1e-9) if self.count > 1 and self.last > self.first else 0.0
        )


@dataclass(frozen=True)
class Series:
    """Selected fields of one topic, in the order of the file."""

    receipt: NDArray[np.int64]
    """Receipt times, shape (messages,), ns."""
    stamp: NDArray[np.int64] | None
    """Time stamps in the messages, shape (messages,), ns; 0 if a message has none; None if none has one."""
    values: Mapping[str, NDArray[np.float64]]
    """Values by path, shape (messages,); NaN if an array in the message was too short."""
    frames: Mapping[str, frozenset[str]] = field(default_factory=dict)
    """Frame names by field: ``header.frame_id`` and ``child_frame_id``, if the message has them."""
    position: NDArray[np.int64] | None = None
    """Numbers of the messages among all in the file, ascending; None if the format has no such order."""

    @cached_property
    def place(self) -> NDArray[np.int64]:
        """The ``position`` of each message; without one, the latest receipt time so far."""
        return np.maximum.accumulate(self.receipt) if self.position is None else self.position


class AbstractLog(ABC):
    """A log of topics, each with its own fields and rate."""

    def __init__(self, path: Path, kind: str) -> None:
        self.path, self.kind = path, kind
        self.findings: list[Finding] = []

    @abstractmethod
    def topics(self) -> Mapping[str, LoggedTopic]:
        """Every topic by name; raises RunError if the file cannot be read."""

    @abstractmethod
    def series(self, wanted: Mapping[str, tuple[str, ...]]) -> Mapping[str, Series]:
        """Reads fields of topics; raises RunError for a missing topic and InputError for a missing field."""

    def topic(self, name: str) -> LoggedTopic:
        """Returns one topic; raises RunError that lists the topics of the log if it is missing or empty."""
        known = self.topics()
        shown = readable(name)
        if name not in known:
            hint = readable(did_you_mean(name, known), 600)
            raise RunError(f"{self.path}: topic '{shown}' does not exist; {hint}")
        if not known[name].count:
            raise RunError(f"{self.path}: topic '{shown}' has no message; record it, or leave it out of the map")
        return known[name]


def split_source(source: str) -> tuple[str, str]:
    """Splits ``/odom:pose.pose.position.x`` into (topic, path); the topic is empty if the column names none."""
    topic, _, path = source.rpartition(":")
    return topic, path
