"""Reads PX4 flight logs (``.ulg``): numeric topics, all with the clock of the flight controller."""

from __future__ import annotations

import contextlib
import io
import re
import struct
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
_MAX_NUMBERS = 4096
"""Limit of numbers in one message; the largest of PX4 has 400."""
_MAX_TOTAL_NUMBERS = 100_000
"""Limit of numbers in all subscribed topics; a PX4 vehicle has 10,000."""
_MAX_UNKNOWN = 200_000
"""Limit of messages of unknown kinds: pyulog needs 2 us for each, and a hole of zeros has one in 3 bytes."""
_DAMAGED = "is a damaged PX4 flight log; fetch it from the vehicle's card again"
_DEFINITION_KINDS, _DATA_KINDS = b"BIMFPQ", b"ALC"
"""Message kinds of the definition section, and those with which the data section begins."""
_KNOWN_KINDS = b"BIMFPQALCDRSO"
_FIELD = re.compile(r"([A-Za-z0-9_]+)(?:\[(\d{1,9})\])? [A-Za-z0-9_]+")


class UlogLog(AbstractLog):
    """A PX4 flight log. Several topics of one name are called ``name``, ``name#1``, ..."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "PX4 flight log")
        need("ros", what="reading PX4 flight logs")

    @cached_property
    def _log(self) -> ULog:
        from pyulog.core import ULog

        size = self.path.stat().st_size
        if size > limit("table_bytes"):
            raise too_much("table_bytes", f"{size} bytes", str(self.path))
        cut = _check_sizes(self.path)
        damage: tuple[type[Exception], ...] = (
            ValueError, struct.error, KeyError, IndexError, TypeError, AttributeError, OverflowError, RecursionError,
            EOFError, ZeroDivisionError,
        )  # fmt: skip
        try:
            with contextlib.redirect_stdout(io.StringIO()), self.path.open("rb") as file:  # pyulog leaves its own open
                log = ULog(file)
        except damage as error:
            raise self._damaged() from error
        except Exception as error:  # pyulog raises plain Exceptions
            if type(error).__module__.startswith("pyulog"):
                raise self._damaged() from error
            raise
        if cut is not None:
            sentence = f"the flight log is cut off at byte {cut} of {size}; read up to there"
            self.findings.append(Finding("cut_off", sentence))
        if log.file_corruption:
            sentence = "the flight log is damaged in places, which were skipped"
            self.findings.append(Finding("damaged", sentence, start_t=_time_before_damage(self.path)))
        lost = sum(item.duration for item in log.dropouts)
        if lost:
            sentence = (
                f"the logger fell behind {len(log.dropouts)} times, {lost / 1000:.2f} s in all; that part is missing"
            )
            self.findings.append(Finding("dropout", sentence, len(log.dropouts)))
        return log

    def _damaged(self) -> RunError:
        return RunError(f"{self.path}: {_DAMAGED}")

    def topics(self) -> Mapping[str, LoggedTopic]:
        """Every topic by name."""
        return self._topics

    @cached_property
    def _data(self) -> Mapping[str, list[Mapping[str, Any]]]:
        """The columns of each topic by name; a topic that was subscribed again has several parts, in order of time."""
        found: dict[str, list[Mapping[str, Any]]] = {}
        for item in self._log.data_list:
            parts = found.setdefault(_name(item.name, item.multi_id), [])
            if len(item.data["timestamp"]) or not parts:
                parts.append(item.data)
        if not found:
            raise RunError(f"{self.path}: the flight log contains no message; name another one")
        for parts in found.values():
            parts.sort(key=lambda part: int(part["timestamp"][0]) if len(part["timestamp"]) else 0)
        return found

    @cached_property
    def _topics(self) -> Mapping[str, LoggedTopic]:
        found, data = {}, self._data
        for item in self._log.data_list:
            name = _name(item.name, item.multi_id)
            fields = {part.field_name: part.type_str for part in item.field_data}
            fields |= {"@yaw": "angle"} if {"q[0]", "q[1]", "q[2]", "q[3]"} <= fields.keys() else {}
            stamps = np.concatenate([part["timestamp"] for part in data[name]])
            ends = (int(stamps[0]) * 1000, int(stamps[-1]) * 1000) if len(stamps) else (0, 0)
            found[name] = LoggedTopic(name, item.name, len(stamps), *ends, fields)
        return dict(sorted(found.items()))

    def series(self, wanted: Mapping[str, tuple[str, ...]]) -> Mapping[str, Series]:
        """Reads fields of topics; raises RunError for a missing topic and InputError for a missing field."""
        found = {}
        for topic, paths in wanted.items():
            known = self.topic(topic).fields
            for path in paths:
                if path not in known:
                    raise InputError(f"{self.path}: field '{path}' of {topic}: {did_you_mean(path, known)}")
            parts = self._data[topic]
            stamps = np.concatenate([part["timestamp"].astype(np.int64) * 1000 for part in parts])
            values = {path: np.concatenate([_column(part, path) for part in parts]) for path in paths}
            found[topic] = Series(stamps, stamps, values)
        return found


def _name(name: str, instance: int) -> str:
    return f"{name}#{instance}" if instance else name


def _column(data: Mapping[str, Any], path: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return _yaw_column(data) if path == "@yaw" else data[path].astype(np.float64)


def _yaw_column(
    data: Mapping[str, Any],
) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Yaw of a quaternion column; PX4 stores the real part first."""
    parts = [data[f"q[{k}]"].astype(np.float64).tolist() for k in (1, 2, 3, 0)]
    return np.array([yaw_of(*one) for one in zip(*parts, strict=True)])


