"""The page of a result of ``safedpa experiment sensing-margins``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

__all__ = ["margins_page"]

_KINDS: Final = {
    "obstacle": "at rest",
    "mover": "people seen",
    "hidden": "people hidden",
    "model": "the model alone",
    "stood": "people who have stood since they were seen",
}
_MARGINS: Final = {"step": "step", "drive": "drive", "in force": "in force"}


def margins_page(result: Mapping[str, Any]) -> str:
    """Markdown: the errors, what margins they make and cover, and the worst of them; and the command that made it."""
    made, seeds = result.get("provenance", {}), result["seeds"]
    used, fresh = (" to ".join(map(str, seeds[name])) for name in ("calibration", "evaluation"))
    lines = [
        "# Margins of what a laser tells",
        "",
        f"Scenes {', '.join(result['scenes'])}, loads {', '.join(result['loads'])} in turn, {result['seconds']:g} s a "
        f"drive, odometry wrong by up to {100.0 * result['odometry']:g} %; seeds {used} to calibrate, {fresh} to "
        "count. Errors in m of h: above 0 where what is told is farther away than what is there. Steps count in which "
        f"the car moves and h of what is there is below {result['near']['obstacle']:g} m, of people "
        f"{result['near']['mover']:g} m. Coverage {100.0 * result['coverage']:g} %; intervals: 95 %.",
        "",
        f"`{made.get('command')}`, {str(made.get('date'))[:10]}",
        "",
        "| error of | steps (drives) | median | 90 % | 99 % | largest | margin of a step | of a drive "
        "| body out of what is told: 99 %, largest |",
        "|---|---|---|---|---|---|---|---|---|",
        *map(_errors, result["rows"]),
        "",
        "On fresh drives:",
        "",
        "| error of | margin of | m | steps covered, % | drives covered, % |",
        "|---|---|---|---|---|",
        *(line for row in result["rows"] for line in _coverage(row)),
        "",
        "The worst step of the drives with the largest errors; m from the true place to what is told:",
        "",
        "| error of | drive | s | error | h told | h true | m/s | seen for, s | to points | to movers | to hidden |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
        *(line for row in result["rows"] for line in _worst(row)),
        "",
        *(f"- the car moved into something: {what}" for what in result["moving"]),
    ]
    return "\n".join(lines).rstrip() + "\n"


def _errors(row: Mapping[str, Any]) -> str:
    shares = ("0.5", "0.9", "0.99", "1")
    found = [f"{row['quantiles'][share]:.3f}" if row["quantiles"] else "" for share in shares]
    margins = ["" if row[name] is None else f"{row[name]:.3f}" for name in ("step", "drive")]
    out = f"{row['out']['0.99']:.3f}, {row['out']['1']:.3f}" if row["out"] else ""
    return (
        " | ".join([f"| {_KINDS[row['kind']]}", f"{row['steps']} ({row['drives_near']})", *found, *margins, out]) + " |"
    )


def _coverage(row: Mapping[str, Any]) -> list[str]:
    lines = []
    for name, one in row["fresh"].items():
        shares = [_share(one[what], one[f"{what}_95"]) for what in ("steps", "drives")]
        lines.append(f"| {_KINDS[row['kind']]} | {_MARGINS[name]} | {one['epsilon']:.3f} | {' | '.join(shares)} |")
    return lines


def _worst(row: Mapping[str, Any]) -> list[str]:
    lines = []
    for one in row["worst"]:
        apart = " | ".join(
            f"{one['apart'][name]:.2f}" if name in one["apart"] else "" for name in ("points", "movers", "hidden")
        )
        numbers = " | ".join(f"{one[name]:.3f}" for name in ("error", "hoped", "true"))
        lines.append(
            f"| {_KINDS[row['kind']]} | {one['drive']} | {one['time']:g} | {numbers} | {one['speed']:.2f} | "
            f"{one['seen_for']:.2f} | {apart} |"
        )
    return lines


def _share(share: float, interval: Sequence[float]) -> str:
    return f"{100.0 * share:.2f} ({100.0 * interval[0]:.2f} to {100.0 * interval[1]:.2f})"
