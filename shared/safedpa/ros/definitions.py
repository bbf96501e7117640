"""Message types: which fields a type has, from a definition that a log carries, or from those that are known.

Definitions from a log are parsed and walked here; no code is made of them.
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

__all__ = [
    "NUMBERS",
    "QUATERNION",
    "TIMES",
    "Definitions",
    "MessageField",
    "known_fields",
    "numeric_fields",
    "parsed",
    "plain_type",
    "summarize_definition",
]

NUMBERS: Final[Mapping[str, tuple[str, int]]] = {
    "bool": ("?", 1), "byte": ("B", 1), "char": ("B", 1), "octet": ("B", 1),
    "int8": ("b", 1), "uint8": ("B", 1), "int16": ("h", 2), "uint16": ("H", 2), "int32": ("i", 4), "uint32": ("I", 4),
    "int64": ("q", 8), "uint64": ("Q", 8), "float32": ("f", 4), "float64": ("d", 8),
}  # fmt: skip
"""Letter of ``struct`` and bytes of each primitive type that is a number."""
TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
QUATERNION = "geometry_msgs/msg/Quaternion"
_DEEPEST = 24
"""Types within types; those of ROS have 6."""
_REPORTS_NOTHING = 16
"""Times as long as what it says a definition may be, with its comments."""
_MOST_FIELDS = 4096
"""Numbers of one message that are listed."""
_MOST_STEPS = 20_000
"""Fields that are looked at in one type."""


@dataclass(frozen=True)
class MessageField:
    """One field of a type: a primitive's or a type's name, and how often: 0 once, n an array, -1 a sequence."""

    name: str
    type: str
    times: int = 0


Fields = tuple[MessageField, ...]


@dataclass(frozen=True)
class Definitions:
    """Fields of types by their full name ``package/msg/Type``; what a log defines comes before what is known."""

    ros1: bool = False
    own: Mapping[str, Fields] = field(default_factory=dict)

    def of(self, name: str) -> Fields:
        """The fields of a type. Raises InputError when no one defines it."""
        found = self.own.get(name)
        if found is None:
            found = known_fields(self.ros1).get(name)
        if found is None:
            raise InputError(
                f"type '{readable(name)}': the log does not define it and it is none of the standard ones; record it "
                "with its definition (rosbag2 --storage mcap), or leave its topic out"
            )
        return found

    def knows(self, name: str) -> bool:
        """Whether the type, and every type within it, is defined."""
        try:
            numeric_fields(self, name)
        except InputError:
            return False
        return True


def plain_type(name: str) -> str:
    """``nav_msgs/Odometry``, ``nav_msgs/msg/Odometry`` and ``nav_msgs::msg::dds_::Odometry_`` as the second one."""
    parts = [part for part in name.replace("::", "/").split("/") if part != "dds_"]
    if "::dds_::" in name and parts[-1].endswith("_"):
        parts[-1] = parts[-1][:-1]
    return "/".join([parts[0], "msg", parts[1]] if len(parts) == 2 else parts)


def numeric_fields(definitions: Definitions, name: str) -> dict[str, str]:
    """Path to type of everything in a message that can become a column: numbers, times, quaternions as an angle.

    Sequences show their first element, ``data[0]``. Raises InputError for types that are not defined.
    """
    found: dict[str, str] = {}
    steps = count(1)
    for path, kind in _leaves(definitions, name, "", 0, steps):
        found[path] = kind
        if len(found) >= _MOST_FIELDS:
            break
    return found


def _leaves(
    definitions: Definitions, name: str, prefix: str, depth: int, steps: Iterator[int]
) -> Iterator[tuple[str, str]]:
    if depth > _DEEPEST:
        raise InputError(f"type '{readable(name)}': more than {_DEEPEST} types within each other; wanted fewer")
    for item in definitions.of(name):
        if next(steps) > _MOST_STEPS:
            raise InputError(f"type '{readable(name)}': more than {_MOST_STEPS} fields; wanted fewer")
        path = f"{prefix}{item.name}"
        times = 1 if item.times < 0 else min(item.times, _MOST_FIELDS)
        for one in [path] if item.times == 0 else [f"{path}[{k}]" for k in range(times)]:
            if item.type in NUMBERS or item.type in TIMES:
                yield one, item.type
            elif item.type not in ("string", "wstring"):
                if item.type == QUATERNION:
                    yield one, item.type
                yield from _leaves(definitions, item.type, f"{one}.", depth + 1, steps)


@cache
def known_fields(ros1: bool = False) -> dict[str, Fields]:
    """The standard types, and those of common drivers that ship here."""
    need("ros", what="reading ROS logs")
    store = importlib.import_module(f"rosbags.typesys.stores.{'ros1_noetic' if ros1 else 'ros2_kilted'}")
    found = {name: _fields(described[1]) for name, described in store.FIELDDEFS.items()}
    for package in sorted((files("safedpa.ros") / "messages").iterdir(), key=lambda folder: folder.name):
        for file in sorted(package.iterdir(), key=lambda item: item.name):
            name = f"{package.name}/msg/{file.name.removesuffix('.msg')}"
            found.update(parsed(name, file.read_text(encoding="utf-8"), "ros2msg"))
    return found


def summarize_definition(text: str, form: str) -> tuple[str, int]:
    """A definition without lines that are blank or a comment alone, and how many lines and commas are left in it.

    Cheap, whatever it is, while the library's grammar takes 15 to 100 us for each line, and 15 for each comma.
    """
    notice = [line for raw in text.split("\n") if (line := raw.strip(" \t\r"))]
    if form != "ros2idl":
        notice = [line for line in notice if line[0] != "#"]
    left = "\n".join([*notice, ""])
    return left, len(notice) + left.count(",")


@lru_cache(maxsize=512)
def parsed(name: str, text: str, form: str) -> Mapping[str, Fields]:
    """Types that a definition describes, ``form`` being ros1msg, ros2msg or ros2idl.

    Raises InputError for what cannot be parsed, LimitError for a text that is too long.
    """
    need("ros", what="reading ROS logs")
    from rosbags.typesys import TypesysError, get_types_from_idl, get_types_from_msg

    if len(text) > _REPORTS_NOTHING * limit("definition_letters"):
        raise too_much("definition_letters", len(text), f"type '{readable(name)}'")
    text, lines = summarize_definition(text, form)
    if len(text) > limit("definition_letters"):
        raise too_much("definition_letters", len(text), f"type '{readable(name)}'")
    if lines > limit("definition_lines"):
        raise too_much("definition_lines", lines, f"type '{readable(name)}'")
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
    """From the library's form: (name, (kind, what)), kind 1 a primitive, 2 a type, 3 an array, 4 a sequence."""
    found = []
    for name, (kind, what) in described:
        inner, times = (what[0], what[1] if kind == 3 else -1) if kind in (3, 4) else ((kind, what), 0)
        if kind == 3 and times < 1:
            raise ValueError(f"an array of {times}")
        found.append(MessageField(name, inner[1][0] if inner[0] == 1 else plain_type(inner[1]), times))
    return tuple(found)
