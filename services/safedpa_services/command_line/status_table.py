"""Renders the state of a fleet as tables for a terminal: the columns that fit, the worst rows first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from safedpa.bus.monitor import is_stale

_COLOURS = {
    "well": "green",
    "attention": "yellow",
    "trouble": "bold red",
    "passed": "green",
    "corrected": "yellow",
    "relaxed": "magenta",
    "violated": "bold red",
    "fallback": "red",
    "stopped": "yellow",
    "disabled": "red",
    "raised": "yellow",
    "searching": "yellow",
    "candidates": "yellow",
}
_FEWEST_ROWS = 5
_OLD_FINDING_SECONDS = 5.0
Row = dict[str, Any]


@dataclass(frozen=True)
class _TableColumn:
    title: str
    width: int
    """Characters; longer text is cut."""
    text: Callable[[Row], str]
    least_width: int = 0
    """Width of the terminal below which the column is left out."""
    left: bool = False


def _number(name: str, form: str, scale: float = 1.0) -> Callable[[Row], str]:
    return lambda row: "" if row[name] is None else format(row[name] if scale == 1.0 else scale * row[name], form)


def _verdict(row: Row) -> str:
    """Returns the verdict, or how long there has been none."""
    age = row["verdict_age"]
    return "" if age is None else f"{age:.0f} s ago" if is_stale(age, row["period"]) else str(row["verdict"])


def _present(form: str, name: str) -> Callable[[Row], str]:
    """Returns a column of the verdict's values; an old verdict has none."""
    return lambda row: "" if is_stale(row["verdict_age"], row["period"]) else _number(name, form)(row)


def _model(row: Row) -> str:
    models = row["models"]
    return str(models.get("safety_filter") or next(iter(models.values()), ""))


def _coverage(row: Row) -> str:
    return "" if is_stale(row["verdict_age"], row["period"]) else _number("coverage", ".1f", 100.0)(row)


def _diagnosis(row: Row) -> str:
    age = row["diagnosis_age"]
    return "" if age is None else f"{age:.0f} s ago" if age > _OLD_FINDING_SECONDS else str(row["diagnosis"])


def _sources(row: Row) -> str:
    parts = [f"{name} {'-' if age is None else f'{age:.2f}'}" for name, age in row["sources"].items()]
    return " ".join(parts)


def _more(row: Row) -> str:
    if row["service"] != "recorder":
        return str(row["detail"])
    parts = [f"{row['steps']} messages written"]
    parts += [f"{row['acknowledged']} acknowledged"] if row["acknowledged"] else []
    parts += [f"{row['free_bytes'] / 1e9:.1f} GB of disk left"] if row["free_bytes"] else []
    return ", ".join([*parts, *([row["detail"]] if row["detail"] else [])])


_ROBOTS = (
    _TableColumn("robot", 12, lambda row: row["robot"], left=True),
    _TableColumn("health", 9, lambda row: row["health"], left=True),
    _TableColumn("Hz", 5, _number("rate", ".1f")),
    _TableColumn("verdict", 9, _verdict, left=True),
    _TableColumn("h", 6, _present("+.2f", "h")),
    _TableColumn("corr %", 6, _number("corrected", ".1f", 100.0)),
    _TableColumn("fall %", 6, _number("fallback", ".1f", 100.0)),
    _TableColumn("late %", 6, _number("late", ".2f", 100.0)),
    _TableColumn("p99 ms", 6, _number("sense_to_act_p99", ".1f", 1e3), 90),
    _TableColumn("cov. %", 6, _coverage, 100),
    _TableColumn("diagnosis", 10, _diagnosis, 115, left=True),
    _TableColumn("age s", 5, _number("age", ".2f")),
    _TableColumn("of Hz", 5, _number("wanted_rate", ".0f"), 135),
    _TableColumn("p50 ms", 6, _number("sense_to_act_p50", ".1f", 1e3), 145),
    _TableColumn("time s", 8, _number("time", ".1f"), 155),
    _TableColumn("goals", 5, _number("goals", "d"), 165),
    _TableColumn("hits", 4, _number("collisions", "d"), 172),
    _TableColumn("model", 12, _model, 190, left=True),
    _TableColumn("sources, age s", 24, _sources, 215, left=True),
)
_SERVICES = (
    _TableColumn("process", 14, lambda row: row["service"], left=True),
    _TableColumn("health", 9, lambda row: row["health"], left=True),
    _TableColumn("state", 8, lambda row: row["state"], left=True),
    _TableColumn("robots", 6, _number("robots", "d")),
    _TableColumn("steps/s", 7, _number("steps_per_second", ".1f")),
    _TableColumn("step us", 7, _number("step_microseconds", ".0f")),
    _TableColumn("stale", 6, _number("stale", "d")),
    _TableColumn("refused", 7, _number("refused", "d")),
    _TableColumn("age s", 5, _number("age", ".2f")),
    _TableColumn("pid", 7, _number("pid", "d"), 105),
    _TableColumn("version", 8, lambda row: row["software"], 115, left=True),
    _TableColumn("", 70, _more, 150, left=True),
)


