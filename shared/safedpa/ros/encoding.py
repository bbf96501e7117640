"""Encodes ROS 2 messages from plain values as CDR, and computes the hash of a type."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np

from safedpa.errors import InputError, did_you_mean
from safedpa.extras import need
from safedpa.ros.decoding import DecodingError
from safedpa.ros.definitions import known_fields, plain_type, shipped_definitions


@cache
def type_store() -> Any:
    """Type store of rosbags with the standard and the shipped types, and no others."""
    need("ros", what="speaking ROS 2")
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_KILTED)
    for name, text in shipped_definitions():
        store.register(get_types_from_msg(text, name))
    return store


@cache
def hash_of(name: str) -> str:
    """Type hash ``RIHS01_`` with 64 hexadecimal digits (ROS REP 2016); raises InputError for an unknown type."""
    _require(plain_type(name))
    return str(type_store().hash_rihs01(plain_type(name)))


def encode(name: str, values: Mapping[str, Any]) -> bytes:
    """Encodes a message; fields are nested mappings and sequences, missing ones are zero, empty or false.

    Raises InputError for an unknown type or field.
    """
    name = plain_type(name)
    _require(name)
    return bytes(type_store().serialize_cdr(_build(name, values), name))


def decode(name: str, data: bytes) -> Any:
    """Decodes a whole message, with fields as attributes and arrays as NumPy arrays; raises DecodingError.

    ``Decoder`` is faster for a few fields.
    """
    store = type_store()
    from rosbags.serde import SerdeError

    try:
        return store.deserialize_cdr(data, plain_type(name))
    except (SerdeError, struct.error, ValueError, IndexError, AssertionError, OverflowError, TypeError) as error:
        raise DecodingError("it is truncated, or not plain CDR") from error


def stamp_of(nanoseconds: int) -> dict[str, int]:
    """Converts nanoseconds to ``builtin_interfaces/msg/Time``."""
    seconds, rest = divmod(nanoseconds, 1_000_000_000)
    return {"sec": seconds, "nanosec": rest}


def _require(name: str) -> None:
    if name not in known_fields():
        package = name.split("/", 1)[0]
        similar = [one for one in known_fields() if one.startswith(f"{package}/")] or ["geometry_msgs/msg/Twist"]
        raise InputError(f"type '{name}': {did_you_mean(name, similar)}")


def _build(name: str, values: Mapping[str, Any]) -> Any:
    fields = {item.name: item for item in known_fields()[name]}
    for key in values:
        if key not in fields:
            raise InputError(f"field '{key}' of {name}: {did_you_mean(key, fields)}")
    parts = {}
    for key, item in fields.items():
        given = values.get(key)
        if item.times == 0:
            parts[key] = _one(item.type, given)
        else:
            parts[key] = _many(item.type, max(item.times, 0), given)
    return type_store().types[name](**parts)


def _one(kind: str, given: Any) -> Any:
    if kind == "string":
        return "" if given is None else str(given)
    if kind == "bool":
        return bool(given)
    if kind.startswith("float"):
        return float(given or 0.0)
    if "/" not in kind:
        return int(given or 0)
    return _build(kind, given or {})


def _many(kind: str, count: int, given: Sequence[Any] | None) -> Any:
    entries = [] if given is None else list(given)
    entries += [None] * (count - len(entries))
    if "/" in kind or kind == "string":
        return [_one(kind, entry) for entry in entries]
    return np.array([_one(kind, entry) for entry in entries], dtype={"byte": "uint8", "char": "uint8"}.get(kind, kind))
