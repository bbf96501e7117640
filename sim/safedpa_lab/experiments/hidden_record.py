"""The record of a hidden-effects experiment on disk: every case, so that an interrupted one goes on."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from datetime import UTC, datetime
from importlib.metadata import version
from math import isfinite
from pathlib import Path
from typing import Any

from safedpa.errors import InputError
from safedpa_lab.experiments.hidden_summary import summary
from safedpa_lab.hidden.judge import Found, Outcome
from safedpa_lab.provenance.record import write_result

__all__ = ["document_of", "read_outcomes", "write_document"]

_FORMAT = 1
_LISTS = ("hidden", "added", "wrong", "reported", "false_laws")
_PACKAGES = ("safedpa", "numpy", "pymunk")


def document_of(outcomes: Sequence[Outcome], seeds: Sequence[int], end: datetime | None = None) -> dict[str, Any]:
    """What was measured when and with what, the figures by suite and effect, and every case."""
    suites = tuple(dict.fromkeys(item.suite for item in outcomes))
    versions = {"python": platform.python_version(), **{name: version(name) for name in _PACKAGES}}
    return {
        "experiment": "hidden-effects",
        "format": _FORMAT,
        "seeds": sorted(set(seeds)),
        "date": (end or datetime.now(UTC)).isoformat(timespec="seconds"),
        "versions": versions,
        **summary(suites, outcomes),
        "cases": [_row(item) for item in outcomes],
    }


def _row(item: Outcome) -> dict[str, Any]:
    row = asdict(item)
    row["parameters"] = [{**asdict(found), "deviation": found.deviation} for found in item.parameters]
    row.update({name: list(row[name]) for name in _LISTS})
    plain = {name: None if isinstance(value, float) and not isfinite(value) else value for name, value in row.items()}
    return {**plain, "right": item.right}


def write_document(document: Mapping[str, Any], path: Path) -> None:
    """Writes the record whole or not at all: a reader never finds half of one."""
    write_result(path, document)


def read_outcomes(path: Path) -> tuple[list[Outcome], list[int]]:
    """The cases and seeds of a record, none of one that is not there yet. Raises InputError for another document."""
    if not path.exists():
        return [], []
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        if (document["experiment"], document.get("format")) != ("hidden-effects", _FORMAT):
            raise KeyError("format")
        return [_outcome(row) for row in document["cases"]], list(document["seeds"])
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: got something else than a record of this experiment ({error}); name a new file"
        ) from error


def _outcome(row: Mapping[str, Any]) -> Outcome:
    known = {field.name for field in fields(Outcome)}
    values = {name: value for name, value in row.items() if name in known}
    for name in _LISTS:
        values[name] = tuple(values.get(name, ()))
    for name in ("error", "error_ratio", "seconds", "processor_seconds"):
        values[name] = _number(values[name])
    values["parameters"] = tuple(
        Found(item["path"], *(_number(item[name]) for name in ("value", "std", "truth"))) for item in row["parameters"]
    )
    return Outcome(**values)


def _number(reported: float | None) -> float:
    """What was not finite stands as null."""
    return float("nan") if reported is None else float(reported)
