"""Strict conversion of messages to and from msgpack.

Messages with wrong types, excessive sizes, NaN or infinite numbers are rejected on receipt.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import MISSING, fields
from itertools import chain
from typing import Any, TypeVar

import msgpack
import msgspec

from safedpa.bus.messages.messages import LARGEST_NUMBER, Message
from safedpa.bus.messages.requests import Answer, Request
from safedpa.bus.messages.topics import TOPICS
from safedpa.errors import MessageError
from safedpa.limits import limit

__all__ = ["LARGEST_BYTES", "decode", "decode_by_field", "encode"]

LARGEST_BYTES: dict[type[Any], int] = {
    **{topic.message: topic.largest_bytes for topic in TOPICS.values()},
    Request: 4096,
    Answer: 8 * 1024 * 1024,  # two model files and their margins
}
"""Size limit in bytes by type of message; larger payloads are rejected before they are parsed."""

# Size limit in bytes for decoding by field, which creates a Python object of 64 bytes or more for a single byte of
# payload: without this limit, 8 MiB of small integers would occupy half a gigabyte.
_LARGEST_BY_FIELD = 65536

_M = TypeVar("_M", bound="Message | Request | Answer")
_Check = Callable[[str, Any], Any]


def encode(message: Message | Request | Answer) -> bytes:
    """The message as a msgpack map from field names to values."""
    try:
        return _pack(message)
    except (TypeError, OverflowError):
        # msgspec rejects subclasses such as numpy.float64; msgpack packs them as the floats that they are.
        packed: bytes = msgpack.packb({name: getattr(message, name) for name in _NAMES[type(message)]})
        return packed


def decode(kind: type[_M], payload: bytes) -> _M:
    """Decodes a payload into a message of type ``kind``. Unknown fields are ignored.

    Raises MessageError, which names the field, if the payload is too large or not a msgpack map, if a field is missing
    or has the wrong type, or if a number is NaN, infinite or larger than LARGEST_NUMBER.
    """
    # The size is checked first, so that a large payload costs a length check and no parsing.
    if len(payload) > LARGEST_BYTES[kind]:
        raise MessageError(f"{kind.__name__}: got {len(payload)} bytes, wanted at most {LARGEST_BYTES[kind]}")
    try:
        message: _M = _READERS[kind](payload)
        return message
    except (ValueError, RecursionError) as error:
        # The slow decoder raises an error that names the class and the field, and its verdict counts.
        if len(payload) > _LARGEST_BY_FIELD:
            raise MessageError(f"{kind.__name__}: {str(error)[:200] or type(error).__name__}") from error
        return decode_by_field(kind, payload)


def decode_by_field(kind: type[_M], payload: bytes) -> _M:
    """Same as ``decode``, field by field in Python: the reference implementation, eight times slower."""
    try:
        table = msgpack.unpackb(payload, use_list=False, strict_map_key=True, max_map_len=limit("message_entries"))
    except (ValueError, msgpack.exceptions.UnpackException, UnicodeDecodeError) as error:
        raise MessageError(f"{kind.__name__}: no msgpack ({error})") from error
    if not isinstance(table, dict):
        raise MessageError(f"{kind.__name__}: got {type(table).__name__}, wanted a map of fields")
    values = {}
    for name, full_name, check, optional in _FIELDS[kind]:
        if name in table:
            values[name] = check(full_name, table[name])
        elif not optional:
            raise MessageError(f"{full_name}: missing")
    return kind(**values)


def _integer(name: str, value: Any) -> int:
    # `type(...) is` instead of isinstance, here and below: bool is a subclass of int.
    if type(value) is not int or value < 0:
        raise MessageError(f"{name}: got {_short(value)}, wanted a non-negative integer")
    return value


def _float(name: str, value: Any) -> float:
    # Fast path. Comparisons with NaN are false, so NaN falls through to the checks below.
    if type(value) is float and -LARGEST_NUMBER <= value <= LARGEST_NUMBER:
        return value
    if type(value) not in (float, int) or not math.isfinite(value):
        raise MessageError(f"{name}: got {_short(value)}, wanted a finite number")
    if abs(value) > LARGEST_NUMBER:
        raise MessageError(f"{name}: got {_short(value)}, wanted at most {LARGEST_NUMBER:g} in size")
    return float(value)


def _positive(name: str, value: Any) -> float:
    number = _float(name, value)
    if number <= 0.0:
        raise MessageError(f"{name}: got {_short(value)}, wanted a number above 0")
    return number


def _boolean(name: str, value: Any) -> bool:
    if type(value) is not bool:
        raise MessageError(f"{name}: got {_short(value)}, wanted true or false")
    return value


def _string(name: str, value: Any) -> str:
    if type(value) is not str:
        raise MessageError(f"{name}: got {_short(value)}, wanted text")
    return value


def _tuple_of(check: _Check) -> _Check:
    def checked(name: str, value: Any) -> tuple[Any, ...]:
        if type(value) is not tuple:
            raise MessageError(f"{name}: got {_short(value)}, wanted a list")
        return tuple(check(name, entry) for entry in value)

    return checked


def _vector(name: str, value: Any) -> tuple[float, ...]:
    """Fast path for a tuple of valid floats; otherwise checks entry by entry, for the error message."""
    if type(value) is tuple and _all_ordinary(value):
        return value
    checked: tuple[float, ...] = _floats(name, value)
    return checked


def _rows(name: str, value: Any) -> tuple[tuple[float, ...], ...]:
    """Fast path for valid entries in all rows; otherwise checks row by row."""
    if type(value) is tuple and {*map(type, value)} <= _TUPLE and _all_ordinary(tuple(chain.from_iterable(value))):
        return value
    checked: tuple[tuple[float, ...], ...] = _vectors(name, value)
    return checked


def _all_ordinary(values: tuple[Any, ...]) -> bool:
    """Whether all values are floats with a Euclidean norm of at most LARGEST_NUMBER."""
    # The norm bounds the magnitude of each entry. hypot is NaN or infinite if an entry is, and the comparison fails.
    return {*map(type, values)} <= _FLOAT and math.hypot(*values) <= LARGEST_NUMBER


_FLOAT, _TUPLE = {float}, {tuple}
_floats = _tuple_of(_float)
_vectors = _tuple_of(_vector)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."


_CHECKS: dict[str, _Check] = {
    "int": _integer,
    "Count": _integer,
    "float": _float,
    "Number": _float,
    "Positive": _positive,
    "bool": _boolean,
    "str": _string,
    "Vector": _vector,
    "Rows": _rows,
    "tuple[str, ...]": _tuple_of(_string),
}

_NAMES: dict[type[Any], tuple[str, ...]] = {kind: tuple(field.name for field in fields(kind)) for kind in LARGEST_BYTES}
_FIELDS: dict[type[Any], tuple[tuple[str, str, _Check, bool], ...]] = {
    kind: tuple(
        (field.name, f"{kind.__name__}.{field.name}", _CHECKS[str(field.type)], field.default is not MISSING)
        for field in fields(kind)
    )
    for kind in LARGEST_BYTES
}
# msgspec compiles one decoder per type, which checks types and ranges of the fields in C. Building them here, once,
# keeps that cost out of the loop.
_READERS: dict[type[Any], Callable[[bytes], Any]] = {
    **{topic.message: msgspec.msgpack.Decoder(topic.message).decode for topic in TOPICS.values()},
    **{kind: msgspec.msgpack.Decoder(kind).decode for kind in (Request, Answer)},
}
_pack = msgspec.msgpack.Encoder().encode
