"""The figures of a hidden-effects experiment as a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

__all__ = ["page_of"]

_HEAD = (
    "cases", "right", "95 % interval", "named first", "all named", "wrong extra", "false law", "parameters within 2 sd",
    "error over oracle: median", "worst", "at most 1.1", "seconds: median", "worst", "of one core: median", "worst",
)  # fmt: skip


def page_of(document: Mapping[str, Any]) -> str:
    """Markdown: a table by suite, one by effect, and the cases that were missed."""
    versions = ", ".join(f"{name} {number}" for name, number in document["versions"].items())
    seeds = ", ".join(map(str, document["seeds"]))
    count = len(document["cases"])
    lines = [
        "# Hidden effects: results",
        "",
        f"{count} cases, seeds {seeds}; finished {document['date'][:10]}; {versions}.",
        "What the suites are and what counts as right: [Hidden effects](../hidden-effects.md). Shares in %.",
        "",
        "## By suite",
        "",
        *_table("suite", document["suites"]),
    ]
    if document["effects"]:
        lines += ["", "## By effect", "", *_table("effect", document["effects"])]
    return "\n".join([*lines, "", "## Missed, or something wrong added too", "", *_missed(document["missed"])]) + "\n"


def _table(first: str, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    names = (first, *_HEAD) if first == "suite" else ("suite", first, *_HEAD)
    lines = [_line(names), _line(["---"] * (len(names) - len(_HEAD)) + ["--:"] * len(_HEAD))]
    for row in rows:
        title = [row["suite"]] if first == "suite" else [row["suite"], row["effect"]]
        lines.append(_line([*title, *_cells(row)]))
    return lines


def _cells(row: Mapping[str, Any]) -> list[str]:
    low, high = row["right"]["interval_95"]
    shares = ("named_first", "all_named", "wrong_additions", "false_laws", "parameters_within_two")
    seconds = (
        "seconds_median", "seconds_largest", "processor_seconds_median", "processor_seconds_largest",
    )  # fmt: skip
    return [
        str(row["cases"]),
        _percent(row["right"]),
        f"{100 * low:.0f} to {100 * high:.0f}",
        *(_percent(row[name]) for name in shares),
        _number(row["error_ratio_median"], 3),
        _number(row["error_ratio_largest"], 3),
        _percent(row["error_ratio_within"]) if row["error_ratio_median"] is not None else "",
        *(_number(row[name], 1) for name in seconds),
    ]


def _missed(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    if not rows:
        return ["None."]
    found = []
    for row in rows:
        hidden, added = (" + ".join(row[key]) or "nothing" for key in ("hidden", "added"))
        found.append(f"- `{row['case']}`: hidden {hidden}; {row['verdict']}, added {added}")
    return found


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _percent(share: Mapping[str, Any] | None) -> str:
    return "" if share is None else f"{100 * share['hits'] / share['of']:.0f}"


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"