def _check_sizes(path: Path) -> int | None:
    """Raises RunError if the definition section is damaged, or if its messages would be too large.

    Returns the byte at which the last message begins if the file ends within it.

    This protects pyulog: it loops forever if the definitions run into the end of the file, and allocates a list of
    numbers for each subscription before any message.
    """
    formats: dict[str, list[tuple[str, int]]] = {}
    for name, described in _message_formats(path):
        found = [_FIELD.fullmatch(part.strip()) for part in described.split(";") if part.strip()]
        formats[name] = [(one[1], int(one[2] or 1)) for one in found if one is not None]
        if len(formats) > limit("bag_topics"):
            raise too_much("bag_topics", len(formats), str(path))
    sizes: dict[str, int] = {}
    for name in formats:
        if _message_size(name, formats, sizes, 0) > _MAX_NUMBERS:
            raise RunError(f"{path}: messages '{readable(name, 60)}' would have more than {_MAX_NUMBERS} numbers")
    total = 0
    end = [0]
    for count, name in enumerate(_subscribed_messages(path, end), 1):
        total += _message_size(name, formats, sizes, 0)
        if count > limit("bag_topics"):
            raise too_much("bag_topics", count, str(path))
        if total > _MAX_TOTAL_NUMBERS:
            raise RunError(f"{path}: its topics would have more than {_MAX_TOTAL_NUMBERS} numbers in total")
    return end[0] if end[0] < path.stat().st_size else None


def _subscribed_messages(path: Path, end: list[int]) -> Iterator[str]:
    """Yields the message name of each subscription; raises RunError if nearly all messages are of unknown kinds.

    ``end`` gets the byte after the last complete message.
    """
    unknown, head = 0, struct.Struct("<HB")
    with path.open("rb") as file:
        size = file.seek(0, 2)
        at = file.seek(_HEADER_BYTES)
        while len(start := file.read(3)) == 3:
            length, kind = head.unpack(start)
            end[0] = at
            at += 3 + length
            if at > size:
                return
            if kind == ord("A"):
                yield file.read(length)[3:].decode("latin-1")
                continue
            unknown += kind not in _KNOWN_KINDS
            if unknown > _MAX_UNKNOWN:
                raise RunError(f"{path}: {_DAMAGED}")
            file.seek(length, 1)
        end[0] = at


def _time_before_damage(path: Path) -> float | None:
    """Time [s] of the last message before the first one of an unknown kind."""
    head, stamped, last = struct.Struct("<HB"), struct.Struct("<HQ"), None
    with path.open("rb") as file:
        file.seek(_HEADER_BYTES)
        while len(start := file.read(3)) == 3:
            length, kind = head.unpack(start)
            if kind not in _KNOWN_KINDS:
                break
            content = file.read(length)
            if kind == ord("D") and len(content) >= stamped.size:
                last = stamped.unpack_from(content)[1] * 1e-6
    return last


def _message_formats(path: Path) -> Iterator[tuple[str, str]]:
    """Yields name and fields of every message definition, up to the data section."""
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise RunError(f"{path}: is no PX4 flight log; wanted a .ulg file")
        file.seek(_HEADER_BYTES)
        while len(head := file.read(3)) == 3:
            length, kind = struct.unpack("<HB", head)
            if kind in _DATA_KINDS:
                return
            content = file.read(length)
            if kind not in _DEFINITION_KINDS or len(content) < length:
                raise RunError(f"{path}: {_DAMAGED}")
            if kind == ord("F"):
                name, _, described = content.decode("latin-1").partition(":")
                yield name, described
    raise RunError(f"{path}: the flight log contains no message; name another one")


def _message_size(name: str, formats: Mapping[str, list[tuple[str, int]]], sizes: dict[str, int], depth: int) -> int:
    if name not in formats:
        return 1
    if depth > 8:
        return _MAX_NUMBERS + 1
    if name not in sizes:
        sizes[name] = sum(times * _message_size(kind, formats, sizes, depth + 1) for kind, times in formats[name])
    return sizes[name]
