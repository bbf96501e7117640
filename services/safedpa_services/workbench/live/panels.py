"""Content of the live page: tables, bars and figures of a robot's history, and cards of its candidates.

The candidates come from the report of a running diagnosis and from the names that it accepts now.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from safedpa.diagnosis.report_schema import Candidate, FittedValue
from safedpa.live.search_jobs import named_candidate
from safedpa_services.workbench.live.store import RobotHistory
from safedpa_services.workbench.panels.elements import escaped
from safedpa_services.workbench.panels.theme import CONFIG, ColourTheme, axis, figure_layout
from safedpa_services.workbench.session.candidate_cards import CandidateCard, make_card

_MEDIAN_OF = 5
"""Number of latest errors whose median is shown as the present error."""


def error_bars(history: RobotHistory) -> str:
    """HTML with bars: the error before the last model change, the present error, and the end of its band."""
    recent = sorted(entry[1] for entry in list(history.errors)[-_MEDIAN_OF:] if entry[1] > 0)
    now = recent[len(recent) // 2] if recent else None
    band = history.finding.band if history.finding is not None and history.finding.band > 0 else None
    rows = [
        ("before the last change", history.error_before_change, "given"),
        ("now", now, ""),
        ("end of its band", band, "band"),
    ]
    shown = [(name, value, style) for name, value, style in rows if value is not None]
    highest = max((value for _, value, _ in shown), default=1.0) or 1.0
    change_line = ""
    if history.error_before_change and now is not None:
        change = f"{100 * (now / history.error_before_change - 1):+.0f} % since the change".replace("-", "−")
        change_line = f'<div class="number">{change}</div>'
    bars = "".join(_bar(name, value, 100.0 * value / highest, style) for name, value, style in shown)
    return f'<div class="stages"><div class="quiet">error over one second of driving</div>{bars}{change_line}</div>'


def _bar(name: str, value: float, width: float, style: str) -> str:
    return (
        f'<div><span class="label"><span>{name}</span><span class="value">{value:.3f}</span></span>'
        f'<div class="bar"><div class="{style}" style="width:{width:.1f}%"></div></div></div>'
    )


def field_legend(theme: ColourTheme) -> str:
    """HTML legend of the field figure."""
    lines = (("driven", theme.measured), ("predicted by the filter's model", theme.present))
    spans = "".join(f'<span><i style="border-color:{colour}"></i>{name}</span>' for name, colour in lines)
    return f"{spans}<span>★ goal</span>"


def drive_table(history: RobotHistory) -> str:
    """HTML table with the robot's clock, goals, collisions, model, h and margin."""
    state = history.state
    if state is None:
        return ""
    model = history.finding.model[:8] if history.finding is not None else "unknown"
    verdict = history.verdict
    rows = [
        ("clock", f"{state.robot_time:.0f} s"),
        ("goals reached", f"{state.goals_reached}"),
        ("collisions", f"{state.collisions}"),
        ("model in use", escaped(model)),
    ]
    if verdict is not None:
        rows += [("barrier h", f"{verdict.h_now:.2f}"), ("margin", f"{verdict.margin:.3f}")]
    return '<table class="states">' + "".join(f"<tr><td>{k}</td><td>{v}</td></tr>" for k, v in rows) + "</table>"


def change_lines(history: RobotHistory) -> str:
    """HTML list of the latest findings and model changes, the newest first."""
    lines = [
        f'<div class="mark {mark.kind}"><b>{mark.t:.0f} s</b> {escaped(mark.text)}</div>'
        for mark in reversed(history.marks)
    ]
    return "".join(lines[:20]) or '<div class="quiet">none yet</div>'


def live_cards(robot: str, report: dict[str, Any] | None, accepted: Sequence[str]) -> tuple[list[CandidateCard], str]:
    """Returns cards of the effects that can be accepted, best first, and the proposed experiment.

    ``robot`` is the kind of robot. Invalid entries of the report are ignored; an effect without a valid entry gets a
    card with its name only.
    """
    readable: list[Candidate] = []
    before = 0.0
    if report is not None:
        before = _number(_first(report.get("stages")).get("heldout_error"))
        readable = [candidate for candidate in map(_candidate, report["candidates"]) if candidate is not None]
    entries = [{**vars(candidate), "itself": candidate} for candidate in readable]
    named = [(name, named_candidate(entries, name)) for name in accepted]
    shown = [_named_only(name) if entry is None else entry["itself"] for name, entry in named]
    cards = [make_card(robot, candidate, before, None, {}) for candidate in shown]
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


def _named_only(name: str) -> Candidate:
    return Candidate(0, name, {}, None, None, (), "suspected", "")


def _first(entries: Any) -> dict[str, Any]:
    return entries[0] if isinstance(entries, list) and entries and isinstance(entries[0], dict) else {}


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else 0.0


def _optional(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) else None


