"""What a long training tells while it runs, and what it leaves behind."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from safedpa.errors import InputError
from safedpa.records.writers.tables import atomic_path

__all__ = ["RECORD", "ReportProgress", "read_record", "silent", "write_record"]

ReportProgress = Callable[[str, int, int, str], None]
"""tell(phase, done, everything, note): the note is a few words, such as the loss."""

RECORD = "progress.json"


def silent(phase: str, done: int, everything: int, note: str) -> None:
    """Tells no one."""
    del phase, done, everything, note


def read_record(folder: Path) -> dict[str, Any]:
    """What was trained into a folder, by phase; nothing where there is no record.

    Raises InputError when the file is not what ``write_record`` writes.
    """
    path = folder / RECORD
    if not path.exists():
        return {}
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); remove it to train again") from error
    if not isinstance(record, dict):
        raise InputError(f"{path}: got {type(record).__name__}, wanted a table of phases; remove it to train again")
    return record


def write_record(folder: Path, record: dict[str, Any]) -> None:
    """Replaces the record of a folder, whole or not at all."""
    with atomic_path(folder / RECORD) as unfinished:
        unfinished.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
