"""Content of the live page: tables, bars and figures of a robot's history, and cards of its candidates.

The candidates come from the report of a running diagnosis and from the names that it accepts now.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from safedpa.bus.monitor import age_text
from safedpa.diagnosis.report_schema import Candidate, FittedValue
from safedpa.live.search_jobs import named_candidate
from safedpa_services.workbench.live.store import RobotHistory
from safedpa_services.workbench.panels.elements import escaped
from safedpa_services.workbench.panels.theme import ColourTheme, axis, curve, figure, markers, vertical_line
from safedpa_services.workbench.session.candidate_cards import CandidateCard, make_card

_OLD_SECONDS = 2.0
"""Age beyond which a value is marked: the diagnosis reports once a second."""
_OLD_FINDING_SECONDS = 5.0
"""Findings arrive once a second of robot time."""
_MEDIAN_OF = 5
"""Number of latest errors whose median is shown as the present error."""


def finding_sentence(history: RobotHistory, now: float) -> str:
    """The latest finding with its age at ``now`` [s]; an old one, or one of a silent robot, as the last one."""
    finding, age = history.finding, history.finding_age(now)
    if finding is None or age is None:
        return "No finding yet."
    sentence = f"{finding.sentence[:1].upper()}{finding.sentence[1:]} ({age_text(age)})"
    return f"Last finding: {sentence}" if history.headline(now) or age > _OLD_FINDING_SECONDS else sentence


def where_text(history: RobotHistory, now: float) -> str:
    """Returns where the model fails and how often the margin held, with the age of the finding at ``now`` [s]."""
    finding, age = history.finding, history.finding_age(now)
    if finding is None or age is None:
        return ""
    where = f"{finding.where}; " if finding.where else ""
    return f"{where}{100 * finding.coverage:.1f} % of the steps stayed within the margin ({age_text(age)})"


def filter_sentence(history: RobotHistory, now: float) -> str:
    """Returns the filter's sentence; an old one as the last one, with its age."""
    _, age = history.ages(now)
    if history.verdict is None or age is None:
        return ""
    sentence = f"{history.verdict.sentence} ({age_text(age)})"
    return f"Last verdict: {sentence}" if history.headline(now) else sentence


