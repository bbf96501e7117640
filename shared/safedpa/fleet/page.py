"""A fleet's diagnosis as one offline HTML page: groups as cards, values over the robots, and a table of all robots."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from safedpa.fleet.document import Analysis
from safedpa.fleet.outcome import Number, neutral_of
from safedpa.fleet.pooled_evidence import estimates
from safedpa.fleet.summary import (
    common_sentence,
    discovery_sentence,
    group_title,
    headline,
    listed,
    range_text,
)
from safedpa.report.comparison_page import embedded, rendered
from safedpa.report.panels import Panels

# The palette of Okabe and Ito, which colour-blind people can distinguish.
_MISSING = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_OTHERS = {"unexplained": "#222222", "suspected": "#C9B800", "nothing": "#AEB8C2"}
_GOLDEN = 0.618034
# Height of one group's lane in pixels.
_LANE = 46
_MOST_PANELS = 12


def group_colour(number: int, document: Mapping[str, Any]) -> str:
    """Returns the colour of a group on the page; the palette repeats for many groups."""
    kind = document["groups"][number]["kind"]
    before = sum(group["kind"] == "missing" for group in document["groups"][:number])
    return _MISSING[before % len(_MISSING)] if kind == "missing" else _OTHERS.get(kind, "#8A96A3")


def error_figure(document: Mapping[str, Any]) -> dict[str, Any]:
    """Returns a figure with one line per robot, from the given model's error to that with the effects found."""
    judged = [robot for robot in document["robots"] if robot["error_after"] is not None]
    judged.sort(key=lambda robot: (robot["group"], robot["error_after"]))
    panels = Panels(rows=1, columns=1, height=300)
    at = panels.add("", "robots, group by group", "held-out error")
    for group in sorted({robot["group"] for robot in judged}):
        own = [(place, robot) for place, robot in enumerate(judged) if robot["group"] == group]
        colour = group_colour(group, document)
        lines = _gapped([(place, robot["error_before"], robot["error_after"]) for place, robot in own])
        panels.draw(
            at, *lines, mode="lines", line={"color": colour, "width": 2}, opacity=0.45, hoverinfo="skip"
        )  # fmt: skip
        places = [float(place) for place, _ in own]
        names = [robot["robot"] for _, robot in own]
        for key, symbol, what in (("error_before", "circle-open", "given model"), ("error_after", "circle", "after")):
            panels.draw(
                at, places, [robot[key] for _, robot in own], mode="markers", text=names,
                marker={"color": colour, "size": 8, "symbol": symbol, "line": {"width": 1.5, "color": colour}},
                hovertemplate=f"%{{text}}<br>{what} %{{y:.3g}}<extra></extra>",
            )  # fmt: skip
    panels.axis(at, "x", showticklabels=False, ticks="", showgrid=False, range=[-1.0, len(judged)])
    ticks = [digit * 10.0**power for power in range(-6, 4) for digit in (1, 2, 5)]
    panels.axis(at, "y", type="log", tickvals=ticks, ticktext=[f"{tick:g}" for tick in ticks])
    return panels.figure("errors")


def _gapped(lines: Sequence[tuple[float, float, float]]) -> tuple[list[float], list[float]]:
    """Returns vertical lines as one trace with gaps between them."""
    x: list[float] = []
    y: list[float] = []
    for place, low, high in lines:
        x += [place, place, math.nan]
        y += [low, high, math.nan]
    return x, y


