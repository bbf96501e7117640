"""Bags: logs of encoded messages, decoded as far as they are asked for."""

from __future__ import annotations

import math
from abc import abstractmethod
from array import array
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from safedpa.errors import InputError, RunError
from safedpa.limits import limit, too_much
from safedpa.records.readers.bags.topics import AbstractLog, LoggedTopic, Series
from safedpa.records.run import Finding
from safedpa.ros.decoding import Decoder, DecodingError
from safedpa.ros.definitions import QUATERNION, Definitions, numeric_fields, parsed, summarize_definition

__all__ = ["AbstractBag", "DeclaredTopic", "yaw_of"]

_NEARLY = 1e-6
"""Off length 1 by this much, a quaternion is one that was rounded."""
_MOST_FRAMES = 16
"""Names of frames of one topic that are kept."""
_STAMP, _FRAMES = "header.stamp", ("header.frame_id", "child_frame_id")


@dataclass(frozen=True)
class DeclaredTopic:
    """What a bag says of a topic."""

    type: str
    """``package/msg/Type``."""
    encoding: str
    """cdr, ros1, or another one, which cannot be read."""
    definition: str = ""
    form: str = ""
    """ros1msg, ros2msg or ros2idl; empty without a definition."""


class AbstractBag(AbstractLog):
    """A bag; what differs between formats is how messages are found in it."""

    def __init__(self, path: Path, kind: str) -> None:
        super().__init__(path, kind)
        self.declared: dict[str, DeclaredTopic] = {}
        """Filled while messages are read."""

    @abstractmethod
    def messages(self, topics: Collection[str] | None) -> Iterator[tuple[str, int, bytes]]:
        """(topic, receipt in ns, encoded message), of all topics or of these, in the file's order."""

    def topics(self) -> Mapping[str, LoggedTopic]:
        """Every topic, by name. The whole bag is read for it, once."""
        return self._topics

    @cached_property
    def _topics(self) -> Mapping[str, LoggedTopic]:
        counts: dict[str, list[int]] = {}
        found = len(self.findings)
        for topic, at, _ in self.messages(None):
            entry = counts.get(topic)
            if entry is None:
                counts[topic] = [1, at, at]
            else:
                entry[0] += 1
                if at < entry[1]:
                    entry[1] = at
                elif at > entry[2]:
                    entry[2] = at
        del self.findings[found:]  # said again when the series are read
        if not counts:
            raise RunError(f"{self.path}: the bag holds no message; record again, or name another file")
        listed = self._listed()
        return {name: self._topic(name, counts.get(name, [0, 0, 0]), name in listed) for name in sorted(self.declared)}

    def _listed(self) -> set[str]:
        """Topics whose fields are listed: those of the shortest definitions, up to their limit all together."""
        letters, lines = limit("definitions_letters"), limit("definitions_lines")
        seen, found = set[tuple[str, str]](), set[str]()
        for name, declared in sorted(self.declared.items(), key=lambda item: (len(item[1].definition), item[0])):
            if (declared.type, declared.definition) not in seen:
                seen.add((declared.type, declared.definition))
                letters -= len(declared.definition)
                if letters >= 0:  # else not even counted
                    lines -= summarize_definition(declared.definition, declared.form)[1]
            if letters < 0 or lines < 0:
                break
            found.add(name)
        return found

    def _topic(self, name: str, counts: list[int], listed: bool) -> LoggedTopic:
        declared = self.declared[name]
        fields: Mapping[str, str] = {}
        problem = ""
        try:
            if not listed:
                raise too_much("definitions_letters", "more")
            definitions = self._definitions(declared)
            fields = {path: _column_type(kind) for path, kind in numeric_fields(definitions, declared.type).items()}
        except InputError as error:
            problem = str(error)
        return LoggedTopic(name, declared.type, counts[0], counts[1], counts[2], fields, problem)

    def _definitions(self, declared: DeclaredTopic) -> Definitions:
        if declared.encoding not in ("cdr", "ros1"):
            raise InputError(
                f"messages are encoded as '{declared.encoding or 'nothing'}'; wanted cdr or ros1: record it in ROS"
            )
        own = parsed(declared.type, declared.definition, declared.form) if declared.definition else {}
        return Definitions(declared.encoding == "ros1", own)

    def series(self, wanted: Mapping[str, tuple[str, ...]]) -> Mapping[str, Series]:
        """Fields of topics, in one pass. Raises RunError and InputError as AbstractLog says."""
        collected: dict[str, _Collected] = {}
        most = limit("bag_messages")
        for retained, (topic, at, data) in enumerate(self.messages(tuple(wanted)), 1):
            into = collected.get(topic)
            if into is None:
                into = collected[topic] = self._collector(topic, wanted[topic])
            into.add(at, data)
            if retained > most:
                raise too_much("bag_messages", retained, str(self.path))
        for topic in wanted:
            if topic not in collected:
                self.topic(topic)  # raises, naming what is there
        for topic, into in collected.items():
            self._report_refused(topic, into)
        return {topic: into.series() for topic, into in collected.items()}

    def _collector(self, topic: str, paths: tuple[str, ...]) -> _Collected:
        declared = self.declared[topic]
        try:
            return _Collected(self._definitions(declared), declared, paths)
        except InputError as error:
            raise RunError(f"{self.path}: topic '{topic}': {error}") from error

    def _report_refused(self, topic: str, into: _Collected) -> None:
        if not into.receipt:
            raise RunError(
                f"{self.path}: topic '{topic}': none of its {into.refused} messages is a {self.declared[topic].type} "
                "as its definition says; record it again with the definition that its publisher has"
            )
        if into.refused:
            sentence = f"{topic}: {into.refused} messages could not be decoded; left out"
            self.findings.append(Finding("unreadable_message", sentence, into.refused))


