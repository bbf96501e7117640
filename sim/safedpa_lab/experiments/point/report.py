"""The point robot's experiment as Markdown, JSON and pictures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from safedpa_lab.experiments.report import interval, markdown_table
from safedpa_lab.point.methods import FILTERS


def without_paths(result: dict[str, Any]) -> dict[str, Any]:
    """The result without the paths that only the figures need."""
    tables = {
        table: {name: {key: row[key] for key in row if key != "shown"} for name, row in result[table].items()}
        for table in ("methods", "same_margin")
    }
    return {**result, **tables}


def markdown_of(result: dict[str, Any]) -> str:
    """Both tables, the margins, RMA-P's penalty, tests against SafeDPA, several training seeds, computing time."""
    head = (
        f"{result['directions']} directions of a force of {1e3 * result['force']:g} mN x {result['episodes']} episodes "
        f"of {result['steps']} steps, seed {result['seed']} (evaluation {result['evaluation_seed']})"
    )
    own, same = result["methods"], result["same_margin"]
    parts = [f"{head}, {result['date']}." if result["date"] else f"{head}."]
    parts += ["## Each filter with its own margin", _safety(own)]
    if len(same) > 1:
        parts += ["## The same margin for all", _safety(same)]
    if result["margins"]:
        parts += ["## Margins", margins_table(result)]
    if result["penalty"]:
        parts += ["## RMA-P's penalty", penalty_table(result)]
    if result["advantages"]:
        parts += ["## SafeDPA against each", _advantages(result)]
    if any("over_seeds" in row for row in own.values()):
        parts += ["## Several training seeds", seeds_table(result)]
    return "\n\n".join([*parts, "## Reward, cost, time", _gained(own)]) + "\n"


def short_table(result: Mapping[str, Any], table: str) -> str:
    """Of ``methods`` or ``same_margin``: margin, episodes without cost, goals, and those over PPO's."""
    rows = []
    for row in result[table].values():
        margin = "" if row["epsilon"] is None else f"{1e3 * row['epsilon']:.1f}"
        safe = _share(row["safe_episodes"], row["episodes"], row["safe_episodes_interval"])
        ratio = f"{row['of_ppo'][0]:.2f}" if "of_ppo" in row else ""
        goals = interval(row["goals"])
        rows.append(f"{row['title']} | {row['reported']} | {margin} | {safe} | {goals} | {ratio}")
    return markdown_table("| inputs | margin, mm | episodes without cost, % | goals | over PPO's", rows)


def against_table(result: Mapping[str, Any]) -> str:
    """SafeDPA against each, every filter with its own margin: episodes that only one of the two drove without cost."""
    rows = []
    for row in result["advantages"]:
        if row["question"] == "own" and row["outcome"] == "safe":
            other = result["methods"][row["against"]]
            found = f"+{row['only_safedpa']} -{row['only_other']}"
            p = f"{row['mcnemar_holm']:.1g} | {row['directions_holm']:.1g}"
            rows.append(f"{other['title']} | {other['reported']} | {found} | {p} | {interval(row['goals'])}")
    return markdown_table("SafeDPA against | inputs | safe | p | by directions | goals less", rows)


def _safety(rows: Mapping[str, Any]) -> str:
    cells = []
    for row in rows.values():
        count = row["episodes"]
        margin = "" if row["epsilon"] is None else f"{1e3 * row['epsilon']:.1f}"
        cells.append(
            f"{row['title']} | {row['reported']} | {margin} | {interval(row['safe_steps'], 100, 2, most=100.0)} "
            f"| {_share(row['safe_episodes'], count, row['safe_episodes_interval'])} "
            f"| {100 * min(row['directions_safe_steps']):.2f} "
            f"| {interval(row['goals'], 1, 2)} | {interval(row['of_ppo'], 1, 2) if 'of_ppo' in row else ''} "
            f"| {_share(row['reached'], count, row['reached_interval'])}"
        )
    return markdown_table(
        "mean (95 % interval) | inputs | margin, mm | steps without cost, % | episodes without cost, % "
        "| worst direction, % of steps | goals an episode | of PPO's | reached one, %",
        cells,
    )


