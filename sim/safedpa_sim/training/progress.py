"""The progress callback of a training run and the record that it writes to its output folder."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from safedpa.errors import InputError
from safedpa.records.writers.tables import atomic_path

ReportProgress = Callable[[str, int, int, str], None]
"""report_progress(phase, done, total, note); the note is a short text such as the loss."""

RECORD = "progress.json"


def silent(phase: str, done: int, total: int, note: str) -> None:
    """Discards the progress report."""
    del phase, done, total, note


def read_record(folder: Path) -> dict[str, Any]:
    """Returns the training record of a folder by stage name; empty if the folder has no record.

    Raises InputError when the file was not written by ``write_record``.
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
    """Replaces the record of a folder atomically."""
    with atomic_path(folder / RECORD) as unfinished:
        unfinished.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
