"""The car made harder, as Markdown, JSON and a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from safedpa_lab.experiments.car_advantage import advantage_entry
from safedpa_lab.experiments.car_report import margin_markdown
from safedpa_lab.experiments.car_table import MEASURES, share_with_interval
from safedpa_lab.provenance.record import write_result

__all__ = ["curves_markdown", "write_curves"]


def write_curves(result: Mapping[str, Any], out: Path) -> None:
    """``car-curves.json``, ``car-curves.md`` and ``car-curves.png`` in the folder ``out``."""
    from safedpa_lab.experiments.car_figure_curves import curves_figure

    out.mkdir(parents=True, exist_ok=True)
    write_result(out / "car-curves.json", result)
    (out / "car-curves.md").write_text(curves_markdown(result), encoding="utf-8")
    curves_figure(result, out / "car-curves.png")


def curves_markdown(result: Mapping[str, Any]) -> str:
    """Of each sweep the shares with their 95 % intervals, then SafeDPA against each other method; at last margins."""
    first, last = result["seeds"]
    parts = [
        "# The car, made harder",
        f"Policies: {result['family']['phrase']}. Seeds of the scenes: {first} to {last}, the same for every method and "
        f"value. It tows a {result['load']} where the sweep is not about the load. Shares with 95 % Wilson intervals. "
        "Margins are those of the experiment, at every value.",
    ]
    for sweep in result["sweeps"].values():
        parts += [f"## {sweep['label'][0].upper()}{sweep['label'][1:]}", _shares(sweep), *_changes(sweep)]
        parts += _significance(sweep)
    parts += ["## Margins", margin_markdown(result["margin"]).rstrip()]
    parts += [f"{sentence}." for sentence in result["left_out"]]
    return "\n\n".join(parts) + "\n"


def _shares(sweep: Mapping[str, Any]) -> str:
    shown = sweep["shown"]
    found = {(point["method"], point["shown"]): point for point in sweep["points"]}
    lines = [f"| {sweep['label']} | | {' | '.join(shown)} |", "|---|---|" + "---|" * len(shown)]
    for name in dict.fromkeys(point["method"] for point in sweep["points"]):
        for measure, phrase in MEASURES.items():
            entries = [share_with_interval(found[name, value][measure]) for value in shown]
            lines.append(f"| {found[name, shown[0]]['title']} | {phrase} | {' | '.join(entries)} |")
    return "\n".join(lines)


def _changes(sweep: Mapping[str, Any]) -> list[str]:
    """How often the load was hitched or let go on the way, where it was to be."""
    changed: dict[str, list[str]] = {}
    for point in sweep["points"]:
        if point["load_changed"]:
            reported = f"{point['title']} {point['load_changed']} of {point['episodes']}"
            changed.setdefault(point["shown"], []).append(reported)
    return [f"Hitched {shown}, done in: {', '.join(phrase)}." for shown, phrase in changed.items()]


def _significance(sweep: Mapping[str, Any]) -> list[str]:
    rows: Sequence[Mapping[str, Any]] = sweep["advantages"]
    if not rows:
        return []
    found = {(row["against"], row["measure"], row["place"]): row for row in rows}
    shown = sweep["shown"]
    lines = [f"| SafeDPA against | | {' | '.join(shown)} |", "|---|---|" + "---|" * len(shown)]
    for name, measure in dict.fromkeys((row["against"], row["measure"]) for row in rows):
        entries = [advantage_entry(found[name, measure, value]) for value in shown]
        lines.append(f"| {found[name, measure, shown[0]]['title']} | {MEASURES[measure]} | {' | '.join(entries)} |")
    reported = (
        "Episodes that went well with SafeDPA alone : with the other alone; p by McNemar's exact test, after Holm over "
        "all comparisons of this sweep; bold below 0.05."
    )
    return [reported, "\n".join(lines)]
