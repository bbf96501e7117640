"""PX4 flight logs (``.ulg``): topics of numbers, with one clock, that of the flight controller."""

from __future__ import annotations

import contextlib
import io
import re
import struct
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from safedpa.errors import InputError, RunError, did_you_mean
from safedpa.extras import need
from safedpa.limits import limit, readable, too_much
from safedpa.records.readers.bags.messages import yaw_of
from safedpa.records.readers.bags.topics import AbstractLog, LoggedTopic, Series
from safedpa.records.run import Finding

if TYPE_CHECKING:
    from pyulog.core import ULog

__all__ = ["UlogLog"]

MAGIC = b"ULog\x01\x12\x35"
_HEADER_BYTES = 16
_MOST_NUMBERS = 4096
"""Numbers of one message; the largest of PX4 has 400."""
_MOST_TOGETHER = 100_000
"""Numbers of all topics that are subscribed; a vehicle of PX4 has 10,000."""
_MOST_UNKNOWN = 10_000
"""Messages of no known kind; the library looks at each for 2 us, and a damaged log has some dozens."""
_CURE = "is a damaged PX4 flight log; fetch it from the vehicle's card again"
_DESCRIBED, _LOGGED = b"BIMFPQ", b"ALC"
"""Kinds of messages in a log's first part, and those with which the second one begins."""
_KNOWN = b"BIMFPQALCDRSO"
_FIELD = re.compile(r"([A-Za-z0-9_]+)(?:\[(\d{1,9})\])? [A-Za-z0-9_]+")


class UlogLog(AbstractLog):
    """A flight log of PX4. The second of several topics of one name is ``name#1``."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "PX4 flight log")
        need("ros", what="reading PX4 flight logs")

    @cached_property
    def _log(self) -> ULog:
        from pyulog.core import ULog

        size = self.path.stat().st_size
        if size > limit("table_bytes"):
            raise too_much("table_bytes", f"{size} bytes", str(self.path))
        _measure(self.path)
        damage: tuple[type[Exception], ...] = (
            ValueError, struct.error, KeyError, IndexError, TypeError, AttributeError, OverflowError, RecursionError,
            EOFError, ZeroDivisionError,
        )  # fmt: skip
        try:
            with contextlib.redirect_stdout(io.StringIO()), self.path.open("rb") as file:  # it leaves its own one open
                log = ULog(file)
        except damage as error:
            raise self._damaged() from error
        except Exception as error:  # the library's own kind, which is a plain Exception
            if type(error).__module__.startswith("pyulog"):
                raise self._damaged() from error
            raise
        if log.file_corruption:
            self.findings.append(Finding("damaged", "the flight log is damaged in places; those were left out"))
        lost = sum(item.duration for item in log.dropouts)
        if lost:
            sentence = (
                f"the logger fell behind {len(log.dropouts)} times, {lost / 1000:.2f} s in all; nothing is there of it"
            )
            self.findings.append(Finding("dropout", sentence, len(log.dropouts)))
        return log

    def _damaged(self) -> RunError:
        return RunError(f"{self.path}: {_CURE}")

    def topics(self) -> Mapping[str, LoggedTopic]:
        """Every topic, by name."""
        return self._topics

    @cached_property
    def _topics(self) -> Mapping[str, LoggedTopic]:
        found = {}
        for data in self._log.data_list:
            stamps = data.data["timestamp"]
            fields = {item.field_name: item.type_str for item in data.field_data}
            fields |= {"@yaw": "angle"} if {"q[0]", "q[1]", "q[2]", "q[3]"} <= fields.keys() else {}
            name = _name(data.name, data.multi_id)
            ends = (int(stamps[0]) * 1000, int(stamps[-1]) * 1000) if len(stamps) else (0, 0)
            found[name] = LoggedTopic(name, data.name, len(stamps), *ends, fields)
        if not found:
            raise RunError(f"{self.path}: the flight log holds no message; name another one")
        return dict(sorted(found.items()))

    def series(self, wanted: Mapping[str, tuple[str, ...]]) -> Mapping[str, Series]:
        """Fields of topics. Raises RunError for a topic that is not there, InputError for a field that is not."""
        log = {_name(data.name, data.multi_id): data.data for data in self._log.data_list}
        found = {}
        for topic, paths in wanted.items():
            known = self.topic(topic).fields
            data = log[topic]
            for path in paths:
                if path not in known:
                    raise InputError(f"{self.path}: field '{path}' of {topic}: {did_you_mean(path, known)}")
            stamps = data["timestamp"].astype(np.int64) * 1000
            values = {path: _yaws(data) if path == "@yaw" else data[path].astype(np.float64) for path in paths}
            found[topic] = Series(stamps, stamps, values)
        return found


def _name(name: str, instance: int) -> str:
    return f"{name}#{instance}" if instance else name


def _yaws(
    data: Mapping[str, np.ndarray[tuple[int], np.dtype[np.float64]]],
) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """PX4 writes a quaternion's real part first."""
    parts = [data[f"q[{k}]"].astype(np.float64).tolist() for k in (1, 2, 3, 0)]
    return np.array([yaw_of(*one) for one in zip(*parts, strict=True)])


