"""Rows as a table that people read, on the terminal or in Markdown."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

_SHOWN: Final = {"p50": "p50", "p99": "p99", "p999": "p99.9"}
_UNITS: Final = {
    "right": "",
    "mib": "MiB",
    "mib_gained": "MiB",
    "minutes": "min",
    "pairs_per_second": "",
    "late_percent": "%",
    "p99_ms": "ms",
    "us_a_robot_tick": "us",
}
_INTRODUCTION: Final = (
    "Written by `safedpa bench all`. `times ahead`: how many times better this project's first line on the same "
    "problem is; below 1 the other one is ahead. `processor`: time of all threads."
)
Document = dict[str, Any]
Line = tuple[str, ...]


def row_lines(row: Document) -> tuple[list[str], list[Line]]:
    """Column names and one line for each program: figures, processor time, how many times this project is ahead."""
    names = _figures(row)
    columns = ["program", "problem", *[_SHOWN.get(name, name.replace("_", " ")) for name in names], "processor"]
    lines = []
    for entry in (*row["ours"], *row["peers"]):
        if entry["missing"]:
            lines.append((entry["name"], entry["problem"], *["-"] * len(names), "-", "-"))
            continue
        values = [figure_text(entry["figures"].get(name), _UNITS.get(name, entry["unit"])) for name in names]
        used = figure_text(entry["processor"].get(row["figure"]), entry["unit"])
        ratio = entry.get("ratio")
        lines.append((entry["name"], entry["problem"], *values, used, "" if ratio is None else f"{ratio:.2f}"))
    return _filled([*columns, "times ahead"], lines)


def _filled(columns: list[str], lines: list[Line]) -> tuple[list[str], list[Line]]:
    """Without the columns in which nothing stands."""
    retained = [place for place in range(len(columns)) if any(line[place] not in ("", "-") for line in lines)]
    return [columns[place] for place in retained], [tuple(line[place] for place in retained) for line in lines]


def figure_text(value: float | None, unit: str) -> str:
    """Three digits or so, with its unit."""
    if value is None:
        return "-"
    size = abs(value)
    if float(value).is_integer() and unit in ("", "robots"):
        return f"{value:.0f} {unit}".rstrip()
    if size >= 1e6:
        return f"{value / 1e6:.2f} M{unit}" if unit != "us" else f"{value / 1e6:.2f} s"
    text = f"{value:.0f}" if size >= 100 else f"{value:.1f}" if size >= 10 else f"{value:.2f}"
    return f"{text} {unit}".rstrip()


def markdown(document: Document) -> str:
    """The whole document as Markdown: asked and reached first, then each row."""
    parts = ["# Speed: results", "", _INTRODUCTION, ""]
    if any(row.get("effort") == "quick" for row in document["rows"].values()):
        parts += ["**Some rows are of a quick run: their numbers mean little.**", ""]
    parts += ["| work | asked | reached | |", "| --- | --: | --: | --- |"]
    for name, row in document["rows"].items():
        parts += [f"| {name}: {text} |" for text in _target_cells(row)]
    for name, row in document["rows"].items():
        parts += ["", f"## {name}", "", *_section(row)]
    return "\n".join(parts) + "\n"


def target_texts(row: Document) -> list[str]:
    """One sentence a target."""
    return [cells.replace(" | ", ", ") for cells in _target_cells(row)]


def _target_cells(row: Document) -> Iterator[str]:
    if "failed" in row:
        yield f"{row['work']} | - | - | failed: {row['failed']}"
        return
    for target in row["targets"]:
        sign = "at most" if target["better"] == "less" else "at least"
        wanted, got = (figure_text(target[key], target["unit"]) for key in ("wanted", "got"))
        yield f"{target['what']} | {sign} {wanted} | {got} | {_judged(target)}"
    if not row["targets"]:
        yield f"{row['work']} | printed | see below |"


def _judged(target: Document) -> str:
    """Whether it was reached, and next to what is missed the floor under it."""
    if target["reached"]:
        return "reached"
    floor = target.get("floor")
    if floor is None:
        return "not reached"
    link = "forbidden by" if target["forbidden"] else "floor:"
    return f"not reached; {link} {floor['name']}, {figure_text(floor['value'], target['unit'])}"


def _section(row: Document) -> Iterator[str]:
    yield f"{row['work'][:1].upper()}{row['work'][1:]}."
    if "failed" in row:
        yield f"Failed: {row['failed']}"
        return
    yield ""
    columns, lines = row_lines(row)
    yield "| " + " | ".join(columns) + " |"
    yield "|" + "".join(" --- |" if name in ("program", "problem") else " --: |" for name in columns)
    yield from ("| " + " | ".join(line) + " |" for line in lines)
    yield ""
    reported = dict.fromkeys(
        (entry["name"], entry["missing"] or entry["note"]) for entry in (*row["ours"], *row["peers"])
    )
    yield from (f"- {name}: {phrase}" for name, phrase in reported if phrase)
    yield from (f"- {note}" for note in row["notes"])
    about = row["machine"]
    yield (
        f"- measured {about['date']} on {about['cores']} cores ({about['processor']}), load average "
        f"{row['load_average'][0]} to {row['load_average'][1]}, {row['seconds']:.0f} s, effort {row['effort']}"
    )


def _figures(row: Document) -> list[str]:
    """The figures to show: percentiles where there are some, else all that any program has."""
    known = dict.fromkeys(name for entry in (*row["ours"], *row["peers"]) for name in entry["figures"])
    return list(_SHOWN) if "p50" in known else list(known)
