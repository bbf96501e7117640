"""The live figures: the robot in its field, and the error with its band along time."""

from __future__ import annotations

import math
from typing import Any

from safedpa_services.workbench.live_book import RobotBook
from safedpa_services.workbench.look import CONFIG, Look, axis, frame

__all__ = ["error_figure", "evidence_figure", "field_figure"]

_TRAIL = 20.0
"""s of the path that are drawn."""
_SPAN = 120.0
"""s of the error that are drawn."""


def field_figure(book: RobotBook, look: Look) -> dict[str, Any]:
    """The plane: path, robot, load, obstacles, goal, and what the filter's model predicts."""
    state = book.state
    trail = [values for t, values in book.path if t > book.now - _TRAIL]
    data = [_line([v[0] for v in trail], [v[1] for v in trail], look.measured, 2.5, "driven")]
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


def error_figure(book: RobotBook, look: Look) -> dict[str, Any]:
    """The one-second error, the edge of its band, and marks where something happened."""
    kept = [entry for entry in book.errors if entry[0] > book.now - _SPAN]
    t = [entry[0] for entry in kept]
    band = [entry[2] if entry[2] > 0 else None for entry in kept]
    data = [
        _line(t, band, look.given, 1.5, "end of its band", "dash"),
        _line(t, [entry[1] or None for entry in kept], look.present, 2.5, "error over 1 s"),
    ]
    known = [entry for entry in kept if entry[2] > 0] or kept  # while it learns what is usual, a start may be wild
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


def evidence_figure(book: RobotBook, look: Look) -> dict[str, Any]:
    """The sequential test: log of the e-value and the threshold at which a finding is raised."""
    kept = [entry for entry in book.errors if entry[0] > book.now - _SPAN]
    t = [entry[0] for entry in kept]
    top = max([entry[4] for entry in kept] + [1.0])
    data = [
        _line(t, [entry[4] for entry in kept], look.given, 1.5, "threshold", "dash"),
        _line(t, [min(entry[3], 1.6 * top) for entry in kept], look.text, 2.0, "evidence"),
    ]
    layout = frame(
        look,
        dragmode=False,
        xaxis=axis(look, "robot's time [s]", range=[max(0.0, book.now - _SPAN), max(book.now, 10.0)]),
        yaxis=axis(look, "evidence", range=[min([0.0, *(entry[3] for entry in kept)]) - 0.2, 1.7 * top], nticks=4),
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


def _circle(x: float, y: float, radius: float, look: Look) -> dict[str, Any]:
    return {"type": "circle", "x0": x - radius, "x1": x + radius, "y0": y - radius, "y1": y + radius,
            "fillcolor": look.dim, "opacity": 0.6, "line": {"width": 0}}  # fmt: skip


def _mark(t: float, colour: str, kind: str) -> dict[str, Any]:
    dash = "dot" if kind == "finding" else "solid"
    return {"type": "line", "x0": t, "x1": t, "yref": "paper", "y0": 0, "y1": 1,
            "line": {"color": colour, "width": 1.5, "dash": dash}}  # fmt: skip