def strip_figure(document: Mapping[str, Any], analysis: Analysis) -> dict[str, Any] | None:
    """Returns a figure with one panel per parameter: a lane per group that has it, and the other robots in grey.

    Includes the given model's free parameters. None without any parameter.
    """
    wanted = _wanted(document)[:_MOST_PANELS]
    if not wanted:
        return None
    most = max(len(_lanes(document, effect)) for effect, _ in wanted)
    columns = 2 if len(wanted) > 1 else 1
    panels = Panels(-(-len(wanted) // columns), columns, height=_LANE * most + 120)
    for effect, parameter in wanted:
        _panel(panels, document, analysis, effect, parameter)
    return panels.figure("strips", margin={"l": 96, "r": 18, "t": 34, "b": 48})


def _wanted(document: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Returns (effect, parameter) of common effects and found effects, then (base, parameter) of free parameters."""
    common = (document["common"] or {"effects": []})["effects"]
    shared = [(item["effect"], parameter) for item in common for parameter in item["parameters"]]
    found = [
        (item["effect"], parameter)
        for group in document["groups"]
        for item in group["effects"]
        for parameter in item["parameters"]
    ]
    free = [(path.split(".")[0], path.split(".")[1]) for path in document["free"]]
    return list(dict.fromkeys(shared + found + free))


def _lanes(document: Mapping[str, Any], effect: str) -> list[int]:
    """Returns the groups with a lane for an effect; all groups for a free parameter."""
    groups = range(len(document["groups"]))
    own = [n for n in groups if any(item["effect"] == effect for item in document["groups"][n]["effects"])]
    with_free = [
        n for n in groups if document["groups"][n]["kind"] in ("missing", "unexplained", "suspected", "nothing")
    ]
    return own or with_free


def _panel(panels: Panels, document: Mapping[str, Any], analysis: Analysis, effect: str, parameter: str) -> None:
    numbers, unit = _numbers(analysis, effect, parameter)
    lanes = _lanes(document, effect)
    title = parameter + (f" [{unit}]" if unit not in ("", "1") else "")
    at = panels.add(effect if effect != "base" else "free in the given model", title, "")
    in_lanes = {name for lane in lanes for name in document["groups"][lane]["robots"]}
    rest = [name for name in numbers if name not in in_lanes]
    ticks = [_counted(len(document["groups"][lane]["robots"])) for lane in lanes] + (["the others"] if rest else [])
    count = len(ticks)
    for row, lane in enumerate(lanes):
        names = [name for name in document["groups"][lane]["robots"] if name in numbers]
        _points(panels, at, names, numbers, count - 1.0 - row, group_colour(lane, document))
    if rest:
        _points(panels, at, rest, numbers, 0.0, "#B8C4CE", errors=False)
    neutral = neutral_of(analysis.robot, effect, parameter)
    if neutral is not None:
        line = {"color": "#222222", "width": 1, "dash": "dot"}
        panels.draw(at, [neutral, neutral], [-0.6, count - 0.4], mode="lines", line=line, hoverinfo="skip")
    panels.axis(at, "y", tickvals=list(range(count))[::-1], ticktext=ticks, range=[-0.6, count - 0.4], showgrid=False)


def _counted(count: int) -> str:
    return f"{count} robot{'' if count == 1 else 's'}"


def _numbers(analysis: Analysis, effect: str, parameter: str) -> tuple[dict[str, Number], str]:
    """Returns each robot's estimate of one parameter by name, and its unit."""
    notice = estimates(effect, [item for item in analysis.outcomes if item.judged])
    numbers = {name: item.numbers[parameter] for name, item in notice.items() if parameter in item.numbers}
    for outcome in analysis.outcomes:
        own = (outcome.free or {}).get(f"{effect}.{parameter}")
        if own is not None:
            numbers[outcome.name] = own
    return numbers, next((item.unit for item in numbers.values()), "")


def _points(
    panels: Panels,
    at: int,
    names: Sequence[str],
    numbers: Mapping[str, Number],
    lane: float,
    colour: str,
    *,
    errors: bool = True,
) -> None:
    """Draws one point per robot, spread over the lane so that they do not overlap."""
    heights = [lane + 0.5 * ((index * _GOLDEN + 0.5) % 1.0 - 0.5) for index in range(len(names))]
    own = [numbers[name] for name in names]
    stds = [item.std if math.isfinite(item.std) else 0.0 for item in own]
    texts = [
        f"{name}<br>{item.value:.4g}" + (f" ± {std:.2g}" if std else "")
        for name, item, std in zip(names, own, stds, strict=True)
    ]
    bars = {"error_x": {"type": "data", "array": stds, "thickness": 1.2, "width": 0, "color": colour}} if errors else {}
    panels.draw(
        at, [item.value for item in own], heights, mode="markers", text=texts, hoverinfo="text",
        marker={"color": colour, "size": 9 if errors else 6, "opacity": 0.9 if errors else 0.7}, **bars,
    )  # fmt: skip


def fleet_page(document: Mapping[str, Any], analysis: Analysis) -> str:
    """Returns the page: figures, tables and plotly.js in one file without external requests."""
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
    """Returns a text such as ``mean 0.45, each known to ± 0.001, ± 0.04 from robot to robot``."""
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
    """Formats a p-value with one digit."""
    # Below one in a billion the normal approximation means nothing.
    return "< 1e−9" if value < 1e-9 else f"{value:.1g}".replace("e-0", "e−").replace("e-", "e−")


def _value(number: Mapping[str, Any]) -> str:
    unit = "" if number["unit"] == "1" else f" {number['unit']}"
    spread = "" if number["std"] is None else f" ± {number['std']:.1g}"
    return f"{number['value']:.3g}{spread}{unit}"
