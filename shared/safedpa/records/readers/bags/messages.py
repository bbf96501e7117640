"""Bags: logs of encoded ROS messages, of which only the requested fields are decoded."""

from __future__ import annotations

import math
from abc import abstractmethod
from array import array
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
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

_UNIT_TOLERANCE = 1e-6
"""Deviation of |q|² from 1 that is rounding; a quaternion beyond it is normalised."""
_MAX_FRAMES = 16
"""Frame names that are kept for one topic."""
_STAMP, _FRAMES = "header.stamp", ("header.frame_id", "child_frame_id")


@dataclass(frozen=True)
class DeclaredTopic:
    """Declaration of a topic in a bag."""

    type: str
    """``package/msg/Type``."""
    encoding: str
    """cdr or ros1; messages of any other encoding cannot be read."""
    definition: str = ""
    form: str = ""
    """ros1msg, ros2msg or ros2idl; empty without a definition."""
    topic: str = ""
    """For a further type of a topic, which is listed as ``/topic (package/msg/Type)``: the topic."""


class AbstractBag(AbstractLog):
    """A bag; its subclasses implement how messages are found in a format."""

    def __init__(self, path: Path, kind: str) -> None:
        super().__init__(path, kind)
        self.declared: dict[str, DeclaredTopic] = {}
        """Filled while messages are read."""

    @abstractmethod
    def messages(self, topics: Collection[str] | None) -> Iterator[tuple[str, int, bytes]]:
        """Yields (topic, receipt time in ns, encoded message) of all or the given topics, in the order of the file."""

    def declare(self, name: str, declared: DeclaredTopic) -> str:
        """Declares a topic or a further type of it; returns the name under which its messages are yielded."""
        before = self.declared.get(name)
        if before is not None and before.type != declared.type:
            declared = replace(declared, topic=name)
            name = f"{name} ({declared.type})"
        self.declared[name] = declared
        return name

    def is_chosen(self, name: str, topics: Collection[str] | None) -> bool:
        """Whether a topic, or the topic of which it is a further type, is among ``topics``."""
        return topics is None or name in topics or self.declared[name].topic in topics

    def topics(self) -> Mapping[str, LoggedTopic]:
        """Every topic by name. The first call reads the whole bag."""
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
        damage = [item.message for item in self.findings[found:]]
        del self.findings[found:]  # they are reported again when the series are read
        if not counts and damage:
            raise RunError(f"{self.path}: {'; '.join(damage)}; no message is left: copy it again, or name another file")
        if not counts:
            raise RunError(f"{self.path}: the bag contains no message; record again, or name another file")
        listed = self._topics_to_list()
        return {name: self._topic(name, counts.get(name, [0, 0, 0]), name in listed) for name in sorted(self.declared)}

    def _topics_to_list(self) -> set[str]:
        """Topics whose fields are listed: those with the shortest definitions, up to the limit for all together."""
        letters, lines = limit("definitions_letters"), limit("definitions_lines")
        seen, found = set[tuple[str, str]](), set[str]()
        for name, declared in sorted(self.declared.items(), key=lambda item: (len(item[1].definition), item[0])):
            if (declared.type, declared.definition) not in seen:
                seen.add((declared.type, declared.definition))
                letters -= len(declared.definition)
                if letters >= 0:  # beyond the limit even counting the lines takes too long
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
        """Reads fields of topics in one pass; raises RunError and InputError like ``AbstractLog.series``."""
        collected: dict[str, _TopicCollector] = {}
        most = limit("bag_messages")
        for count, (topic, at, data) in enumerate(self.messages(tuple(wanted)), 1):
            collector = collected.get(topic)
            if collector is None:
                collector = collected[topic] = self._collector(topic, wanted)
            collector.add(at, data, count)
            if count > most:
                raise too_much("bag_messages", count, str(self.path))
        for topic in wanted:
            if not any(topic in (name, self.declared[name].topic) for name in collected):
                self.topic(topic)  # raises an error that lists the topics
        topics = dict.fromkeys(self.declared[name].topic or name for name in collected)
        return {topic: self._series(topic, collected) for topic in topics}

    def _series(self, topic: str, collected: Mapping[str, _TopicCollector]) -> Series:
        """The series of a topic, with the messages of all its types, which are joined in the order of the file."""
        names = [name for name in collected if topic in (name, self.declared[name].topic)]
        found = [name for name in names if not collected[name].problem]
        if not found:
            raise RunError(f"{self.path}: topic '{topic}': {collected[names[0]].problem}")
        for name in found:
            collected[name].drop_overwritten()
            self._report_refused(name, collected[name])
        for name in names:
            if name != found[0]:
                self.findings.append(self._two_types(topic, found[0], name, collected[name]))
        parts = [collected[name].series() for name in found]
        return parts[0] if len(parts) == 1 else _joined_series(parts)

    def _two_types(self, topic: str, first: str, name: str, collector: _TopicCollector) -> Finding:
        count, kinds = len(collector.receipt), [self.declared[one].type for one in (name, first)]
        sentence = f"{topic}: {count} messages are a {kinds[0]}, the others a {kinds[1]}; "
        sentence += f"ignored: {collector.problem}" if collector.problem else "read as such"
        return Finding("two_types", sentence, count, collector.receipt[0] / 1e9)

    def _collector(self, name: str, wanted: Mapping[str, tuple[str, ...]]) -> _TopicCollector:
        """The collector of a topic, or of one of its types; one that cannot be read collects times alone."""
        declared = self.declared[name]
        topic = declared.topic or name
        first = self.declared[topic].type
        try:
            return _TopicCollector(self._definitions(declared), declared, wanted[topic], first)
        except InputError as error:
            return _TopicCollector(None, declared, wanted[topic], first, str(error))

    def _report_refused(self, topic: str, collector: _TopicCollector) -> None:
        if not collector.receipt:
            raise RunError(
                f"{self.path}: topic '{topic}': none of {collector.refused} messages is a {self.declared[topic].type} "
                "as defined; record it again with the definition that its publisher uses"
            )
        overwritten, begin = collector.overwritten
        if overwritten:
            sentence = f"{topic}: {overwritten} messages are overwritten (of another byte order) and were ignored"
            self.findings.append(Finding("damaged", sentence, overwritten, begin / 1e9))
        if collector.refused:
            sentence = f"{topic}: {collector.refused} messages could not be decoded and were ignored"
            at = None if collector.refused_at is None else collector.refused_at / 1e9
            self.findings.append(Finding("unreadable_message", sentence, collector.refused, at))


