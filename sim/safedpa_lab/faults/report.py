"""The outcome of a campaign as JSON and as a page of tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

__all__ = ["markdown_of"]

_KINDS_HEAD = "| kind | faults | held | braked by robot, by filter | drives again after s | all back after s |"
_HEAD = (
    "| fault | what happened | held | speed m/s | collisions | stale actions | periods | watchdog | fallback "
    "| drives again after s | all back after s | not recorded: states, verdicts |"
)


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
        _KINDS_HEAD,
        "|---|---|---|---|---|---|",
        *(_kind_line(kind, of_kind) for kind, of_kind in _kinds(rows).items()),
        "",
        "Times count from the recovery. 0.00: the loop had not stopped, but for at most two periods in a row.",
        "",
        *(_resources(result["resources"]) if result.get("resources") else _each(rows)),
        "",
    ]
    broken = [f"- {row['name']}: {'; '.join(row['broken'])}" for row in rows if not row["held"]]
    return "\n".join([*lines, *(["What did not hold:", "", *broken, ""] if broken else [])])


def _each(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """One row a fault."""
    return [_HEAD, "|" + "---|" * _HEAD.count(" | ") + "---|", *(_line(row) for row in rows)]


def _resources(resources: Sequence[Mapping[str, Any]]) -> list[str]:
    """Of a long run, in which each fault comes again and again: one row a process instead."""
    lines = [
        "What its processes held in the first and in the last quarter of the time, older than half a minute:",
        "",
        "| process | lives | the longest, s | resident MiB, median | open files, most | threads, most | |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in resources:
        cells = [f"{row[name][0]} to {row[name][1]}" for name in ("mib", "handles", "threads")]
        reported = "flat" if row["flat"] else "**grew**"
        life = f"{row['processes']} | {row['longest_life_seconds']:.0f}"
        lines.append(f"| {row['name']} | {life} | {' | '.join(cells)} | {reported} |")
    return lines


def _kinds(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """By the first word of the name, up to a hyphen's moment: ``change-ready policy`` is a ``change``."""
    kinds: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        word = row["name"].split()[0]
        kinds.setdefault("change" if word.startswith("change-") else word, []).append(row)
    return kinds


def _kind_line(kind: str, rows: Sequence[Mapping[str, Any]]) -> str:
    periods = sum(row["periods"] for row in rows)
    braked = ", ".join(f"{sum(row[name] for row in rows) / max(periods, 1):.0%}" for name in ("watchdog", "fallbacks"))
    drives, back = (_range([row[name] for row in rows]) for name in ("recovery_seconds", "whole_seconds"))
    return f"| {kind} | {len(rows)} | {sum(row['held'] for row in rows)} | {braked} | {drives} | {back} |"


def _range(seconds: Sequence[float | None]) -> str:
    known = [value for value in seconds if value is not None]
    reported = f"{min(known):.2f} to {max(known):.2f}" if len(known) > 1 else _seconds(known[0] if known else None)
    return reported if len(known) == len(seconds) else f"{reported}, {len(seconds) - len(known)} never"


def _line(row: Mapping[str, Any]) -> str:
    cells = [row["name"], row["sentence"], "yes" if row["held"] else "**no**", f"{row['speed']:.2f}"]
    cells += [str(row[name]) for name in ("collisions", "stale_actions", "periods", "watchdog", "fallbacks")]
    cells += [_seconds(row["recovery_seconds"]), _seconds(row["whole_seconds"])]
    cells.append(f"{row['states_not_recorded']}, {row['verdicts_not_recorded']}")
    return "| " + " | ".join(cells) + " |"


def _seconds(value: float | None) -> str:
    return "never" if value is None else f"{value:.2f}"
