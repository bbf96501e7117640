"""Parses TOML and JSON after a check of their size and nesting, in one pass of linear time."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Collection, Iterable
from functools import lru_cache
from typing import Any

from safedpa.errors import InputError, did_you_mean
from safedpa.limits.table import limit, too_much

__all__ = ["parse_json", "parse_toml", "refuse_unknown"]

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
