"""Candidates of a running diagnosis as cards, from the report that it sent and the names that it accepts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from safedpa.diagnosis.report import Candidate, Value
from safedpa_services.workbench.evidence import Card, card_of

__all__ = ["live_cards"]


def live_cards(robot: str, report: dict[str, Any] | None, accepted: Sequence[str]) -> tuple[list[Card], str]:
    """Cards of the effects that can be accepted, best first, and the experiment that is proposed.

    ``robot`` is the kind of robot. What the report says in a way that cannot be read is left out; an effect without a
    readable entry has a card with its name alone.
    """
    entries: dict[str, Candidate] = {}
    before = 0.0
    if report is not None:
        before = _number(_first(report.get("stages")).get("heldout_error"))
        for entry in report["candidates"]:
            candidate = _candidate(entry)
            if candidate is not None and candidate.stage == 0:
                entries.setdefault(candidate.effect, candidate)
    cards = [card_of(robot, entries.get(name) or _bare(name), before, None, {}) for name in accepted]
    return cards, _experiment({} if report is None else report)


def _experiment(report: dict[str, Any]) -> str:
    entry = report.get("next_experiment")
    if not isinstance(entry, dict) or not entry.get("manoeuvre"):
        return ""
    return f"Next experiment: {entry['manoeuvre']}; {entry.get('why', '')}."


def _candidate(entry: Any) -> Candidate | None:
    try:
        values = {
            str(name): Value(_number(item["value"]), _optional(item.get("std")), str(item.get("unit", "1")))
            for name, item in entry["parameters"].items()
        }
        return Candidate(
            stage=int(entry["stage"]),
            effect=str(entry["effect"]),
            parameters=values,
            heldout_error=_optional(entry["heldout_error"]),
            score=_optional(entry["score"]),
            indistinguishable_from=tuple(map(str, entry["indistinguishable_from"])),
            decision=entry["decision"] if entry["decision"] in ("accepted", "suspected") else "rejected",
            reason=str(entry["reason"]),
        )
    except (KeyError, TypeError, ValueError, AttributeError):
        return None


def _bare(name: str) -> Candidate:
    return Candidate(0, name, {}, None, None, (), "suspected", "")


def _first(entries: Any) -> dict[str, Any]:
    return entries[0] if isinstance(entries, list) and entries and isinstance(entries[0], dict) else {}


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else 0.0


def _optional(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) else None
