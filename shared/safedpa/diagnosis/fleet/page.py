"""A fleet's diagnosis as one offline HTML page: groups as cards, each number over the robots, all robots in a table."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safedpa.diagnosis.fleet.document import Analysis
from safedpa.diagnosis.fleet.story import (
    common_sentence,
    discovery_sentence,
    group_title,
    headline,
    listed,
    range_text,
)
from safedpa.diagnosis.fleet.strips import error_figure, group_colour, strip_figure
from safedpa.diagnosis.page import embedded, rendered
from safedpa.records.atomic import atomic_path

__all__ = ["fleet_page", "write_fleet_page"]


def write_fleet_page(document: Mapping[str, Any], analysis: Analysis, folder: Path) -> Path:
    """Writes ``fleet.html`` into a folder that exists, whole or not at all. Raises RecordingError when it cannot be."""
    path = folder / "fleet.html"
    with atomic_path(path) as temporary:
        temporary.write_text(fleet_page(document, analysis), encoding="utf-8")
    return path


def fleet_page(document: Mapping[str, Any], analysis: Analysis) -> str:
    """The page's text: figures, tables and plotly.js in one file that asks no other host for anything."""
    strips = strip_figure(document, analysis)
    figures = [error_figure(document)] + ([strips] if strips else [])
    return rendered(
        "fleet_page.html",
        document=document,
        model=Path(document["model_file"]).name,
        title=f"{len(document['robots'])} robots",
        lead=headline(document),
        common=common_sentence(document),
        discovery=discovery_sentence(document),
        tiles=_tiles(document),
        cards=[_card(group, number) for number, group in enumerate(document["groups"])],
        rows=[_row(robot, document) for robot in sorted(document["robots"], key=lambda item: item["group"])],
        has_strips=strips is not None,
        colours=[group_colour(number, document) for number in range(len(document["groups"]))],
        data=embedded({"figures": figures}),
    )


def _tiles(document: Mapping[str, Any]) -> list[tuple[str, str]]:
    counts = document["counts"]
    groups = sum(group["kind"] == "missing" for group in document["groups"])
    minutes = sum(robot["measured_seconds"] for robot in document["robots"]) / 60.0
    measured = f"{minutes:.0f} min" if minutes < 100.0 else f"{minutes / 60.0:.3g} h"
    tiles = [
        (str(len(document["robots"])), "robots"),
        (str(counts["missing"]), f"lack something, in {groups} group{'' if groups == 1 else 's'}"),
        (str(counts["nothing"]), "lack nothing"),
    ]
    for kind, text in (("suspected", "suspected only"), ("unexplained", "unexplained"), ("no_verdict", "no verdict")):
        tiles += [(str(counts[kind]), text)] if counts[kind] else []
    lost = counts["unreadable"] + counts["failed"]
    tiles += [(str(lost), "could not be read")] if lost else []
    return [*tiles, (measured, "measured")]


def _card(group: Mapping[str, Any], number: int) -> dict[str, Any]:
    rows = [
        (item["effect"], name, range_text(value), _between(value))
        for item in group["effects"]
        for name, value in item["parameters"].items()
    ]
    return {
        "number": number,
        "kind": group["kind"],
        "title": group_title(group),
        "count": len(group["robots"]),
        "rows": rows,
        "robots": group["robots"],
        "listed": listed(group["robots"], 12),
        "errors": _errors(group),
    }


def _between(value: Mapping[str, Any]) -> str:
    """mean 0.45, each known to ± 0.001, ± 0.04 from robot to robot"""
    if value["robots"] == 1:
        return "" if value["stated"] is None else f"known to ± {value['stated']:.2g}"
    parts = [f"mean {value['mean']:.3g}"]
    if value["stated"] is not None:
        parts.append(f"each known to ± {value['stated']:.2g}")
    apart = f"± {value['spread']:.2g}" if value["spread"] > 0 else "no more than that"
    parts.append(f"{apart} from robot to robot")
    return ", ".join(parts)


def _errors(group: Mapping[str, Any]) -> str:
    before, after = group["error_before"], group["error_after"]
    if before is None or after is None:
        return ""
    if not group["effects"] or not before > 0:
        return f"error {after:.3g}"
    change = f"{100.0 * (after / before - 1.0):+.0f} %".replace("-", "−")
    return f"error {before:.3g} → {after:.3g} ({change})"


def _row(robot: Mapping[str, Any], document: Mapping[str, Any]) -> dict[str, Any]:
    odd = {item["robot"]: item["times"] for item in document["odd"]}
    found = [
        f"{item['effect']} " + ", ".join(f"{name} {_value(number)}" for name, number in item["parameters"].items())
        for item in robot["found"]
    ]
    notes = [robot["reason"], robot["unexplained"] or ""]
    notes += [f"{odd[robot['robot']]:.1f} times the fleet's error"] if robot["robot"] in odd else []
    notes += (
        [f"{robot['unreadable_files']} files unreadable"] if robot["unreadable_files"] and not robot["reason"] else []
    )
    return {
        **robot,
        "colour": group_colour(robot["group"], document),
        "text": "; ".join(found) or group_title({**document["groups"][robot["group"]], "effects": []}),
        "chance": _chance(robot["chance"]) if robot["found"] else "",
        "note": "; ".join(note for note in notes if note),
    }


def _chance(value: float) -> str:
    """A chance with one digit; below one in a billion nobody knows it."""
    return "< 1e−9" if value < 1e-9 else f"{value:.1g}".replace("e-0", "e−").replace("e-", "e−")


def _value(number: Mapping[str, Any]) -> str:
    unit = "" if number["unit"] == "1" else f" {number['unit']}"
    spread = "" if number["std"] is None else f" ± {number['std']:.1g}"
    return f"{number['value']:.3g}{spread}{unit}"
