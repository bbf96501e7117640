"""Orders to perception on disk, so that perception that is started again still knows them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from safedpa.disk import why_not_written, write_through
from safedpa.errors import InputError
from safedpa.limits import parse_json, text_of_file

__all__ = ["EVERY_SOURCE", "Ordered", "keep_in", "kept_in"]

Ordered = Mapping[str, Mapping[tuple[str, str], bool]]
"""By robot (``-``: each), then by ``source`` or ``zone`` and its name: whether it counts."""
EVERY_SOURCE: Final = ("source", "*")
_FORMAT = 1


def kept_in(path: Path) -> tuple[dict[str, dict[tuple[str, str], bool]], str]:
    """The orders in a file, none where there is none; and why they cannot be read, or nothing.

    Orders that were lost might have closed a zone or left out a source that tells lies: where they cannot be read, no
    source of any robot counts until a person orders it on, and the filter brakes.
    """
    try:
        return _parsed(parse_json(text_of_file(path, "json_bytes"))), ""
    except FileNotFoundError:
        return {}, ""
    except (OSError, UnicodeDecodeError, InputError, AttributeError, ValueError, TypeError) as error:
        why = str(error) if isinstance(error, InputError) else type(error).__name__
        return {"-": {EVERY_SOURCE: False}}, f"the orders in {path} cannot be read ({why})"


def _parsed(table: Any) -> dict[str, dict[tuple[str, str], bool]]:
    if table.get("format") != _FORMAT or not isinstance(table.get("switches"), dict):
        raise InputError(f"holds no switches of format {_FORMAT}")
    found: dict[str, dict[tuple[str, str], bool]] = {}
    for robot, switches in table["switches"].items():
        for text, counts in switches.items():
            what, _, name = text.partition(" ")
            if what not in ("source", "zone") or not name or not isinstance(counts, bool):
                raise InputError(f"'{text}': wanted 'source NAME' or 'zone NAME', and true or false")
            found.setdefault(robot, {})[what, name] = counts
    return found


def keep_in(path: Path, ordered: Ordered) -> str:
    """Puts the orders on the disk before it returns; what went wrong, or nothing."""
    named = {robot: {" ".join(key): counts for key, counts in own.items()} for robot, own in ordered.items()}
    switches = {robot: own for robot, own in named.items() if own}
    try:
        write_through(path, json.dumps({"format": _FORMAT, "switches": switches}))
    except OSError as error:
        return f"{path} cannot be written ({why_not_written(error)})"
    return ""
