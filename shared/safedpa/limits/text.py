"""Foreign text: parses TOML and JSON after a check of their size and nesting, in one pass of linear time.

Checks keys, numbers and offered models, and makes foreign names and sentences safe to show in a terminal, a log or a
web page.
"""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Collection, Iterable
from functools import lru_cache
from typing import Any

from safedpa.errors import InputError, did_you_mean, escaped
from safedpa.limits.table import limit, too_much

_TOML = r"[\"'#\[\]{}.\n=,]"
_OPENING, _CLOSING = frozenset("[{"), frozenset("]}")


def parse_toml(text: str) -> dict[str, Any]:
    """Parses TOML; raises LimitError for a passed limit and InputError (``not TOML``) for invalid text.

    Limited are bytes and, outside of strings and comments, nesting, parts of a dotted key and digits of a number.
    """
    _check_bytes(text, "toml_bytes")
    _measure_toml(text)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # TOMLDecodeError and too many digits are ValueErrors
        raise InputError(f"not TOML: {_error_text(error)}") from error


def parse_json(text: str | bytes) -> Any:
    """Parses JSON; raises LimitError for a passed limit and InputError (``not JSON``) for invalid text."""
    if isinstance(text, bytes):
        if len(text) > limit("json_bytes"):
            raise too_much("json_bytes", f"{len(text)} bytes")
        try:
            text = text.decode()
        except UnicodeDecodeError as error:
            raise InputError(f"not JSON: {_error_text(error)}") from error
    _check_bytes(text, "json_bytes")
    _measure_json(text)
    try:
        return json.loads(text, parse_int=_integer)
    except (ValueError, RecursionError) as error:
        raise InputError(f"not JSON: {_error_text(error)}") from error


def refuse_unknown(
    table: Iterable[str], known: Collection[str], prefix: str = "", error: type[InputError] = InputError
) -> None:
    """Raises ``error`` for the first key of a table that is not ``known``; ``prefix`` is put before its name."""
    for key in table:
        if key not in known:
            raise error(f"{prefix}{key}: unknown key; {did_you_mean(key, known)}")


def _check_bytes(text: str, name: str) -> None:
    most = limit(name)
    if len(text) > most or (4 * len(text) > most and len(text.encode(errors="replace")) > most):
        raise too_much(name, f"{len(text)} characters, in at least as many bytes")


def _measure_toml(text: str) -> None:
    most_depth, most_dots, signs = limit("toml_depth"), limit("toml_dots"), _signs(limit("digits"))
    at = depth = dots = 0
    while (found := signs.search(text, at)) is not None:
        sign, at = found[0], found.end()
        if sign in "\"'":
            at = _after_string(text, found.start(), sign)
        elif sign == "#":
            at = text.find("\n", at)
            if at < 0:
                return
        elif sign in _OPENING:
            depth, dots = depth + 1, 0
            if depth > most_depth:
                raise too_much("toml_depth", f"more than {most_depth}")
        elif sign in _CLOSING:
            depth, dots = max(0, depth - 1), 0
        elif sign == ".":
            dots += 1
            if dots >= most_dots:
                raise too_much("toml_dots", f"more than {most_dots}")
        elif sign in "\n=,":
            dots = 0
        else:
            raise too_much("digits", f"more than {limit('digits')}")


@lru_cache(maxsize=8)
def _signs(digits: int) -> re.Pattern[str]:
    """Pattern of the characters to count, and of a number with too many digits (TOML allows underscores in them)."""
    return re.compile(rf"{_TOML}|[0-9_]{{{digits + 1}}}")


def _after_string(text: str, start: int, quote: str) -> int:
    """Returns the position after the string that begins at ``start``; raises InputError if it does not end."""
    if text.startswith(quote * 3, start):
        mark, at = quote * 3, start + 3
    else:
        mark, at = quote, start + 1
    while True:
        end = text.find(mark, at)
        line = text.find("\n", at, end) if len(mark) == 1 and end >= 0 else -1
        if end < 0 or line >= 0:
            raise InputError("not TOML: a string does not end")
        escapes = 0
        while quote == '"' and end - 1 - escapes >= at and text[end - 1 - escapes] == "\\":
            escapes += 1
        if escapes % 2 == 0:
            end += len(mark)
            while len(mark) == 3 and text.startswith(quote, end):  # up to two more quotes belong to the string
                end += 1
            return end
        at = end + 1


