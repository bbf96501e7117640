"""Drives that are kept in a file, a line each, so that a long experiment goes on where it was cut off."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

from safedpa.errors import InputError
from safedpa_lab.experiments.car_workers import Workers
from safedpa_lab.provenance.code import digests

__all__ = ["check_record", "driven"]

Order = TypeVar("Order")
"""A frozen dataclass of plain values; what comes out of its drive holds its fields."""
Outcome = dict[str, Any]


def driven(
    run: Callable[[Order], Outcome],
    wanted: Sequence[Order],
    processes: int,
    on_drive: Callable[[int, int], None] = lambda _done, _all: None,
    record: Path | None = None,
) -> list[Outcome]:
    """What came out of each drive, in order; one that is wanted twice is driven once.

    Drives that ``record`` holds are not driven again, and those that are driven are added to it. Raises InputError
    for a file that is no such record, or one that other code than today's made.
    """
    different = dict.fromkeys(wanted)
    retained = {} if record is None or not wanted else _recorded(record, type(wanted[0]), run.__module__)
    found = {order: retained[order] for order in different if order in retained}
    missing = [order for order in different if order not in retained]
    with Workers(processes) as workers:
        for order, outcome in zip(missing, workers.map(run, missing), strict=True):
            found[order] = outcome
            if record is not None:
                with record.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(outcome) + "\n")
            on_drive(len(found), len(different))
    return [found[order] for order in wanted]


def check_record(record: Path | None, kind: type[Any], run: Callable[[Any], Outcome]) -> None:
    """Begins the record, or finds that it can be gone on with, before other long work. Raises InputError as above."""
    if record is not None:
        _recorded(record, kind, run.__module__)


def _recorded(path: Path, kind: Any, module: str) -> dict[Any, Outcome]:
    """The drives that a file holds; it is begun where there is none. Its first line is the code they were made by."""
    code = digests(module)
    try:
        if not path.exists():
            path.write_text(json.dumps({"code": code}) + "\n", encoding="utf-8")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be kept as a record ({error}); wanted a file that can be written") from error
    whole = text[: text.rfind("\n") + 1] or text  # what was killed while it wrote leaves part of a line
    try:
        first, *lines = map(json.loads, whole.splitlines())
        by = first["code"]
        drives = {kind(**{item.name: one[item.name] for item in fields(kind)}): one for one in lines}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: got no record of such drives ({error}), wanted a new file, or one that was"
        ) from error
    if by != code:
        raise InputError(f"{path}: its drives were made by other code than today's; wanted another file")
    if whole != text:
        path.write_text(whole, encoding="utf-8")
    return drives