def _measure(path: Path) -> None:
    """Raises where the description of messages is damaged, or would become more numbers than a message or a log holds.

    The library goes on reading for ever where the descriptions run into the file's end, and makes a list of numbers for
    each subscription before there is a message.
    """
    formats: dict[str, list[tuple[str, int]]] = {}
    for name, described in _formats(path):
        found = [_FIELD.fullmatch(part.strip()) for part in described.split(";") if part.strip()]
        formats[name] = [(one[1], int(one[2] or 1)) for one in found if one is not None]
        if len(formats) > limit("bag_topics"):
            raise too_much("bag_topics", len(formats), str(path))
    sizes: dict[str, int] = {}
    for name in formats:
        if _size(name, formats, sizes, 0) > _MOST_NUMBERS:
            raise RunError(f"{path}: messages '{readable(name, 60)}' would have more than {_MOST_NUMBERS} numbers")
    together = 0
    for count, name in enumerate(_subscribed(path), 1):
        together += _size(name, formats, sizes, 0)
        if count > limit("bag_topics"):
            raise too_much("bag_topics", count, str(path))
        if together > _MOST_TOGETHER:
            raise RunError(f"{path}: its topics would have more than {_MOST_TOGETHER} numbers together")


def _subscribed(path: Path) -> Iterator[str]:
    """The message of each subscription; raises RunError where nearly nothing is a message."""
    unknown, head = 0, struct.Struct("<HB")
    with path.open("rb") as file:
        file.seek(_HEADER_BYTES)
        while len(start := file.read(3)) == 3:
            length, kind = head.unpack(start)
            if kind == ord("A"):
                yield file.read(length)[3:].decode("latin-1")
                continue
            unknown += kind not in _KNOWN
            if unknown > _MOST_UNKNOWN:
                raise RunError(f"{path}: {_CURE}")
            file.seek(length, 1)


def _formats(path: Path) -> Iterator[tuple[str, str]]:
    """Name and fields of every message that is described, up to the first that is logged."""
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise RunError(f"{path}: is no PX4 flight log; wanted a .ulg file")
        file.seek(_HEADER_BYTES)
        while len(head := file.read(3)) == 3:
            length, kind = struct.unpack("<HB", head)
            if kind in _LOGGED:
                return
            content = file.read(length)
            if kind not in _DESCRIBED or len(content) < length:
                raise RunError(f"{path}: {_CURE}")
            if kind == ord("F"):
                name, _, described = content.decode("latin-1").partition(":")
                yield name, described
    raise RunError(f"{path}: the flight log holds no message; name another one")


def _size(name: str, formats: Mapping[str, list[tuple[str, int]]], sizes: dict[str, int], depth: int) -> int:
    if name not in formats:
        return 1
    if depth > 8:
        return _MOST_NUMBERS + 1
    if name not in sizes:
        sizes[name] = sum(times * _size(kind, formats, sizes, depth + 1) for kind, times in formats[name])
    return sizes[name]