_PATH_SECONDS = 20.0
"""s of the past path that are drawn."""
_ERROR_SECONDS = 120.0
"""s of past errors that are drawn."""


def field_figure(history: RobotHistory, theme: ColourTheme) -> dict[str, Any]:
    """Figure of the plane: path, robot, load, obstacles, goal, and the path that the filter's model predicts."""
    state = history.state
    recent = [values for t, values in history.path if t > history.now - _PATH_SECONDS]
    data = [_line([v[0] for v in recent], [v[1] for v in recent], theme.measured, 2.5, "driven")]
    shapes: list[dict[str, Any]] = []
    ranges: tuple[Any, Any] = (None, None)
    if state is not None:
        if history.predicted_path:
            data.append(
                _line(
                    [v[0] for v in history.predicted_path],
                    [v[1] for v in history.predicted_path],
                    theme.present,
                    3.0,
                    "predicted",
                )
            )
        data.append(_dot(state.goal[0], state.goal[1], "goal", theme.present, "star", 13))
        shapes = [_circle(x, y, r, theme) for x, y, r in state.obstacles]
        x, y, yaw = state.values[:3]
        data.append(_dot(x, y, "robot", theme.selected, "triangle-up", 14, angle=90.0 - math.degrees(yaw)))
        if state.load_pose:
            data.append(_dot(state.load_pose[0], state.load_pose[1], "load", theme.between, "square", 10))
        ranges = (list(state.field[:2]), list(state.field[2:]))
    layout = figure_layout(
        theme,
        dragmode=False,
        xaxis=axis(theme, "x [m]", range=ranges[0], constrain="domain"),
        yaxis=axis(theme, "y [m]", range=ranges[1], scaleanchor="x", constrain="domain"),
        shapes=shapes,
    )
    return {"data": data, "layout": layout, "config": CONFIG}


def error_figure(history: RobotHistory, theme: ColourTheme) -> dict[str, Any]:
    """Figure of the one-second error and its band along time, with marks at findings and model changes."""
    shown = [entry for entry in history.errors if entry[0] > history.now - _ERROR_SECONDS]
    t = [entry[0] for entry in shown]
    band = [entry[2] if entry[2] > 0 else None for entry in shown]
    data = [
        _line(t, band, theme.given, 1.5, "end of its band", "dash"),
        _line(t, [entry[1] or None for entry in shown], theme.present, 2.5, "error over 1 s"),
    ]
    known = [
        entry for entry in shown if entry[2] > 0
    ] or shown  # errors before the band is known can be huge and must not set the scale
    highest = max([entry[1] for entry in known] + [value for value in band if value] + [1e-3])
    layout = figure_layout(
        theme,
        dragmode=False,
        xaxis=axis(theme, "robot's time [s]", range=[max(0.0, history.now - _ERROR_SECONDS), max(history.now, 10.0)]),
        yaxis=axis(theme, "error", range=[0.0, 1.15 * highest], nticks=5),
        shapes=[_mark(mark.t, theme.given if mark.kind == "finding" else theme.present, mark.kind)
                for mark in history.marks if mark.t > history.now - _ERROR_SECONDS],
    )  # fmt: skip
    return {"data": data, "layout": layout, "config": CONFIG}


def evidence_figure(history: RobotHistory, theme: ColourTheme) -> dict[str, Any]:
    """Figure of the sequential test: log e-value along time, and the threshold at which a finding is raised."""
    shown = [entry for entry in history.errors if entry[0] > history.now - _ERROR_SECONDS]
    t = [entry[0] for entry in shown]
    top = max([entry[4] for entry in shown] + [1.0])
    data = [
        _line(t, [entry[4] for entry in shown], theme.given, 1.5, "threshold", "dash"),
        _line(t, [min(entry[3], 1.6 * top) for entry in shown], theme.text, 2.0, "evidence"),
    ]
    layout = figure_layout(
        theme,
        dragmode=False,
        xaxis=axis(theme, "robot's time [s]", range=[max(0.0, history.now - _ERROR_SECONDS), max(history.now, 10.0)]),
        yaxis=axis(theme, "evidence", range=[min([0.0, *(entry[3] for entry in shown)]) - 0.2, 1.7 * top], nticks=4),
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


def _circle(x: float, y: float, radius: float, theme: ColourTheme) -> dict[str, Any]:
    return {"type": "circle", "x0": x - radius, "x1": x + radius, "y0": y - radius, "y1": y + radius,
            "fillcolor": theme.dim, "opacity": 0.6, "line": {"width": 0}}  # fmt: skip


def _mark(t: float, colour: str, kind: str) -> dict[str, Any]:
    dash = "dot" if kind == "finding" else "solid"
    return {"type": "line", "x0": t, "x1": t, "yref": "paper", "y0": 0, "y1": 1,
            "line": {"color": colour, "width": 1.5, "dash": dash}}  # fmt: skip