def _measure_json(text: str) -> None:
    most, depth = limit("json_depth"), 0
    for sign in _NOT_BRACKETS.sub("", text):
        depth += 1 if sign in "[{" else -1
        if depth > most:
            raise too_much("json_depth", f"more than {most}")


_NOT_BRACKETS = re.compile(r'"[^"\\]*+(?:\\.[^"\\]*+)*+(?:"|\\?\Z)|[^\[\]{}"]++', re.DOTALL)
"""Matches everything but brackets: strings, also an unterminated one, and all other characters."""


def _integer(text: str) -> int:
    if len(text) > limit("digits"):
        raise too_much("digits", len(text))
    return int(text)


def _error_text(error: Exception) -> str:
    return "brackets too deep" if isinstance(error, RecursionError) else " ".join(str(error).split())[:200]


def finite_number(key: str, value: Any, wanted: str = "a finite number", error: type[InputError] = InputError) -> float:
    """Returns a finite number as a float; raises ``error`` naming ``key`` for anything else, including booleans."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise error(f"{key}: got {value!r}, wanted {wanted}")
    return float(value)


def whole_number(key: str, value: Any, wanted: str = "a whole number", error: type[InputError] = InputError) -> int:
    """Returns an int; raises ``error`` naming ``key`` for anything else, including booleans."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise error(f"{key}: got {value!r}, wanted {wanted}")
    return value


def readable(text: str, longest: int | None = None) -> str:
    r"""Returns the text with every unprintable character escaped as ``\xNN`` or ``\uNNNN``.

    Unprintable are control, format and unassigned characters, and all spaces but the ordinary one: they can move,
    colour, hide or reorder text. A text longer than ``longest`` characters (default: the limit ``name_letters``) is
    cut, with a note of its length.
    """
    most = limit("name_letters") if longest is None else longest
    shown = escaped(text[:most])
    return shown if len(text) <= most else f"{shown}... ({len(text)} characters)"


def printable(text: str, but: str = "", also: str = "") -> str:
    """Replaces each unprintable character, and each of ``but``, by ``?``; keeps those of ``also``. The length stays."""
    return "".join(sign if (sign.isprintable() or sign in also) and sign not in but else "?" for sign in text)


_NAME = r"[A-Za-z_][A-Za-z0-9_]{0,63}"
_NUMBER = r"[-+]?[0-9.][0-9.eE+-]{0,39}|[-+]?inf|[-+]?nan|true|false"
_TEXT = r"""\"[^"\\\x00-\x1f]{0,200}"|'[^'\x00-\x1f]{0,200}'"""
_INLINE_TABLE = r"\{[^{}\[\]]{0,300}\}"
"""An inline table such as ``{ value = 0.3, free = true }``."""
_STATEMENT = rf"\[\[?{_NAME}\]?\]|{_NAME}[ \t]*+=[ \t]*+(?:{_NUMBER}|{_TEXT}|{_INLINE_TABLE})"
_LINE = re.compile(rf"[ \t]*+(?:{_STATEMENT})?[ \t]*+(?:#.{{0,400}})?\r?")


def check_plain_model(document: str) -> None:
    """Checks that each line of an offered model has a form that we write: the parser then needs a bounded time.

    Raises LimitError if the document is too large, and InputError that names the first line of another form.
    """
    if len(document) > limit("offer_bytes"):
        raise too_much("offer_bytes", f"{len(document)} characters")
    lines = document.split("\n")
    if len(lines) > limit("offer_lines"):
        raise too_much("offer_lines", len(lines))
    for number, line in enumerate(lines, 1):
        if _LINE.fullmatch(line) is None:
            raise InputError(
                f"not TOML as this program writes models: line {number}; wanted 'name = value' or a table's name, no "
                "dotted keys and no lists; write it by the diagnosis or with 'safedpa add'"
            )
