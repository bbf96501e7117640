"""What the live page says in tables and bars: the error before and after a change, what happened when, the drive."""

from __future__ import annotations

from safedpa_services.workbench.elements import escaped
from safedpa_services.workbench.live_book import RobotBook
from safedpa_services.workbench.look import Look

__all__ = ["change_lines", "driven_lines", "error_bars", "field_legend"]

_SECONDS = 5
"""Errors of which the median is shown as the present one."""


def error_bars(book: RobotBook) -> str:
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


def field_legend(look: Look) -> str:
    """What the lines and signs of the field mean."""
    lines = (("driven", look.measured), ("predicted by the filter's model", look.present))
    spans = "".join(f'<span><i style="border-color:{colour}"></i>{name}</span>' for name, colour in lines)
    return f"{spans}<span>★ goal</span>"


def driven_lines(book: RobotBook) -> str:
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


def change_lines(book: RobotBook) -> str:
    """What happened, the newest first."""
    lines = [
        f'<div class="mark {mark.kind}"><b>{mark.t:.0f} s</b> {escaped(mark.text)}</div>'
        for mark in reversed(book.marks)
    ]
    return "".join(lines[:20]) or '<div class="quiet">none yet</div>'
