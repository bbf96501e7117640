"""Fields of message types, from the definitions in a log or the standard ones.

Definitions from a log are only parsed; no code is generated from them.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache, lru_cache
from importlib.resources import files
from itertools import count
from typing import Any, Final

from safedpa.errors import InputError
from safedpa.extras import need
from safedpa.limits import limit, readable, too_much

NUMBERS: Final[Mapping[str, tuple[str, int]]] = {
    "bool": ("?", 1), "byte": ("B", 1), "char": ("B", 1), "octet": ("B", 1),
    "int8": ("b", 1), "uint8": ("B", 1), "int16": ("h", 2), "uint16": ("H", 2), "int32": ("i", 4), "uint32": ("I", 4),
    "int64": ("q", 8), "uint64": ("Q", 8), "float32": ("f", 4), "float64": ("d", 8),
}  # fmt: skip
"""``struct`` letter and size in bytes of each numeric primitive type."""
TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
QUATERNION = "geometry_msgs/msg/Quaternion"
_MAX_DEPTH = 24
"""Limit of nested types; those of ROS have 6."""
_COMMENT_FACTOR = 16
"""A definition with its comments may be so many times as long as the limit for the part without."""
_MAX_FIELDS = 4096
"""Fields of one message that are listed."""
_MAX_VISITED = 20_000
"""Fields of one type that are visited."""


@dataclass(frozen=True)
class MessageField:
    """A field: its type (primitive or message), and ``times``: 0 for one value, n for an array, -1 for a sequence."""

    name: str
    type: str
    times: int = 0


Fields = tuple[MessageField, ...]


@dataclass(frozen=True)
class Definitions:
    """Fields of types by full name ``package/msg/Type``; definitions of the log take precedence over standard ones."""

    ros1: bool = False
    own: Mapping[str, Fields] = field(default_factory=dict)

    def of(self, name: str) -> Fields:
        """Returns the fields of a type; raises InputError if it is not defined."""
        found = self.own.get(name)
        if found is None:
            found = known_fields(self.ros1).get(name)
        if found is None:
            raise InputError(
                f"type '{readable(name)}': the log does not define it and it is not a standard type; record it "
                "with its definition (rosbag2 --storage mcap), or remove its topic"
            )
        return found

    def knows(self, name: str) -> bool:
        """Whether the type and every type inside it are defined."""
        try:
            numeric_fields(self, name)
        except InputError:
            return False
        return True


def plain_type(name: str) -> str:
    """Normalises ``nav_msgs/Odometry`` and ``nav_msgs::msg::dds_::Odometry_`` to ``nav_msgs/msg/Odometry``."""
    parts = [part for part in name.replace("::", "/").split("/") if part != "dds_"]
    if "::dds_::" in name and parts[-1].endswith("_"):
        parts[-1] = parts[-1][:-1]
    return "/".join([parts[0], "msg", parts[1]] if len(parts) == 2 else parts)


def numeric_fields(definitions: Definitions, name: str) -> dict[str, str]:
    """Returns the type of every field that can become a column: numbers, times, and quaternions (as an angle).

    A sequence is listed with its first element, ``data[0]``. Raises InputError for undefined types.
    """
    found: dict[str, str] = {}
    steps = count(1)
    for path, kind in _leaves(definitions, name, "", 0, steps):
        found[path] = kind
        if len(found) >= _MAX_FIELDS:
            break
    return found


def _leaves(
    definitions: Definitions, name: str, prefix: str, depth: int, steps: Iterator[int]
) -> Iterator[tuple[str, str]]:
    if depth > _MAX_DEPTH:
        raise InputError(f"type '{readable(name)}': more than {_MAX_DEPTH} nested types; wanted fewer")
    for item in definitions.of(name):
        if next(steps) > _MAX_VISITED:
            raise InputError(f"type '{readable(name)}': more than {_MAX_VISITED} fields; wanted fewer")
        path = f"{prefix}{item.name}"
        times = 1 if item.times < 0 else min(item.times, _MAX_FIELDS)
        for one in [path] if item.times == 0 else [f"{path}[{k}]" for k in range(times)]:
            if item.type in NUMBERS or item.type in TIMES:
                yield one, item.type
            elif item.type not in ("string", "wstring"):
                if item.type == QUATERNION:
                    yield one, item.type
                yield from _leaves(definitions, item.type, f"{one}.", depth + 1, steps)


@cache
def known_fields(ros1: bool = False) -> dict[str, Fields]:
    """Fields of the standard types, and of common driver messages that are shipped here."""
    need("ros", what="reading ROS logs")
    store = importlib.import_module(f"rosbags.typesys.stores.{'ros1_noetic' if ros1 else 'ros2_kilted'}")
    found = {name: _fields(described[1]) for name, described in store.FIELDDEFS.items()}
    for name, text in shipped_definitions():
        found.update(parsed(name, text, "ros2msg"))
    return found


def shipped_definitions() -> Iterator[tuple[str, str]]:
    """Yields name and definition of each message type that is shipped here."""
    for package in sorted((files("safedpa.ros") / "messages").iterdir(), key=lambda folder: folder.name):
        for file in sorted(package.iterdir(), key=lambda item: item.name):
            yield f"{package.name}/msg/{file.name.removesuffix('.msg')}", file.read_text(encoding="utf-8")


def summarize_definition(text: str, form: str) -> tuple[str, int]:
    """Removes blank and comment lines from a definition; returns the rest and its number of lines and commas.

    This bounds the parsing time: the library needs 15 to 100 us for each line, and 15 us for each comma.
    """
    lines = [line for raw in text.split("\n") if (line := raw.strip(" \t\r"))]
    if form != "ros2idl":
        lines = [line for line in lines if line[0] != "#"]
    left = "\n".join([*lines, ""])
    return left, len(lines) + left.count(",")


@lru_cache(maxsize=512)
def parsed(name: str, text: str, form: str) -> Mapping[str, Fields]:
    """Parses a definition; ``form`` is ros1msg, ros2msg or ros2idl. Returns the fields of its types.

    Raises InputError if it cannot be parsed, and LimitError if it is too long.
    """
    need("ros", what="reading ROS logs")
    from rosbags.typesys import TypesysError, get_types_from_idl, get_types_from_msg

    if len(text) > _COMMENT_FACTOR * limit("definition_letters"):
        raise too_much("definition_letters", len(text), f"type '{readable(name)}'")
    text, count = summarize_definition(text, form)
    if len(text) > limit("definition_letters"):
        raise too_much("definition_letters", len(text), f"type '{readable(name)}'")
    if count > limit("definition_lines"):
        raise too_much("definition_lines", count, f"type '{readable(name)}'")
    try:
        if form == "ros2idl":
            parts = [part for part in text.split("=" * 80 + "\n") if part.strip()]
            found: dict[str, Any] = {}
            for part in parts:
                found.update(get_types_from_idl(part.split("\n", 1)[1] if part.startswith("IDL: ") else part))
        else:
            found = dict(get_types_from_msg(text, name))
        return {plain_type(key): _fields(described[1]) for key, described in found.items()}
    except (TypesysError, ValueError, KeyError, RecursionError, AssertionError, IndexError) as error:
        raise InputError(f"type '{readable(name)}': its definition in the log cannot be read") from error


def _fields(described: Any) -> Fields:
    """Converts from rosbags: (name, (kind, what)), where kind is 1 primitive, 2 type, 3 array, 4 sequence."""
    found = []
    for name, (kind, what) in described:
        inner, times = (what[0], what[1] if kind == 3 else -1) if kind in (3, 4) else ((kind, what), 0)
        if kind == 3 and times < 1:
            raise ValueError(f"an array of {times}")
        found.append(MessageField(name, inner[1][0] if inner[0] == 1 else plain_type(inner[1]), times))
    return tuple(found)
