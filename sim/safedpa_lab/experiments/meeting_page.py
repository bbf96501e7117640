"""The page of a result of ``safedpa experiment meeting``: one line for each number of cars and guard."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

__all__ = ["page_of"]

_GUARDS = {
    "safedpa": "this filter, laser alone",
    "reported": "this filter, told where all are",
    "nothing": "no filter, the same controller",
}


def page_of(result: Mapping[str, Any], title: str = "Several cars on one field") -> str:
    """Markdown with a table of all rows, and the command that made it."""
    seeds, made = result["seeds"], result.get("provenance", {})
    lines = [
        f"# {title}",
        "",
        f"Seeds {seeds[0]} to {seeds[-1]}, loads {', '.join(result['loads'])}, {result['seconds']:g} s each, 8 m by 8 "
        f"m with six pillars; reckoned with for all that moves: {result['fastest']:g} m/s. A contact of two cars "
        "counts once; a car moves at 0.1 m/s or more. Stuck: neither of two cars within 1.5 m of each other got 0.2 m "
        "farther in the last 8 s.",
        "",
        f"`{made.get('command')}`, {str(made.get('date'))[:10]}",
        "",
        "| cars | behind | drives | with a contact in which a car moved | 95 % of it | such contacts, of them with a "
        "standing car | contacts of standing cars | moved into pillar or wall | goals a minute and car | cars without "
        "a goal | share of time standing | pairs stuck, of them face to face |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [_line(row) for row in result["rows"]]
    hit = [f"- {row['robots']} cars, {row['guard']}: {what}" for row in result["rows"] for what in row["which"]]
    return "\n".join([*lines, *(["", "Which:", "", *hit] if hit else []), ""])


def _line(row: Mapping[str, Any]) -> str:
    low, high = row["share_95"]
    cells = (
        f"{row['robots']}",
        _GUARDS[row["guard"]],
        f"{row['drives']}",
        f"{row['drives_in_which_a_moving_car_touched_another']}",
        f"{100.0 * low:.1f} to {100.0 * high:.1f} %",
        f"{row['contacts_in_which_a_car_moved']}, {row['of_them_with_a_standing_car']}",
        f"{row['contacts_of_standing_cars']}",
        f"{row['moved_into_what_is_at_rest']}",
        f"{row['goals_a_minute_and_robot']:.1f}",
        f"{row['robots_without_a_goal']} of {row['drives'] * row['robots']}",
        f"{row['share_of_time_standing']:.2f}",
        f"{row['stuck_pairs']}, {row['stuck_face_to_face']}",
    )
    return f"| {' | '.join(cells)} |"
