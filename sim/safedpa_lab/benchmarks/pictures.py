"""Pictures of a benchmark: who takes how long, and how cost grows."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from safedpa.extras import need

_OURS, _THEIRS, _GRID = "#0072B2", "#7A8590", "#DCE1E6"
_COLOURS: Final = ("#0072B2", "#56B4E9", "#D55E00", "#E69F00", "#009E73", "#CC79A7", "#7A8590", "#222222")
"""Okabe and Ito's, as in the other figures."""
_COLUMNS = 2
_MOST_INSIDE = 3
"""Names that find room between the curves."""
Document = dict[str, Any]


def write_pictures(document: Document, folder: Path) -> list[Path]:
    """Writes ``speed.png`` (all programs of each row) and ``speed_growth.png`` (cost over size) where there are any.

    Raises MissingExtraError when matplotlib is not installed.
    """
    need("train", what="--pictures")
    import matplotlib as mpl

    mpl.use("Agg")
    folder.mkdir(parents=True, exist_ok=True)
    rows = [row for row in document["rows"].values() if "failed" not in row]
    written = []
    compared = [row for row in rows if len(_bars(row)) > 1]
    if compared:
        written.append(_programs(compared, folder / "speed.png"))
    curves = [curve for row in rows for curve in row["curves"] if len(curve["x"]) > 1]
    if curves:
        written.append(_growth(curves, folder / "speed_growth.png"))
    return written


def _bars(row: Document) -> list[tuple[str, float, float, bool]]:
    """Name, the figure that is compared, p99 or 0, and whether it is ours; of the problem that most peers share."""
    problems = [entry["problem"] for entry in row["peers"] if entry["figures"]]
    if not problems:
        return []
    problem = "8 obstacles" if "8 obstacles" in problems else max(problems, key=problems.count)
    found = []
    for own, entries in ((True, row["ours"]), (False, row["peers"])):
        for entry in entries:
            value = entry["figures"].get(row["figure"])
            if value and entry["problem"] == problem:
                found.append((entry["name"], float(value), float(entry["figures"].get("p99", 0.0)), own))
    return found


def _programs(rows: list[Document], path: Path) -> Path:
    from matplotlib import pyplot as plt

    lines = -(-len(rows) // _COLUMNS)
    most = max(len(_bars(row)) for row in rows)
    size = (12.0, (0.9 + 0.28 * most) * lines)
    figure, axes = plt.subplots(lines, _COLUMNS, figsize=size, squeeze=False, layout="constrained")
    for axis in axes.flat[len(rows) :]:
        axis.set_visible(False)
    for axis, row in zip(axes.flat, rows, strict=False):
        _dots(axis, row)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


def _dots(axis: Any, row: Document) -> None:
    """One dot a program with its figure next to it, a line to p99 where there is one; this project's in colour."""
    bars = _bars(row)[::-1]
    unit = next((entry["unit"] for entry in row["ours"] if entry["figures"]), "")
    for place, (_, value, last, own) in enumerate(bars):
        colour = _OURS if own else _THEIRS
        if last > value:
            axis.plot([value, last], [place, place], color=colour, linewidth=1.2, alpha=0.6)
        axis.plot(value, place, marker="o", markersize=7, color=colour)
        above = {"xytext": (0, 6), "textcoords": "offset points", "ha": "center", "fontsize": 7.5}
        axis.annotate(f"{value:,.3g}" if value < 1000.0 else f"{value:,.0f}", (value, place), color=colour, **above)
    ends = [number for _, value, last, _ in bars for number in (value, max(value, last))]
    axis.set_xscale("log")
    axis.set_xlim(0.5 * min(ends), 2.0 * max(ends))
    axis.set_ylim(-0.6, len(bars) - 0.2)
    axis.set_yticks(range(len(bars)), [name for name, *_ in bars], fontsize=8)
    for label, (*_, own) in zip(axis.get_yticklabels(), bars, strict=True):
        label.set_color(_OURS if own else "#222222")
    axis.set_title(_title(row), fontsize=9, loc="left", fontweight="bold")
    axis.set_xlabel(" ".join(filter(None, (row["figure"].replace("_", " "), unit and f"[{unit}]"))), fontsize=8)
    axis.tick_params(axis="both", labelsize=8, length=0)
    axis.xaxis.set_minor_formatter("")
    axis.grid(axis="x", color=_GRID, linewidth=0.7)
    axis.set_axisbelow(True)
    axis.spines[["top", "right", "left"]].set_visible(False)


def _whole_decades(axis: Any) -> None:
    """Stretches the vertical axis to whole decades, so that 3 % of growth look like 3 %."""
    from math import ceil, floor, log10

    values = [float(y) for line in axis.get_lines() for y in line.get_ydata() if y > 0.0]
    if values:
        axis.set_ylim(10.0 ** floor(log10(min(values))), 10.0 ** ceil(log10(max(values)) + 1e-9))


def _title(row: Document) -> str:
    which = "less is better" if row["better"] == "less" else "more is better"
    line = " (line: to p99)" if row["figure"] == "p50" else ""
    return f"{row['name']}: {which}{line}"


def _growth(curves: list[Document], path: Path) -> Path:
    from matplotlib import pyplot as plt

    lines = -(-len(curves) // _COLUMNS)
    figure, axes = plt.subplots(lines, _COLUMNS, figsize=(12.0, 3.3 * lines), squeeze=False, layout="constrained")
    for axis in axes.flat[len(curves) :]:
        axis.set_visible(False)
    for axis, curve in zip(axes.flat, curves, strict=False):
        for (name, values), colour in zip(curve["series"].items(), _COLOURS * 3, strict=False):
            known = [(x, y) for x, y in zip(curve["x"], values, strict=True) if y is not None]
            axis.plot(*zip(*known, strict=True), marker="o", markersize=3, label=name, color=colour)
        axis.set_xscale("log")
        axis.set_yscale("log")
        _whole_decades(axis)
        axis.set_xlabel(curve["x_name"], fontsize=8)
        axis.set_ylabel(curve["y_name"], fontsize=8)
        axis.tick_params(which="both", labelsize=8)
        alongside = {"loc": "center left", "bbox_to_anchor": (1.0, 0.5)} if len(curve["series"]) > _MOST_INSIDE else {}
        axis.legend(fontsize=7, frameon=False, **alongside)
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path