def render_status_table(document: dict[str, Any], width: int, height: int = 0) -> Group:
    """Renders headline, alerts, robots and processes in ``width`` columns and, if given, at most ``height`` rows."""
    robots, services, concerns = document["robots"], document["services"], document["concerns"]
    rows = _rows(height, len(robots), len(services), len(_grouped(concerns)))
    parts: list[Any] = [_headline(document)]
    parts += _alert_lines(concerns, rows[2], width)
    if robots:
        parts += [Text(""), _table(_ROBOTS, robots[: rows[0]], width), *_hidden_robots(robots[rows[0] :])]
    if services:
        parts += [Text(""), _table(_SERVICES, services[: rows[1]], width), *_hidden_processes(services[rows[1] :])]
    parts += _recording(services, width)
    return Group(*parts)


def _rows(height: int, robots: int, services: int, concerns: int) -> tuple[int, int, int]:
    """Returns the number of rows for robots, processes and alerts; without a height 20, all and 12."""
    if not height:
        return 20, services, 12
    rest = height - 9  # for headline, titles, empty lines, summary lines and the recorder's line
    if robots + services + concerns <= rest:
        return robots, services, concerns
    alerts = min(concerns, max(2, rest // 4))
    processes = min(services, max(3, (rest - alerts) // 2))
    return max(_FEWEST_ROWS, min(robots, rest - alerts - processes)), processes, alerts


def _headline(document: dict[str, Any]) -> Text:
    robots, services = document["robots"], document["services"]
    counts = {level: sum(row["health"] == level for row in robots) for level in ("trouble", "attention", "well")}
    parts: list[str | tuple[str, str]] = [
        (f"fleet {document['fleet']}  ", "bold"),
        ("healthy" if document["healthy"] else "not healthy", "bold green" if document["healthy"] else "bold red"),
        f"  {len(robots)} robots",
    ]
    parts += [(f"  {count} {level}", _COLOURS[level]) for level, count in counts.items() if count]
    return Text.assemble(*parts, f"  {len(services)} processes", no_wrap=True, overflow="ellipsis")


def _alert_lines(concerns: Sequence[Row], most: int, width: int) -> list[Text]:
    lines = []
    for concern in _grouped(concerns)[:most]:
        about = f"{concern['robot']}: " if concern["robot"] else ""
        line = Text.assemble((about + concern["sentence"], _COLOURS[concern["level"]]))
        line.truncate(width, overflow="ellipsis")
        lines.append(line)
    left = len(_grouped(concerns)) - len(lines)
    return lines + ([Text(f"and {left} more", style="dim")] if left > 0 else [])


def _grouped(concerns: Sequence[Row]) -> list[Row]:
    """Merges alerts of the same kind about several robots into one row, with the sentence about the worst of them."""
    kinds: dict[tuple[str, str], list[Row]] = {}
    for concern in concerns:
        kinds.setdefault((concern["level"], concern["kind"]), []).append(concern)
    lines = []
    for (level, _), alike in kinds.items():
        alike.sort(key=lambda concern: -concern["size"])
        worst = alike[0]["sentence"]
        same = len({concern["sentence"] for concern in alike}) == 1
        names = _listed([concern["robot"] for concern in alike])
        lines.append({"level": level, "sentence": worst if same else f"{worst} (the first)", "robot": names})
    return lines


def _listed(robots: Sequence[str]) -> str:
    shown = ", ".join(robots[:4])
    return shown if len(robots) <= 4 else f"{shown} and {len(robots) - 4} more"


def _table(columns: Sequence[_TableColumn], rows: Sequence[Row], width: int) -> Table:
    shown = [column for column in columns if width >= column.least_width]
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for column in shown:
        table.add_column(
            column.title,
            justify="left" if column.left else "right",
            max_width=column.width,
            no_wrap=True,
            overflow="ellipsis",
        )
    for row in rows:
        cells = [column.text(row) for column in shown]
        table.add_row(*(Text(cell, style=_COLOURS.get(cell, "")) for cell in cells))
    return table


def _hidden_robots(rest: Sequence[Row]) -> list[Text]:
    """Summarises the robots that are not shown in one line."""
    if not rest:
        return []
    worst = {level: sum(row["health"] == level for row in rest) for level in ("trouble", "attention", "well")}
    counts = ", ".join(f"{count} {level}" for level, count in worst.items() if count)
    late = max(row["late"] for row in rest)
    slowest = max((row["sense_to_act_p99"] or 0.0) for row in rest)
    reported_slowest = f", p99 at most {1e3 * slowest:.1f} ms" if slowest else ""
    present = [row["h"] for row in rest if row["h"] is not None and not is_stale(row["verdict_age"], row["period"])]
    least = min(present, default=0.0)
    numbers = f"least h {least:+.2f}, late at most {100.0 * late:.2f} %{reported_slowest}"
    return [Text(f"{len(rest)} further robots ({counts}): {numbers}", style="dim", no_wrap=True, overflow="ellipsis")]


def _hidden_processes(rest: Sequence[Row]) -> list[Text]:
    return [Text(f"{len(rest)} further processes", style="dim")] if rest else []


def _recording(services: Sequence[Row], width: int) -> list[Text]:
    """Returns the details of recorder and router as lines, if the table is too narrow for them."""
    if width >= 150:
        return []
    return [
        Text(f"{row['service']}: {_more(row)}", style="dim")
        for row in services
        if row["service"] in ("recorder", "router") and _more(row)
    ]
