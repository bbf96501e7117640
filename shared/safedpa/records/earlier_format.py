"""Converts files and recordings of format 1 to the names of format 2. Only this module knows the earlier names.

Format 2 renamed keys and changed no value. The tables below list what was renamed. Recordings of format 1 are read
through them (``current_key``, ``current_payload``); ``migrate`` rewrites a file.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, Final

import msgpack

from safedpa.bus.messages.topics import TOPICS
from safedpa.errors import InputError
from safedpa.limits import parse_json, parse_toml, text_of_file
from safedpa.records.readers.own_process import in_own_process

__all__ = ["FORMAT", "current_key", "current_payload", "migrate", "without_removed_settings"]

FORMAT: Final = 2
"""The format that this version writes."""

_TOPICS: Final = {"wish": "nominal"}
"""Last part of a bus key."""

_FIELDS: Final[dict[str, dict[str, str]]] = {
    "state": {"reversed_way": "distance_reversed"},
    "surroundings": {"amiss": "problems"},
    "takeover": {"foretold": "expected_effect"},
    "verdict": {"wish": "nominal", "stands": "stationary_for", "standstill": "stationary_reason"},
}
"""Fields of a message, by topic."""

_SETTINGS: Final = {"plausible_wish": "plausible_nominal"}
_REMOVED_SETTINGS: Final = ("slack_tolerance", "slack_quadratic", "slack_linear")
"""Removed because the scale of each barrier now determines the tolerances."""

_SETTINGS_KEYS: Final = {"eta", "system", "action_low", "epsilon", "enabled", "margin", "weights", *_SETTINGS}
"""A file with one of these keys, and nothing of another kind, holds settings of the filter."""

_ROBOT_TABLES: Final = {"wish": "nominal"}
_MARGIN_PREFIXES: Final = {"ceiling.": "clip.", "drive.ceiling.": "drive.clip."}


def current_key(key: str) -> str:
    """Returns the present bus key for a key of either format: ``safedpa/f/r/wish`` is ``safedpa/f/r/nominal``."""
    head, _, topic = key.rpartition("/")
    return f"{head}/{_TOPICS[topic]}" if head and topic in _TOPICS else key


def current_payload(topic: str, payload: bytes) -> bytes:
    """Renames the fields of a recorded message of ``topic`` to those of format 2; returns anything else unchanged."""
    names = _FIELDS.get(topic, {})
    if len(payload) > TOPICS[topic].largest_bytes:
        return payload  # the decoder refuses it unparsed
    if topic not in ("setup", "model") and not any(name.encode() in payload for name in names):
        return payload  # most messages: nothing in them was renamed
    try:
        fields = msgpack.unpackb(payload)
    except (ValueError, msgpack.UnpackException):
        return payload  # the decoder reports what is wrong with it
    if not isinstance(fields, dict) or fields.get("version") != FORMAT - 1:
        return payload
    renamed = {names.get(name, name): value for name, value in fields.items()}
    renamed["version"] = FORMAT
    if topic == "setup":
        renamed["settings"] = _settings(_text(renamed.get("settings")))
    if topic in ("setup", "model"):
        renamed["margin"] = _margin_of_message(_text(renamed.get("margin")))
    packed: bytes = msgpack.packb(renamed)
    return packed


def without_removed_settings(text: str) -> tuple[str, list[str]]:
    """Removes keys that no longer exist from settings of the filter; also returns these keys."""
    removed = [key for key in _REMOVED_SETTINGS if re.search(rf"(?m)^[ \t]*{key}\s*=", text)]
    return re.sub(rf"(?m)^[ \t]*(?:{'|'.join(_REMOVED_SETTINGS)})\s*=.*\n?", "", text), removed


def _settings(text: str) -> str:
    for earlier, current in _SETTINGS.items():
        text = re.sub(rf"(?m)^([ \t]*){earlier}(\s*=)", rf"\1{current}\2", text)
    return _numbered(text)


def _margin(text: str) -> str:
    for earlier, current in _MARGIN_PREFIXES.items():
        text = re.sub(rf'(?m)^"{re.escape(earlier)}', f'"{current}', text)
    return _numbered(text)


def _margin_of_message(text: str) -> str:
    """Converts a margin as messages carry it, as JSON; what is none is returned unchanged."""
    try:
        document = parse_json(text)
        constants = {_clip_name(name): value for name, value in document["constants"].items()}
    except (ValueError, KeyError, TypeError, AttributeError, InputError):
        return text
    return json.dumps(document | {"constants": constants}, sort_keys=True)


def _clip_name(name: str) -> str:
    return next((new + name.removeprefix(old) for old, new in _MARGIN_PREFIXES.items() if name.startswith(old)), name)


def _robot_file(text: str) -> str:
    for earlier, current in _ROBOT_TABLES.items():
        text = re.sub(rf"(?m)^(\[{earlier})(\]|\.)", rf"[{current}\2", text)
    return _numbered(text)


def _numbered(text: str) -> str:
    return re.sub(r"(?m)^format(\s*)=(\s*)1\b", rf"format\1=\g<2>{FORMAT}", text)


def _text(value: Any) -> str:
    return value if isinstance(value, str) else ""


def migrate(path: Path, target: Path) -> str:
    """Writes a file of format 1 to ``target`` in format 2 and returns what kind of file it is.

    Filter settings, a robot's file, a margin and a recording are converted. Models and column maps are the same in
    both formats and are copied. Raises InputError for any other file, and if ``target`` exists.
    """
    if target.exists():
        raise InputError(f"{target}: exists already; name a file that does not")
    if path.suffix == ".mcap":
        _migrate_recording(path, target)
        return "recording"
    text = text_of_file(path, "toml_bytes")
    kind, converted = _converted(path, text)
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(converted, encoding="utf-8")
    return kind


def _converted(path: Path, text: str) -> tuple[str, str]:
    table = parse_toml(text)
    kind, converted = _converted_text(path, text, table)
    # The conversion edits text, so that comments stay; the parsed result must be the renamed table, nothing else.
    if parse_toml(converted) != _renamed(table, kind):
        raise InputError(
            f"{path}: a key of format 1 is written in an unusual way; write each key plainly on its own line"
        )
    return kind, converted


def _renamed(table: Any, kind: str) -> Any:
    """The parsed table in the names of today."""
    if kind in ("model", "column map"):
        return table
    found = {key: value for key, value in table.items() if kind != "settings" or key not in _REMOVED_SETTINGS}
    if "format" in found:
        found["format"] = FORMAT
    if kind == "margin":
        found["constants"] = {
            next(
                (new + key.removeprefix(old) for old, new in _MARGIN_PREFIXES.items() if key.startswith(old)), key
            ): value
            for key, value in table.get("constants", {}).items()
        }
        return found if "constants" in table else {key: found[key] for key in table}
    names = _SETTINGS if kind == "settings" else _ROBOT_TABLES
    return {names.get(key, key): value for key, value in found.items()}


def _converted_text(path: Path, text: str, table: dict[str, Any]) -> tuple[str, str]:
    if "base" in table:
        return "model", text
    if "columns" in table:
        return "column map", text
    if "epsilon" in table and "transitions" in table:
        return "margin", _margin(text)
    if "robot" in table:
        return "robot file", _robot_file(text)
    if not _SETTINGS_KEYS.intersection(table):
        raise InputError(
            f"{path}: no settings, model, column map, margin or robot file of format 1; wanted one of these"
        )
    converted, _ = without_removed_settings(_settings(text))
    return "settings", converted


@in_own_process
def _migrate_recording(path: Path, target: Path) -> None:
    from mcap.records import Channel, Message, Metadata

    from safedpa.bus.messages.topics import topic_of
    from safedpa.records.readers.mcap_recovery import DamageError, records_of
    from safedpa.records.writers.mcap import McapRecorder

    keys: dict[int, str] = {}
    recorder: McapRecorder | None = None
    about: dict[str, str] = {}
    try:
        for record in records_of(path):
            if isinstance(record, Metadata) and record.name == "safedpa":
                about = dict(record.metadata)
            elif isinstance(record, Channel) and record.message_encoding == "msgpack":
                keys[record.id] = current_key(record.topic)
            elif isinstance(record, Message) and (key := keys.get(record.channel_id)):
                recorder = recorder or McapRecorder(target, {**about, "format": str(FORMAT)})
                payload = current_payload(topic_of(key)[2].name, record.data)
                recorder.write(key, payload, record.log_time, record.publish_time)
    except DamageError as damage:
        raise InputError(
            f"{path}: damaged at byte {damage.offset} of {damage.size}; everything before it is converted"
        ) from damage
    finally:
        if recorder is not None:
            recorder.close()
    if recorder is None:
        raise InputError(f"{path}: contains no message of the bus; wanted a recording of safedpa")