def _column_type(kind: str) -> str:
    return "angle" if kind == QUATERNION else "time" if kind.startswith("builtin_interfaces/") else kind


class _Collected:
    """Numbers of one topic, as they come."""

    def __init__(self, definitions: Definitions, declared: DeclaredTopic, paths: tuple[str, ...]) -> None:
        there = numeric_fields(definitions, declared.type)
        first = {item.name: item.type for item in definitions.of(declared.type)}
        self._stamped = _STAMP in there
        alongside = [_STAMP] if self._stamped else []
        if first.get("header") == "std_msgs/msg/Header":
            alongside.append(_FRAMES[0])
        if first.get("child_frame_id") == "string":
            alongside.append(_FRAMES[1])
        self._paths, self._alongside = paths, tuple(alongside)
        self._decode = Decoder(definitions, declared.type, (*alongside, *paths), ros1=declared.encoding == "ros1")
        self._frames: dict[str, set[str]] = {path: set() for path in alongside if path in _FRAMES}
        self._names = [self._frames.get(path) for path in alongside]
        self.receipt = array("q")
        self._stamps = array("q")
        self._columns = [array("d") for _ in paths]
        self._conversions = [_CONVERSIONS[kind] for kind in self._decode.kinds[len(alongside) :]]
        self.refused = 0

    def add(self, at: int, data: bytes) -> None:
        """One message more."""
        try:
            values = self._decode(data)
        except DecodingError:
            self.refused += 1
            return
        self.receipt.append(at)
        start = len(self._alongside)
        for names, value in zip(self._names, values, strict=False):
            if names is not None and len(names) < _MOST_FRAMES:
                names.add(value)
        if self._stamped:
            self._stamps.append(values[0])
        for column, convert, value in zip(self._columns, self._conversions, values[start:], strict=True):
            column.append(math.nan if value is None else convert(value))

    def series(self) -> Series:
        """What came, in the order of the recorder's clock."""
        receipt = np.frombuffer(self.receipt, dtype=np.int64) if self.receipt else np.empty(0, dtype=np.int64)
        order = np.argsort(receipt, kind="stable")
        stamps = np.frombuffer(self._stamps, dtype=np.int64)[order] if self._stamps else None
        if stamps is not None and not stamps.any():
            stamps = None
        values = {path: np.array(column)[order] for path, column in zip(self._paths, self._columns, strict=True)}
        return Series(receipt[order], stamps, values, {name: frozenset(found) for name, found in self._frames.items()})


def _seconds(value: int) -> float:
    return value / 1e9  # rounded once, so equal to the nearest number of a float


def yaw_of(x: float, y: float, z: float, w: float) -> float:
    """rad; rotation about the vertical axis: atan2(2 (w z + x y), 1 - 2 (y^2 + z^2)), as of ROS REP 103.

    A quaternion of another length than 1 counts by its direction; NaN for one of zeros, which is none.
    """
    size = x * x + y * y + z * z + w * w
    if not size > 0.0:
        return math.nan
    one = 1.0 if abs(size - 1.0) < _NEARLY else size
    return math.atan2(2.0 * (w * z + x * y), one - 2.0 * (y * y + z * z))


def _yaw(value: tuple[float, float, float, float]) -> float:
    return yaw_of(*value)


_CONVERSIONS: dict[str, Callable[[Any], float]] = {"time": _seconds, "quaternion": _yaw, "number": float}
