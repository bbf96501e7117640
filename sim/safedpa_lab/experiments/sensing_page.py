"""The page of a result of ``safedpa experiment sensing``: one line a scene and guard."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

__all__ = ["page_of"]

_GUARDS = {
    "safedpa": "this filter, laser alone",
    "reported": "this filter, told everything",
    "told-but-hiding": "this filter, told everything but who hides",
    "monitor": "nav2's collision monitor, its defaults (1.2 s, 6 points)",
    "monitor-2s": "the same with 2 s, 3 points",
    "time-to-collision": "time to collision below 0.8 s (F1TENTH course)",
    "nothing": "nothing",
}


def page_of(result: Mapping[str, Any], title: str = "Drives with a laser") -> str:
    """Markdown with a table of all rows, and the command that made it."""
    seeds, made = result["seeds"], result.get("provenance", {})
    lines = [
        f"# {title}",
        "",
        f"Seeds {seeds[0]} to {seeds[-1]}, loads {', '.join(result['loads'])}, {result['seconds']:g} s each, "
        f"controller {result.get('policy', 'goal_seeker')}. "
        "A collision is the car's where it was at 0.1 m/s or more.",
        "",
        f"`{made.get('command')}`, {str(made.get('date'))[:10]}",
        "",
        "| scene | behind | drives | car moved into something | 95 % of it | touched while it stood | goals a minute "
        "| of those of who is told everything | m a minute |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [_line(row) for row in result["rows"]]
    elsewhere = sum(row["of_them_it_did_not_drive_towards"] for row in result["rows"])
    hit = [f"- {row['scene']}, {row['guard']}: {what}" for row in result["rows"] for what in row["which"]]
    lines += _by_load(result.get("by_load", ()), result["loads"])
    return "\n".join([*lines, *(["", f"Into what ({_elsewhere(elsewhere)}):", "", *hit] if hit else []), ""])


def _elsewhere(contacts: int) -> str:
    return f"in {contacts} of these car or load did not drive towards it, at less than 0.1 m/s: it came to them"


def _by_load(found: Sequence[Mapping[str, Any]], loads: Sequence[str]) -> list[str]:
    """A table of the goals with each load, where there are several."""
    if len(loads) < 2 or not found:
        return []
    goals = {(one["scene"], one["guard"], one["load"]): f"{one['goals_a_minute']:.1f}" for one in found}
    kinds = dict.fromkeys((one["scene"], one["guard"]) for one in found)
    rows = [
        f"| {kind[0]} | {_GUARDS[kind[1]]} | {' | '.join(goals[(*kind, load)] for load in loads)} |" for kind in kinds
    ]
    head = f"| scene | behind | {' | '.join(loads)} |"
    return ["", "Goals a minute by load:", "", head, "|---|---|" + "---|" * len(loads), *rows]


def _line(row: Mapping[str, Any]) -> str:
    low, high = row["share_95"]
    alongside = row["goals_beside_perfect_knowledge"]
    ratio = "" if alongside is None else f"{alongside[0]:.2f} ({alongside[1]:.2f} to {alongside[2]:.2f})"
    cells = (
        row["scene"],
        _GUARDS[row["guard"]],
        f"{row['drives']}",
        f"{row['drives_in_which_the_car_moved_into_something']}",
        f"{100.0 * low:.1f} to {100.0 * high:.1f} %",
        f"{row['touched_while_it_stood']}",
        f"{row['goals_a_minute']:.1f}",
        ratio,
        f"{row['metres_a_minute']:.0f}",
    )
    return f"| {' | '.join(cells)} |"