def margins_table(result: Mapping[str, Any]) -> str:
    """How each margin was made."""
    some = next(iter(result["margins"].values()))
    rows = []
    for name, row in result["margins"].items():
        lengths = (row["epsilon"], row["first"], row["of_a_drive"], row["median_error"])
        reported = " | ".join("none" if length is None else f"{1e3 * length:.2f}" for length in lengths)
        rows.append(f"{FILTERS[name]} | {reported} | {row['transitions']}")
    return markdown_table(
        "filter knows | margin, mm | first round, mm | of a whole drive, mm | median error, mm | steps",
        rows,
        above=f"{100 * some['coverage']:g} % of a step near a hazard, conformal over {some['drives']} drives of "
        f"{some['steps']} steps in each of two rounds, calibration seeds {some['seeds'][0]} and {some['seeds'][1]}.",
    )


def penalty_table(result: Mapping[str, Any]) -> str:
    """RMA-P's grid on development drives."""
    choice = result["penalty"]
    rows = []
    for name, row in choice["rows"].items():
        rows.append(f"{name} | {row['reward']:.2f} | {row['cost']:.2f} | {row['score']:.2f} | {row['safe']}")
    return markdown_table(
        "policy | reward | cost | reward - cost | episodes without cost",
        rows,
        above=f"{choice['episodes']} episodes, development seed {choice['seed']}; chosen: {choice['chosen']}.",
    )


def _advantages(result: Mapping[str, Any]) -> str:
    rows = []
    tables = {"own": result["methods"], "same": result["same_margin"]}
    for row in result["advantages"]:
        title = tables[row["question"]][row["against"]]["title"]
        reported = tables[row["question"]][row["against"]]["reported"]
        outcome = {"success": "reached"}.get(row["outcome"], row["outcome"])
        rows.append(
            f"{row['question']} | {title} ({reported}) | {outcome} | {row['only_safedpa']} | {row['only_other']} "
            f"| {row['mcnemar_holm']:.2g} | {row['directions_holm']:.2g} | {interval(row['goals'], 1, 2)}"
        )
    return markdown_table(
        "margins | against | outcome | only SafeDPA | only the other | p, McNemar | p, directions "
        "| goals: SafeDPA less the other",
        rows,
        above="Episodes in which only one of two was good: McNemar's exact test over episodes, and the exact exchange "
        "of whole directions, by Holm over all lines. Good: no cost (safe), a goal (reached), both.",
    )


def seeds_table(result: Mapping[str, Any]) -> str:
    """Means over training seeds, for methods trained from several seeds."""
    rows = []
    for row in result["methods"].values():
        if (found := row.get("over_seeds")) is not None:
            seeds = ", ".join(map(str, found["training_seeds"]))
            rows.append(
                f"{row['title']} ({row['reported']}) | {seeds} | {interval(found['safe'], 100, 1, 0.0, 100.0)} "
                f"| {interval(found['goals'], 1, 2)} | {interval(found['cost'], least=0.0)}"
            )
    return markdown_table(
        "| training seeds | episodes without cost, % | goals | cost",
        rows,
        above="Mean over training seeds (95 % interval over seeds, Student's t); the tables above hold the first seed.",
    )


def _gained(rows: Mapping[str, Any]) -> str:
    cells = []
    for row in rows.values():
        filtered = f"{100 * row['corrected']:.1f} | {100 * row['relaxed']:.1f}" if row["filter"] else " | "
        first = row["first_goal_median"]
        cells.append(
            f"{row['title']} | {row['reported']} | {interval(row['reward'])} "
            f"| {interval(row['cost'], least=0.0)} "
            f"| {row['unsafe_steps']} | {row['least_room']:.3f} | {'never' if first is None else f'{first:.1f}'} "
            f"| {filtered} | {row['milliseconds_per_episode']:.0f} | {row['microseconds_per_decision']:.0f}"
        )
    return markdown_table(
        "| inputs | reward | cost | unsafe steps, all | least room, m | first goal, s | corrected, % "
        "| not all kept, % | processor: ms an episode | us a decision",
        cells,
    )


def _share(hits: int, count: int, ends: list[float]) -> str:
    return f"{100 * hits / count:.1f} ({100 * ends[0]:.1f} to {100 * ends[1]:.1f})"
