"""The page of ``safedpa experiment margins``: what the margins are, what they cover, what they cost."""

from __future__ import annotations

from typing import Any

__all__ = ["margins_page"]

_NAMES = {"conformal": "step", "drive": "drive", "shipped": "shipped"}


def margins_page(result: dict[str, Any], command: str, date: str) -> str:
    """Markdown tables of a result, without those of robots that are not done."""
    lines = [f"Made by `{command}`, {date}; coverage {100 * result['coverage']:g} %; intervals: 95 %.", ""]
    for table in (_coverage(result), _driving(result), _layer(result)):
        lines += [*table, ""]
    return "\n".join(lines).rstrip() + "\n"


def _coverage(result: dict[str, Any]) -> list[str]:
    lines = [
        "| robot | barrier | margin of a | epsilon | steps covered, % | drives covered, % | fresh drives (near) |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, kind, fresh in _fresh(result):
        for barrier, counted in fresh["covered"].items():
            if kind not in counted:  # nothing shipped that covers this one
                continue
            one = counted[kind]
            steps = _share(one["steps"], one["steps_95"])
            lines.append(
                f"| {name} | {barrier} | {_NAMES[kind]} | {one['epsilon']:.4f} | {steps} "
                f"| {_share(one['drives'], one['drives_95'])} | {counted['drives']} ({counted['drives_near']}) |"
            )
    return lines


def _driving(result: dict[str, Any]) -> list[str]:
    lines = [
        "| robot | margin of a | goals a minute | collisions | least h | verdicts |",
        "|---|---|---|---|---|---|",
    ]
    for name, kind, fresh in _fresh(result):
        mean, low, high = fresh["goals_a_minute"]
        statuses = ", ".join(f"{status} {count}" for status, count in fresh["statuses"].items())
        lines.append(
            f"| {name} | {_NAMES[kind]} | {mean:.2f} ({low:.2f} to {high:.2f}) | {fresh['collisions']} "
            f"| {fresh['least_h']:.4f} | {statuses} |"
        )
    return lines


def _layer(result: dict[str, Any]) -> list[str]:
    lines = [
        "| robot | barrier | margin of a | depth of the boundary layer | stays in it | longest, s | h fell by at most "
        "| errors of one stay | least rise promised |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, kind, fresh in _fresh(result):
        for barrier, of in fresh.get("layer", {}).items():
            lines.append(
                f"| {name} | {barrier} | {_NAMES[kind]} | {of['depth']:.4f} | {of['stays']} "
                f"| {of['longest_seconds']:.2f} | {of['fall']:.4f} | {of['errors']:.4f} | {of['least_rise']:.4f} |"
            )
    return lines


def _fresh(result: dict[str, Any]) -> list[tuple[str, str, dict[str, Any]]]:
    rows = result["robots"].items()
    return [(name, kind, row[f"fresh_{kind}"]) for name, row in rows for kind in _NAMES if f"fresh_{kind}" in row]


def _share(share: float, interval: list[float]) -> str:
    return f"{100 * share:.2f} ({100 * interval[0]:.2f} to {100 * interval[1]:.2f})"
