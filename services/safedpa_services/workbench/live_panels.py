"""What the live page shows next to its buttons: tables and bars, candidates as cards, figures.

The error before and after a change, what happened when, the drive; candidates from the report that a running diagnosis
sent and the names that it accepts; the robot in its field, and the error with its band along time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from safedpa.diagnosis.report_schema import Candidate, FittedValue
from safedpa.live.named_candidate import named_candidate
from safedpa_services.workbench.elements import escaped
from safedpa_services.workbench.evidence import CandidateCard, card_of
from safedpa_services.workbench.live_book import RobotHistory
from safedpa_services.workbench.look import CONFIG, ColourTheme, axis, frame

__all__ = [
    "change_lines",
    "driven_lines",
    "error_bars",
    "error_figure",
    "evidence_figure",
    "field_figure",
    "field_legend",
    "live_cards",
]

_SECONDS = 5
"""Errors of which the median is shown as the present one."""


def error_bars(book: RobotHistory) -> str:
    """Bars: the error before the last change of the model, the present one, and the end of its band."""
    recent = sorted(entry[1] for entry in list(book.errors)[-_SECONDS:] if entry[1] > 0)
    now = recent[len(recent) // 2] if recent else None
    band = book.finding.band if book.finding is not None and book.finding.band > 0 else None
    rows = [("before the last change", book.before, "given"), ("now", now, ""), ("end of its band", band, "band")]
    shown = [(name, value, style) for name, value, style in rows if value is not None]
    highest = max((value for _, value, _ in shown), default=1.0) or 1.0
    fall = ""
    if book.before and now is not None:
        change = f"{100 * (now / book.before - 1):+.0f} % since the change".replace("-", "−")
        fall = f'<div class="number">{change}</div>'
    bars = "".join(_bar(name, value, 100.0 * value / highest, style) for name, value, style in shown)
    return f'<div class="stages"><div class="quiet">error over one second of driving</div>{bars}{fall}</div>'


def _bar(name: str, value: float, width: float, style: str) -> str:
    return (
        f'<div><span class="label"><span>{name}</span><span class="value">{value:.3f}</span></span>'
        f'<div class="bar"><div class="{style}" style="width:{width:.1f}%"></div></div></div>'
    )


def field_legend(look: ColourTheme) -> str:
    """What the lines and signs of the field mean."""
    lines = (("driven", look.measured), ("predicted by the filter's model", look.present))
    spans = "".join(f'<span><i style="border-color:{colour}"></i>{name}</span>' for name, colour in lines)
    return f"{spans}<span>★ goal</span>"


def driven_lines(book: RobotHistory) -> str:
    """The robot's clock, goals and collisions, and the model in force."""
    state = book.state
    if state is None:
        return ""
    model = book.finding.model[:8] if book.finding is not None else "unknown"
    verdict = book.verdict
    rows = [
        ("clock", f"{state.robot_time:.0f} s"),
        ("goals reached", f"{state.goals_reached}"),
        ("collisions", f"{state.collisions}"),
        ("model in force", escaped(model)),
    ]
    if verdict is not None:
        rows += [("room left h", f"{verdict.h_now:.2f}"), ("margin", f"{verdict.margin:.3f}")]
    return '<table class="states">' + "".join(f"<tr><td>{k}</td><td>{v}</td></tr>" for k, v in rows) + "</table>"


def change_lines(book: RobotHistory) -> str:
    """What happened, the newest first."""
    lines = [
        f'<div class="mark {mark.kind}"><b>{mark.t:.0f} s</b> {escaped(mark.text)}</div>'
        for mark in reversed(book.marks)
    ]
    return "".join(lines[:20]) or '<div class="quiet">none yet</div>'


def live_cards(robot: str, report: dict[str, Any] | None, accepted: Sequence[str]) -> tuple[list[CandidateCard], str]:
    """Cards of the effects that can be accepted, best first, and the experiment that is proposed.

    ``robot`` is the kind of robot. What the report says in a way that cannot be read is left out; an effect without a
    readable entry has a card with its name alone.
    """
    readable: list[Candidate] = []
    before = 0.0
    if report is not None:
        before = _number(_first(report.get("stages")).get("heldout_error"))
        readable = [candidate for candidate in map(_candidate, report["candidates"]) if candidate is not None]
    entries = [{**vars(candidate), "itself": candidate} for candidate in readable]
    named = [(name, named_candidate(entries, name)) for name in accepted]
    shown = [_bare(name) if entry is None else entry["itself"] for name, entry in named]
    cards = [card_of(robot, candidate, before, None, {}) for candidate in shown]
    return cards, _experiment({} if report is None else report)


def _experiment(report: dict[str, Any]) -> str:
    entry = report.get("next_experiment")
    if not isinstance(entry, dict) or not entry.get("manoeuvre"):
        return ""
    return f"Next experiment: {entry['manoeuvre']}; {entry.get('why', '')}."


def _candidate(entry: Any) -> Candidate | None:
    try:
        values = {
            str(name): FittedValue(_number(item["value"]), _optional(item.get("std")), str(item.get("unit", "1")))
            for name, item in entry["parameters"].items()
        }
        return Candidate(
            stage=int(entry["stage"]),
            effect=str(entry["effect"]),
            parameters=values,
            heldout_error=_optional(entry["heldout_error"]),
            score=_optional(entry["score"]),
            indistinguishable_from=tuple(map(str, entry["indistinguishable_from"])),
            decision=entry["decision"] if entry["decision"] in ("accepted", "suspected") else "rejected",
            reason=str(entry["reason"]),
        )
    except (KeyError, TypeError, ValueError, AttributeError):
        return None


def _bare(name: str) -> Candidate:
    return Candidate(0, name, {}, None, None, (), "suspected", "")


