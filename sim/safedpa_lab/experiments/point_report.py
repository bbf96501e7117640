"""The point robot's experiment as Markdown, JSON and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from safedpa_lab.provenance.record import write_result

__all__ = ["markdown_of", "write_report"]


def write_report(result: dict[str, Any], out: Path) -> None:
    """``point.json``, ``point.md`` and three PNGs in the folder."""
    from safedpa_lab.experiments.point_figures import write_figures

    out.mkdir(parents=True, exist_ok=True)
    rows = {name: {key: row[key] for key in row if key != "shown"} for name, row in result["methods"].items()}
    write_result(out / "point.json", {**result, "methods": rows})
    (out / "point.md").write_text(markdown_of(result), encoding="utf-8")
    write_figures(result, out)


def markdown_of(result: dict[str, Any]) -> str:
    """Safety and success by method, then what it gained and cost."""
    head = (
        f"{result['directions']} directions of a force of {1e3 * result['force']:g} mN x {result['episodes']} episodes "
        f"of {result['steps']} steps, seed {result['seed']}"
    )
    parts = [f"{head}, {result['date']}." if result["date"] else f"{head}.", _safety(result), _gained(result)]
    return "\n\n".join(parts) + "\n"


def _safety(result: dict[str, Any]) -> str:
    lines = [
        "| mean (95 % interval) | steps without cost, % | episodes without cost, % | worst direction, % of steps "
        "| goals an episode | of PPO's | reached one, % |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in result["methods"].values():
        count = row["episodes"]
        lines.append(
            f"| {row['title']} | {_interval(row['safe_steps'], 100, 2, 100.0)} "
            f"| {_share(row['safe_episodes'], count, row['safe_episodes_interval'])} "
            f"| {100 * min(row['directions_safe_steps']):.2f} "
            f"| {_interval(row['goals'], 1, 2)} | {_interval(row['of_ppo'], 1, 2) if 'of_ppo' in row else ''} "
            f"| {_share(row['reached'], count, row['reached_interval'])} |"
        )
    return "\n".join(lines)


def _gained(result: dict[str, Any]) -> str:
    lines = [
        "| | reward | cost | unsafe steps, all | least room, m | first goal, s | corrected, % | not all kept, % "
        "| processor: ms an episode | us a decision |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in result["methods"].values():
        filtered = f"{100 * row['corrected']:.1f} | {100 * row['relaxed']:.1f}" if row["filter"] else " | "
        first = row["first_goal_median"]
        lines.append(
            f"| {row['title']} | {_interval(row['reward'], 1, 1)} | {_interval(row['cost'], 1, 1, None, 0.0)} "
            f"| {row['unsafe_steps']} | {row['least_room']:.3f} | {'never' if first is None else f'{first:.1f}'} "
            f"| {filtered} | {row['milliseconds_per_episode']:.0f} | {row['microseconds_per_decision']:.0f} |"
        )
    return "\n".join(lines)


def _interval(
    found: list[float], scale: float, digits: int, most: float | None = None, least: float | None = None
) -> str:
    mean, low, high = (scale * part for part in found)
    low = low if least is None else max(low, least)
    high = high if most is None else min(high, most)
    return f"{mean:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def _share(hits: int, count: int, ends: list[float]) -> str:
    return f"{100 * hits / count:.1f} ({100 * ends[0]:.1f} to {100 * ends[1]:.1f})"