def _column_type(kind: str) -> str:
    return "angle" if kind == QUATERNION else "time" if kind.startswith("builtin_interfaces/") else kind


class _TopicCollector:
    """Collects the requested numbers of one topic, message by message.

    With a ``problem`` it collects times alone. ``first`` is the first type of the topic: a Stamped variant of it has
    the same fields one level deeper.
    """

    def __init__(
        self,
        definitions: Definitions | None,
        declared: DeclaredTopic,
        paths: tuple[str, ...],
        first: str,
        problem: str = "",
    ) -> None:
        self.problem = problem
        self.receipt, self._position = array("q"), array("q")
        self._stamps = array("q")
        self._paths = paths
        self._columns = [array("d") for _ in paths]
        self.refused = 0
        self.refused_at: int | None = None
        """Time of receipt of the first message that could not be decoded [ns]."""
        self.overwritten = 0, 0
        """How many messages were overwritten, and when the first of them was received [ns]."""
        self._order, self._has_order = bytearray(), declared.encoding != "ros1"
        """Byte order of each message; zeros in the place of a message are of the other one."""
        if definitions is None:
            self._decode: Decoder | None = None
            return
        available = numeric_fields(definitions, declared.type)
        fields = {item.name: item.type for item in definitions.of(declared.type)}
        self._stamped = _STAMP in available
        extra = [_STAMP] if self._stamped else []
        if fields.get("header") == "std_msgs/msg/Header":
            extra.append(_FRAMES[0])
        if fields.get("child_frame_id") == "string":
            extra.append(_FRAMES[1])
        own = [_path_in_variant(path, available, declared.type, first) for path in paths]
        self._decode = Decoder(definitions, declared.type, (*extra, *own), ros1=declared.encoding == "ros1")
        self._frames: dict[str, set[str]] = {path: set() for path in extra if path in _FRAMES}
        self._named = [(place, self._frames[path]) for place, path in enumerate(extra) if path in _FRAMES]
        self._added = [
            (len(extra) + place, column.append, _CONVERSIONS[self._decode.kinds[len(extra) + place]])
            for place, column in enumerate(self._columns)
        ]

    def add(self, at: int, data: bytes, position: int) -> None:
        """Decodes and adds one message; ``position`` is its number in the file."""
        if self._decode is None:
            self.receipt.append(at)
            return
        try:
            values = self._decode(data)
        except DecodingError:
            self._refuse(1, at)
            return
        self.receipt.append(at)
        self._position.append(position)
        self._order.append(data[1] if self._has_order else 0)
        for place, names in self._named:
            if len(names) < _MAX_FRAMES:
                names.add(values[place])
        if self._stamped:
            self._stamps.append(values[0])
        for place, append, convert in self._added:
            value = values[place]
            append(math.nan if value is None else convert(value))

    def _refuse(self, count: int, at: int) -> None:
        self.refused += count
        self.refused_at = at if self.refused_at is None else min(at, self.refused_at)

    def drop_overwritten(self) -> None:
        """Removes messages whose byte order is not that of most, as that of zeros written over a message."""
        order = np.frombuffer(bytes(self._order), np.uint8)
        other = order != (2 * int(order.sum()) > len(order))
        if not other.any() or self._decode is None:
            return
        good = np.flatnonzero(~other)
        self.overwritten = int(other.sum()), self.receipt[int(np.flatnonzero(other)[0])]
        stamps = [self._stamps] if self._stamped else []
        every: list[array[Any]] = [self.receipt, self._position, *stamps, *self._columns]
        for numbers in every:
            numbers[:] = array(numbers.typecode, np.array(numbers)[good].tobytes())

    def series(self) -> Series:
        """Returns the collected series."""
        receipt, position = (np.array(numbers, dtype=np.int64) for numbers in (self.receipt, self._position))
        stamps = np.array(self._stamps, dtype=np.int64) if self._stamps else None
        if stamps is not None and not stamps.any():
            stamps = None
        values = {path: np.array(column) for path, column in zip(self._paths, self._columns, strict=True)}
        frames = {name: frozenset(found) for name, found in self._frames.items()}
        return Series(receipt, stamps, values, frames, position)


