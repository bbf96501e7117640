"""The outcome of a campaign as JSON and as a page of tables."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safedpa.errors import InputError

__all__ = ["markdown_of", "write_report"]

_HEAD = (
    "| fault | what happened | held | speed m/s | collisions | stale actions | periods | watchdog | fallback "
    "| drives again after s | all back after s | not recorded: states, verdicts |"
)


def write_report(result: Mapping[str, Any], folder: Path) -> None:
    """Writes faults.json and faults.md. Raises InputError when the folder cannot be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "faults.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
        (folder / "faults.md").write_text(markdown_of(result), encoding="utf-8")
    except OSError as error:
        raise InputError(f"--out {folder}: cannot be written ({error.strerror}); choose another folder") from error


def markdown_of(result: Mapping[str, Any]) -> str:
    """A headline, one row a fault, and what did not hold."""
    rows = result["rows"]
    held = sum(row["held"] for row in rows)
    lines = [
        "# Faults, measured",
        "",
        f"`{result['command']}`, {result['date']}, {result['seconds']:.0f} s, {result['cores']} cores; load of the "
        f"machine {result['load_before']:.1f} at the beginning, {result['load_after']:.1f} at the end.",
        "",
        f"**{held} of {len(rows)} held; {result['collisions']} collisions, {result['stale_actions']} stale actions in "
        f"{result['periods']} periods, those between the faults included.** The recorders "
        f"acknowledged {result['acknowledged']} messages; "
        f"{result['recorded']} can be read.",
        "",
        _HEAD,
        "|" + "---|" * _HEAD.count(" | ") + "---|",
        *(_line(row) for row in rows),
        "",
    ]
    broken = [f"- {row['name']}: {'; '.join(row['broken'])}" for row in rows if not row["held"]]
    return "\n".join([*lines, *(["What did not hold:", "", *broken, ""] if broken else [])])


def _line(row: Mapping[str, Any]) -> str:
    cells = [row["name"], row["sentence"], "yes" if row["held"] else "**no**", f"{row['speed']:.2f}"]
    cells += [str(row[name]) for name in ("collisions", "stale_actions", "periods", "watchdog", "fallbacks")]
    cells += [_seconds(row["recovery_seconds"]), _seconds(row["whole_seconds"])]
    cells.append(f"{row['states_not_recorded']}, {row['verdicts_not_recorded']}")
    return "| " + " | ".join(cells) + " |"


def _seconds(value: float | None) -> str:
    return "never" if value is None else f"{value:.2f}"