def error_bars(history: RobotHistory, now: float) -> str:
    """HTML with bars: the error before the last model change, the newest error, and the end of its band.

    The age of the newest error at ``now`` [s] is given; an old one is not called the present one.
    """
    age = history.finding_age(now)
    is_old = age is not None and age > _OLD_FINDING_SECONDS
    recent = sorted(entry[1] for entry in list(history.errors)[-_MEDIAN_OF:] if entry[1] > 0)
    newest = recent[len(recent) // 2] if recent else None
    band = history.finding.band if history.finding is not None and history.finding.band > 0 else None
    rows = [
        ("before the last change", history.error_before_change, "given"),
        ("last" if is_old else "now", newest, ""),
        ("end of its band", band, "band"),
    ]
    shown = [(name, value, style) for name, value, style in rows if value is not None]
    highest = max((value for _, value, _ in shown), default=1.0) or 1.0
    change_line = ""
    if history.error_before_change and newest is not None:
        change = f"{100 * (newest / history.error_before_change - 1):+.0f} % since the change".replace("-", "−")
        change_line = f'<div class="number">{change}</div>'
    bars = "".join(_bar(name, value, 100.0 * value / highest, style) for name, value, style in shown)
    what = "error over one second of driving" + ("" if age is None else f" ({age_text(age)})")
    return f'<div class="stages"><div class="quiet">{what}</div>{bars}{change_line}</div>'


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


def drive_table(history: RobotHistory, now: float) -> str:
    """HTML table with the robot's clock, goals, collisions, model, h and margin, and their ages at ``now`` [s]."""
    state = history.state
    if state is None:
        return ""
    verdict, (state_age, verdict_age) = history.verdict, history.ages(now)
    rows = [
        ("clock", f"{state.robot_time:.0f} s", state_age),
        ("goals reached", f"{state.goals_reached}", state_age),
        ("collisions", f"{state.collisions}", state_age),
    ]
    if history.finding is not None:
        rows.append(("model in use", escaped(history.finding.model[:8]), history.finding_age(now)))
    if verdict is not None:
        unit = " rad" if state.corridor else " m" if state.field else ""
        rows.append(("barrier h", f"{verdict.h_now:.2f}{unit}", verdict_age))
        rows.append(("margin", f"{verdict.margin:.3f}{unit}", verdict_age))
    cells = (f"<tr><td>{k}</td><td>{v}</td><td>{_age(age)}</td></tr>" for k, v, age in rows)
    return '<table class="states">' + "".join(cells) + "</table>"


def _age(age: float | None) -> str:
    """Returns an age [s] as a cell; an old value is marked."""
    if age is None:
        return ""
    return f'<b class="old">{age_text(age)}</b>' if age > _OLD_SECONDS else age_text(age)


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
_HOVER = "<br>%{x:.1f}, %{y:.3g}"


def field_figure(history: RobotHistory, theme: ColourTheme) -> dict[str, Any]:
    """Figure of the plane: path, robot, load, obstacles, goal, and the path that the filter's model predicts."""
    state = history.state
    recent = [values for t, values in history.path if t > history.now - _PATH_SECONDS]
    data = [_path(recent, theme.measured, 2.5, "driven")]
    shapes: list[dict[str, Any]] = []
    ranges: tuple[Any, Any] = (None, None)
    if state is not None:
        data += [_path(history.predicted_path, theme.present, 3.0, "predicted")] if history.predicted_path else []
        data.append(_dot(state.goal, "goal", theme.present, "star", 13))
        shapes = [_circle(x, y, r, theme) for x, y, r in state.obstacles]
        turned = 90.0 - math.degrees(state.values[2])
        data.append(_dot(state.values, "robot", theme.selected, "triangle-up", 14, turned))
        data += [_dot(state.load_pose, "load", theme.between, "square", 10)] if state.load_pose else []
        ranges = (list(state.field[:2]), list(state.field[2:]))
    across = axis(theme, "x [m]", range=ranges[0], constrain="domain")
    up = axis(theme, "y [m]", range=ranges[1], scaleanchor="x", constrain="domain")
    return figure(theme, data, dragmode=False, xaxis=across, yaxis=up, shapes=shapes)


def error_figure(history: RobotHistory, theme: ColourTheme) -> dict[str, Any]:
    """Figure of the one-second error and its band along time, with marks at findings and model changes."""
    shown = [entry for entry in history.errors if entry[0] > history.now - _ERROR_SECONDS]
    t = [entry[0] for entry in shown]
    band = [entry[2] if entry[2] > 0 else None for entry in shown]
    data = [
        curve(t, band, theme.given, 1.5, f"end of its band{_HOVER}", dash="dash"),
        curve(t, [entry[1] or None for entry in shown], theme.present, 2.5, f"error over 1 s{_HOVER}"),
    ]
    # errors before the band is known can be huge and must not set the scale
    known = [entry for entry in shown if entry[2] > 0] or shown
    highest = max([entry[1] for entry in known] + [value for value in band if value] + [1e-3])
    marks = [
        vertical_line(mark.t, theme.given, 1.5, "dot") if mark.kind == "finding" else
        vertical_line(mark.t, theme.present, 1.5)
        for mark in history.marks if mark.t > history.now - _ERROR_SECONDS
    ]  # fmt: skip
    up = axis(theme, "error", range=[0.0, 1.15 * highest], nticks=5)
    return figure(theme, data, dragmode=False, xaxis=_time_axis(history, theme), yaxis=up, shapes=marks)


def evidence_figure(history: RobotHistory, theme: ColourTheme) -> dict[str, Any]:
    """Figure of the sequential test: log e-value along time, and the threshold at which a finding is raised."""
    shown = [entry for entry in history.errors if entry[0] > history.now - _ERROR_SECONDS]
    t = [entry[0] for entry in shown]
    top = max([entry[4] for entry in shown] + [1.0])
    data = [
        curve(t, [entry[4] for entry in shown], theme.given, 1.5, f"threshold{_HOVER}", dash="dash"),
        curve(t, [min(entry[3], 1.6 * top) for entry in shown], theme.text, 2.0, f"evidence{_HOVER}"),
    ]
    up = axis(theme, "evidence", range=[min([0.0, *(entry[3] for entry in shown)]) - 0.2, 1.7 * top], nticks=4)
    return figure(theme, data, dragmode=False, xaxis=_time_axis(history, theme), yaxis=up)


def _time_axis(history: RobotHistory, theme: ColourTheme) -> dict[str, Any]:
    shown = [max(0.0, history.now - _ERROR_SECONDS), max(history.now, 10.0)]
    return axis(theme, "robot's time [s]", range=shown)


def _path(states: Sequence[Sequence[float]], colour: str, width: float, name: str) -> dict[str, Any]:
    return curve([v[0] for v in states], [v[1] for v in states], colour, width, f"{name}{_HOVER}")


def _dot(
    position: Sequence[float], name: str, colour: str, symbol: str, size: float, angle: float = 0.0
) -> dict[str, Any]:
    look = {"color": colour, "size": size, "symbol": symbol, "angle": angle}
    return markers([position[0]], [position[1]], look, name=name, hovertemplate=f"{name}<extra></extra>")


def _circle(x: float, y: float, radius: float, theme: ColourTheme) -> dict[str, Any]:
    ends = {"x0": x - radius, "x1": x + radius, "y0": y - radius, "y1": y + radius}
    return {"type": "circle", **ends, "fillcolor": theme.dim, "opacity": 0.6, "line": {"width": 0}}