def _path_in_variant(path: str, available: Mapping[str, str], kind: str, first: str) -> str:
    """The field that ``path`` names in the Stamped or plain variant of a type; ``first`` is the topic's first type.

    A map for Twist also fits TwistStamped, and the other way round.
    """
    if path in available or kind.removesuffix("Stamped") != first.removesuffix("Stamped"):
        return path
    if kind == first and not kind.endswith("Stamped") and not path.startswith(f"{_field_of_variant(kind)}."):
        return path
    same = [one for one in available if one.endswith(f".{path}") or path.endswith(f".{one}")]
    return same[0] if len(same) == 1 else path


def _field_of_variant(kind: str) -> str:
    """The field of ``TwistStamped`` that holds a ``Twist``: twist."""
    return kind.rpartition("/")[2].lower()


def _joined_series(parts: Sequence[Series]) -> Series:
    """The messages of several types of one topic in the order of the file."""
    places = np.concatenate([part.place for part in parts])
    order = np.argsort(places, kind="stable")
    stamped = [part for part in parts if part.stamp is not None]
    stamps = [np.zeros(len(part.receipt), np.int64) if part.stamp is None else part.stamp for part in parts]
    frames: dict[str, frozenset[str]] = {}
    for part in parts:
        frames |= {key: frames.get(key, frozenset()) | names for key, names in part.frames.items()}
    return Series(
        np.concatenate([part.receipt for part in parts])[order],
        np.concatenate(stamps)[order] if stamped else None,
        {path: np.concatenate([part.values[path] for part in parts])[order] for path in parts[0].values},
        frames,
        places[order],
    )


def _seconds(value: int) -> float:
    return value / 1e9  # one rounding: gives the float nearest to the exact time


def yaw_of(x: float, y: float, z: float, w: float) -> float:
    """Yaw angle [rad] of a quaternion: atan2(2 (w z + x y), 1 - 2 (y^2 + z^2)), axes as in ROS REP 103.

    The quaternion is normalised; the result is NaN for zero length.
    """
    size = x * x + y * y + z * z + w * w
    if not size > 0.0:
        return math.nan
    one = 1.0 if abs(size - 1.0) < _UNIT_TOLERANCE else size
    return math.atan2(2.0 * (w * z + x * y), one - 2.0 * (y * y + z * z))


def _yaw(value: tuple[float, float, float, float]) -> float:
    return yaw_of(*value)


_CONVERSIONS: dict[str, Callable[[Any], float]] = {"time": _seconds, "quaternion": _yaw, "number": float}