def _first(entries: Any) -> dict[str, Any]:
    return entries[0] if isinstance(entries, list) and entries and isinstance(entries[0], dict) else {}


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else 0.0


def _optional(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) else None


_HISTORY = 20.0
"""s of the path that are drawn."""
_SPAN = 120.0
"""s of the error that are drawn."""


def field_figure(book: RobotHistory, look: ColourTheme) -> dict[str, Any]:
    """The plane: path, robot, load, obstacles, goal, and what the filter's model predicts."""
    state = book.state
    history = [values for t, values in book.path if t > book.now - _HISTORY]
    data = [_line([v[0] for v in history], [v[1] for v in history], look.measured, 2.5, "driven")]
    shapes: list[dict[str, Any]] = []
    ranges: tuple[Any, Any] = (None, None)
    if state is not None:
        if book.ahead:
            data.append(_line([v[0] for v in book.ahead], [v[1] for v in book.ahead], look.present, 3.0, "predicted"))
        data.append(_dot(state.goal[0], state.goal[1], "goal", look.present, "star", 13))
        shapes = [_circle(x, y, r, look) for x, y, r in state.obstacles]
        x, y, yaw = state.values[:3]
        data.append(_dot(x, y, "robot", look.selected, "triangle-up", 14, angle=90.0 - math.degrees(yaw)))
        if state.load_pose:
            data.append(_dot(state.load_pose[0], state.load_pose[1], "load", look.between, "square", 10))
        ranges = (list(state.field[:2]), list(state.field[2:]))
    layout = frame(
        look,
        dragmode=False,
        xaxis=axis(look, "x [m]", range=ranges[0], constrain="domain"),
        yaxis=axis(look, "y [m]", range=ranges[1], scaleanchor="x", constrain="domain"),
        shapes=shapes,
    )
    return {"data": data, "layout": layout, "config": CONFIG}


def error_figure(book: RobotHistory, look: ColourTheme) -> dict[str, Any]:
    """The one-second error, the edge of its band, and marks where something happened."""
    retained = [entry for entry in book.errors if entry[0] > book.now - _SPAN]
    t = [entry[0] for entry in retained]
    band = [entry[2] if entry[2] > 0 else None for entry in retained]
    data = [
        _line(t, band, look.given, 1.5, "end of its band", "dash"),
        _line(t, [entry[1] or None for entry in retained], look.present, 2.5, "error over 1 s"),
    ]
    known = [
        entry for entry in retained if entry[2] > 0
    ] or retained  # while it learns what is usual, a start may be wild
    highest = max([entry[1] for entry in known] + [value for value in band if value] + [1e-3])
    layout = frame(
        look,
        dragmode=False,
        xaxis=axis(look, "robot's time [s]", range=[max(0.0, book.now - _SPAN), max(book.now, 10.0)]),
        yaxis=axis(look, "error", range=[0.0, 1.15 * highest], nticks=5),
        shapes=[_mark(mark.t, look.given if mark.kind == "finding" else look.present, mark.kind)
                for mark in book.marks if mark.t > book.now - _SPAN],
    )  # fmt: skip
    return {"data": data, "layout": layout, "config": CONFIG}


def evidence_figure(book: RobotHistory, look: ColourTheme) -> dict[str, Any]:
    """The sequential test: log of the e-value and the threshold at which a finding is raised."""
    retained = [entry for entry in book.errors if entry[0] > book.now - _SPAN]
    t = [entry[0] for entry in retained]
    top = max([entry[4] for entry in retained] + [1.0])
    data = [
        _line(t, [entry[4] for entry in retained], look.given, 1.5, "threshold", "dash"),
        _line(t, [min(entry[3], 1.6 * top) for entry in retained], look.text, 2.0, "evidence"),
    ]
    layout = frame(
        look,
        dragmode=False,
        xaxis=axis(look, "robot's time [s]", range=[max(0.0, book.now - _SPAN), max(book.now, 10.0)]),
        yaxis=axis(look, "evidence", range=[min([0.0, *(entry[3] for entry in retained)]) - 0.2, 1.7 * top], nticks=4),
    )
    return {"data": data, "layout": layout, "config": CONFIG}


def _line(x: Any, y: Any, colour: str, width: float, name: str, dash: str = "solid") -> dict[str, Any]:
    line = {"color": colour, "width": width, "dash": dash}
    hover = f"{name}<br>%{{x:.1f}}, %{{y:.3g}}<extra></extra>"
    return {"type": "scatter", "mode": "lines", "x": list(x), "y": list(y), "line": line, "name": name,
            "hovertemplate": hover}  # fmt: skip


def _dot(x: float, y: float, name: str, colour: str, symbol: str, size: float, angle: float = 0.0) -> dict[str, Any]:
    marker = {"color": colour, "size": size, "symbol": symbol, "angle": angle}
    return {"type": "scatter", "mode": "markers", "x": [x], "y": [y], "marker": marker, "name": name,
            "hovertemplate": f"{name}<extra></extra>"}  # fmt: skip


def _circle(x: float, y: float, radius: float, look: ColourTheme) -> dict[str, Any]:
    return {"type": "circle", "x0": x - radius, "x1": x + radius, "y0": y - radius, "y1": y + radius,
            "fillcolor": look.dim, "opacity": 0.6, "line": {"width": 0}}  # fmt: skip


def _mark(t: float, colour: str, kind: str) -> dict[str, Any]:
    dash = "dot" if kind == "finding" else "solid"
    return {"type": "line", "x0": t, "x1": t, "yref": "paper", "y0": 0, "y1": 1,
            "line": {"color": colour, "width": 1.5, "dash": dash}}  # fmt: skip
