"""Decodes selected fields of an encoded message (CDR or ROS 1) and skips the rest.

A type is compiled once into a short program: parts of fixed layout, each read by one ``struct`` call, with strings and
sequences between them. Nothing after the last requested field is read, so a scan of a thousand rays adds no time to
reading a pose before it. Every length is checked against the available bytes.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from safedpa.errors import InputError, did_you_mean
from safedpa.ros.definitions import NUMBERS, QUATERNION, TIMES, Definitions, MessageField, numeric_fields

_LENGTH = {"<": struct.Struct("<I"), ">": struct.Struct(">I")}
_MAX_FIELDS = 20_000
"""Limit of fields in a flattened type; a message with 6 covariances has 250."""
_MAX_TEXTS, _LONG_TEXT = 16, 256
"""Texts of one field that are remembered, and bytes from which a text is not."""
_STEP = re.compile(r"([^.\[\]]+)((?:\[\d{1,6}\])*)")

_LATER_INDEX = re.compile(r"\[[1-9]")
"""Matches the path of an array entry other than the first; such paths are not listed in errors."""


class DecodingError(ValueError):
    """The bytes are not a message of this type."""


@dataclass
class _FixedLayout:
    """A part of fixed layout: (struct letter, bytes, slot) of each field; slot -1 if the field is not requested."""

    items: list[tuple[str, int, int]] = field(default_factory=list)
    compiled: dict[tuple[str, int], tuple[struct.Struct, tuple[int, ...], int]] = field(default_factory=dict)


@dataclass(frozen=True)
class _Text:
    slot: int
    wide: int = 1
    known: dict[bytes, str] = field(default_factory=dict, compare=False)
    """Decoded texts, since names of frames are the same in most messages."""


@dataclass(frozen=True)
class _Sequence:
    """A sequence: ``elements`` are the programs of requested elements by index, ``other`` that of the rest."""

    size: int
    """Bytes of a numeric element, else 0."""
    letter: str
    other: list[Any]
    elements: dict[int, list[Any]]


class Decoder:
    """Reads selected fields of one type: numbers, times [ns], strings, and quaternions as four numbers.

    ``paths`` have the form ``pose.pose.position.x`` or ``data[3]``. Raises InputError that lists the fields of the type
    if one does not exist.
    """

    def __init__(self, definitions: Definitions, name: str, paths: Sequence[str], *, ros1: bool = False) -> None:
        self._definitions, self._ros1, self._steps = definitions, ros1, 0
        self.paths = tuple(paths)
        self._slots: list[int] = []
        self.kinds: list[str] = []
        """Kind of each path: number, text, time or quaternion."""
        wanted: dict[tuple[str | int, ...], int] = {}
        for path in paths:
            self._want(name, path, wanted)
        try:
            self._program = self._flatten(name, (), wanted)
        except RecursionError as error:
            raise InputError(f"type '{name}': it contains itself; wanted a ROS type") from error
        _trim(self._program)
        self._count = sum(self._widths())
        several = [kind if kind in ("time", "quaternion") else "" for kind in self.kinds]
        self._outputs = list(zip(several, self._slots, strict=True))

    def _widths(self) -> list[int]:
        return [{"time": 2, "quaternion": 4}.get(kind, 1) for kind in self.kinds]

    def _want(self, name: str, path: str, wanted: dict[tuple[str | int, ...], int]) -> None:
        steps: list[str | int] = []
        for part in path.split("."):
            found = _STEP.fullmatch(part)
            if found is None:
                raise self._missing(name, path)
            steps += [found[1], *(int(index) for index in re.findall(r"\d+", found[2]))]
        kind = self._kind_at(name, path, steps)
        first = sum(self._widths())
        self._slots.append(first)
        if kind in TIMES:
            self.kinds.append("time")
            names = [item.name for item in self._definitions.of(kind)]
        elif kind == QUATERNION:
            self.kinds.append("quaternion")
            names = ["x", "y", "z", "w"]
        else:
            self.kinds.append("text" if kind in ("string", "wstring") else "number")
            wanted[tuple(steps)] = first
            return
        for offset, inner in enumerate(names):
            wanted[(*steps, inner)] = first + offset

    def _kind_at(self, name: str, path: str, steps: list[str | int]) -> str:
        """Type of the field at a path."""
        kind, at = name, 0
        while at < len(steps):
            if kind in NUMBERS or kind in ("string", "wstring"):
                raise self._missing(name, path)
            item = next((item for item in self._definitions.of(kind) if item.name == steps[at]), None)
            if item is None or not isinstance(steps[at], str):
                raise self._missing(name, path)
            at += 1
            if item.times != 0:
                index = steps[at] if at < len(steps) else None
                if not isinstance(index, int) or (item.times > 0 and index >= item.times):
                    raise self._missing(name, path)
                at += 1
            kind = item.type
        if kind not in (*NUMBERS, *TIMES, QUATERNION, "string"):
            raise self._missing(name, path)
        return kind

    def _missing(self, name: str, path: str) -> InputError:
        known = [one for one in numeric_fields(self._definitions, name) if not _LATER_INDEX.search(one)]
        return InputError(f"field '{path}' of {name}: {did_you_mean(path, known)}")

    # flattening

    def _flatten(self, name: str, at: tuple[str | int, ...], wanted: dict[tuple[str | int, ...], int]) -> list[Any]:
        program: list[Any] = []
        fields = self._definitions.of(name)
        if not fields and not self._ros1:
            _add_number(program, "B", 1, -1)  # ROS 2 encodes an empty message as one byte
        for item in fields:
            self._add(program, item, (*at, item.name), wanted)
        return program

    def _add(
        self,
        program: list[Any],
        item: MessageField,
        at: tuple[str | int, ...],
        wanted: dict[tuple[str | int, ...], int],
    ) -> None:
        if item.times < 0:
            program.append(self._sequence(item, at, wanted))
            return
        skipped = item.type in NUMBERS and item.times > 0 and not any(key[: len(at)] == at for key in wanted)
        if skipped:
            letter, size = NUMBERS[item.type]
            self._step()
            _add_number(program, f"{item.times}{letter}", size, -1)
            return
        for place in [at] if item.times == 0 else [(*at, index) for index in range(item.times)]:
            self._add_one(program, item.type, place, wanted)

    def _add_one(
        self, program: list[Any], kind: str, at: tuple[str | int, ...], wanted: dict[tuple[str | int, ...], int]
    ) -> None:
        self._step()
        if kind in NUMBERS:
            _add_number(program, *NUMBERS[kind], wanted.get(at, -1))
        elif kind in ("string", "wstring"):
            program.append(_Text(wanted.get(at, -1), 1 if kind == "string" else 2))
        else:
            for part in self._flatten(kind, at, wanted):
                _append(program, part)

    def _sequence(
        self, item: MessageField, at: tuple[str | int, ...], wanted: dict[tuple[str | int, ...], int]
    ) -> _Sequence:
        indexes = {
            key[len(at)]
            for key in wanted
            if key[: len(at)] == at and len(key) > len(at) and isinstance(key[len(at)], int)
        }
        elements = {
            index: self._element(item, (*at, index), wanted) for index in sorted(indexes) if isinstance(index, int)
        }
        letter, size = NUMBERS.get(item.type, ("", 0))
        return _Sequence(size, letter, self._element(item, (*at, -1), {}), elements)

    def _element(
        self, item: MessageField, at: tuple[str | int, ...], wanted: dict[tuple[str | int, ...], int]
    ) -> list[Any]:
        program: list[Any] = []
        self._add_one(program, item.type, at, wanted)
        return program

    def _step(self) -> None:
        self._steps += 1  # each element of an array counts
        if self._steps > _MAX_FIELDS:
            raise InputError(f"a message of more than {_MAX_FIELDS} fields; wanted fewer")

    # reading

    def __call__(self, data: bytes) -> list[Any]:
        """Returns one value for each path; None if a sequence is too short. Raises DecodingError."""
        values: list[Any] = [None] * self._count
        try:
            if self._ros1:
                _run(self._program, data, 0, "<", 0, values)
            else:
                if len(data) < 4 or data[0] != 0 or data[1] > 1:
                    raise DecodingError("no plain CDR")
                _run(self._program, data, 4, "<" if data[1] else ">", 4, values)
        except (struct.error, UnicodeDecodeError) as error:
            raise DecodingError("it ends too early") from error
        found = []
        for kind, first in self._outputs:
            value = values[first]
            if kind and value is not None:
                value = (
                    value * 1_000_000_000 + values[first + 1] if kind == "time" else tuple(values[first : first + 4])
                )
            found.append(value)
        return found


def _add_number(program: list[Any], letter: str, size: int, slot: int) -> None:
    if not program or not isinstance(program[-1], _FixedLayout):
        program.append(_FixedLayout())
    program[-1].items.append((letter, size, slot))


def _append(program: list[Any], part: Any) -> None:
    """Appends a part; merges adjacent parts of fixed layout."""
    if isinstance(part, _FixedLayout) and program and isinstance(program[-1], _FixedLayout):
        program[-1].items.extend(part.items)
    else:
        program.append(part)


def _trim(program: list[Any]) -> None:
    """Removes everything after the last requested field."""
    while program and not _is_wanted(program[-1]):
        program.pop()
    if program and isinstance(program[-1], _FixedLayout):
        items = program[-1].items
        while items[-1][2] < 0:
            items.pop()


def _is_wanted(part: Any) -> bool:
    if isinstance(part, _FixedLayout):
        return any(slot >= 0 for _, _, slot in part.items)
    return part.slot >= 0 if isinstance(part, _Text) else bool(part.elements)


def _run(program: list[Any], data: bytes, at: int, order: str, base: int, values: list[Any]) -> int:
    """Runs a program from ``at`` and returns the end; CDR aligns relative to ``base`` (0: no alignment, ROS 1)."""
    for part in program:
        if isinstance(part, _FixedLayout):
            phase = (at - base) % 8 if base else -1
            compiled = part.compiled.get((order, phase))
            if compiled is None:
                compiled = part.compiled[(order, phase)] = _layout(part.items, order, phase)
            layout, slots, size = compiled
            found = layout.unpack_from(data, at)
            for slot, value in zip(slots, found, strict=True):
                values[slot] = value
            at += size
        elif isinstance(part, _Text):
            at = _read_text(part, data, at, order, base, values)
        else:
            at = _read_sequence(part, data, at, order, base, values)
    return at


def _layout(items: list[tuple[str, int, int]], order: str, phase: int) -> tuple[struct.Struct, tuple[int, ...], int]:
    letters, slots, at = [order], [], phase
    for letter, size, slot in items:
        gap = -at % size if phase >= 0 else 0
        count = int(letter[:-1]) if len(letter) > 1 else 1
        if gap:
            letters.append(f"{gap}x")
        if slot >= 0:
            letters.append(letter)
            slots.append(slot)
        else:
            letters.append(f"{count * size}x")
        at += gap + count * size
    layout = struct.Struct("".join(letters))
    return layout, tuple(slots), layout.size


def _length(data: bytes, at: int, order: str, base: int) -> tuple[int, int]:
    if base:
        at += (base - at) % 4
    (length,) = _LENGTH[order].unpack_from(data, at)
    return length, at + 4


def _read_text(part: _Text, data: bytes, at: int, order: str, base: int, values: list[Any]) -> int:
    length, at = _length(data, at, order, base)
    end = at + part.wide * length
    if end > len(data):
        raise DecodingError("a text is longer than the message")
    if part.slot >= 0:
        content = data[at:end]
        text = part.known.get(content)
        if text is None:
            text = content.rstrip(b"\0").decode("utf-8", "replace")
            if len(part.known) < _MAX_TEXTS and len(content) < _LONG_TEXT:
                part.known[content] = text
        values[part.slot] = text
    return end


def _read_sequence(part: _Sequence, data: bytes, at: int, order: str, base: int, values: list[Any]) -> int:
    length, at = _length(data, at, order, base)
    if length > len(data) - at:
        raise DecodingError("a sequence is longer than the message")
    if part.size:
        if length and base:
            at += (base - at) % part.size
        end = at + length * part.size
        if end > len(data):
            raise DecodingError("a sequence is longer than the message")
        for index, program in part.elements.items():
            if index < length:
                _run(program, data, at + index * part.size, order, base, values)
        return end
    if not part.other:  # elements without bytes
        return at
    for index in range(length):
        at = _run(part.elements.get(index, part.other), data, at, order, base, values)
    return at
