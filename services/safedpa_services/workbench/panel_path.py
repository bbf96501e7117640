"""The first column: the robot and its prediction.

Its figures: the path from a chosen start, measured and predicted, and the states along time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from nicegui import events, ui

from safedpa.arrays import FloatArray
from safedpa.comparison.rollout import rollout
from safedpa.comparison.summary import shortened
from safedpa.comparison.where import PLACE
from safedpa_services.workbench.elements import action, escaped, named, panel, text
from safedpa_services.workbench.look import CONFIG, ColourTheme, axis, frame
from safedpa_services.workbench.session import Session

__all__ = ["Excerpt", "PathPanel", "curves_figure", "excerpt_of", "path_figure"]


class PathPanel:
    """Path and states from a chosen start, measured and predicted."""

    def __init__(self, on_start: Callable[[int], None], on_worst: Callable[[], None]) -> None:
        self._on_start = on_start
        with panel(1, "The robot and its prediction"):
            self._where = text("", "quiet one-line")
            self._legend = ui.html(sanitize=False).classes("legend")
            self._path = (
                ui.plotly({"data": []}).classes("grow").props('role=img aria-label="Path, measured and predicted"')
            )
            self._curves = ui.plotly({"data": []}).classes("grow").props('role=img aria-label="States along time"')
            with ui.element("div").classes("row tight"):
                action("◀", lambda: self._move(-1), "←", hint="previous start")
                self._slider = named(ui.slider(min=0, max=1, value=0).props("dense"), "start of the prediction")
                self._slider.on("update:model-value", self._slid, throttle=0.12)
                action("▶", lambda: self._move(1), "→", hint="next start")
                action("Worst", on_worst, "w", hint="start with the largest error in the selection")

    def _slid(self, event: events.GenericEventArguments) -> None:
        self._on_start(int(event.args))

    def _move(self, by: int) -> None:
        self._on_start(int(self._slider.value) + by)

    def show(self, session: Session, look: ColourTheme) -> None:
        """Draws everything again."""
        found = excerpt_of(session)
        notice = f"{session.horizon:g} s ahead from {found.moment:.2f} s of {shortened(found.run, 22)}"
        self._where.set_content(escaped(notice))
        self._where.props(f'title="{escaped(found.run)}"')
        self._legend.set_content(_legend(session, look))
        self._slider.props(f"max={len(session.comparison.windows) - 1}")
        self._slider.value = session.start
        path = path_figure(session, found, look)
        self._path.set_visibility(path is not None)
        if path is not None:
            self._path.update_figure(path)
        self._curves.update_figure(curves_figure(session, found, look))


def _legend(session: Session, look: ColourTheme) -> str:
    lines = [("measured", look.measured, "solid"), ("model", look.present, "solid")]
    if session.number:
        lines.append(("given model", look.given, "dashed"))
    if session.number > 1:
        lines.append(("between", look.between, "dotted"))
    return "".join(
        f'<span><i style="border-color:{colour};border-top-style:{style}"></i>{name}</span>'
        for name, colour, style in lines
    )


_PAST = 0.5
"""Horizons before the start that are drawn."""
_AFTER = 0.5
_SMALLEST = 0.6
"""m; half the side of the piece of plane that is shown at least."""


@dataclass(frozen=True)
class Excerpt:
    """What was measured around the chosen start and what each version predicts from it."""

    run: str
    moment: float
    """s since the start of the run."""
    t: FloatArray
    """s from the start, (rows,)."""
    measured: FloatArray
    """(rows, states)"""
    whole: FloatArray
    """The run's path, (rows, 2); without rows for a robot that does not move about."""
    predicted: list[tuple[str, FloatArray, FloatArray]]
    """(version, s from the start (steps + 1,), states (steps + 1, states))"""


def excerpt_of(session: Session) -> Excerpt:
    """The start that the session shows."""
    windows = session.comparison.windows
    one = windows.select(np.array([session.start]))
    start, steps, run = int(one.start[0]), int(one.steps[0]), int(one.run[0])
    begin = int(one.begin[0])
    stop = int(windows.bounds[np.searchsorted(windows.bounds[:, 1], start, side="right"), 1])
    seconds = windows.time - windows.time[start]
    horizon = windows.horizon
    rows = np.arange(begin, stop)
    rows = rows[(seconds[rows] >= -_PAST * horizon) & (seconds[rows] <= (1.0 + _AFTER) * horizon)]
    ahead = np.arange(start, start + steps + 1)
    predicted = []
    for version in session.versions:
        states = rollout(version.model, version.comparison.windows.select(np.array([session.start])))[:, 0]
        predicted.append((version.label, seconds[ahead], states))
    return Excerpt(
        windows.names[run], float(windows.time[start]), seconds[rows], windows.states[rows], _whole(session, run),
        predicted,
    )  # fmt: skip


def _whole(session: Session, run: int) -> FloatArray:
    windows = session.comparison.windows
    names = windows.system.state_names
    if not set(PLACE) <= set(names):
        return np.zeros((0, 2))
    starts = windows.start[windows.run == run]
    place = [names.index(name) for name in PLACE]
    return windows.states[np.ix_(starts, place)]


def path_figure(session: Session, found: Excerpt, look: ColourTheme) -> dict[str, Any] | None:
    """The plane; None for a robot that does not move about."""
    if not len(found.whole):
        return None
    names = session.comparison.windows.system.state_names
    x, y = (names.index(name) for name in PLACE)
    thin = found.whole[:: max(1, len(found.whole) // 800)]
    data = [_trace(thin[:, 0], thin[:, 1], look.dim, 1.0, "whole run", hover=False)]
    data.append(_trace(found.measured[:, x], found.measured[:, y], look.measured, 3.5, "measured"))
    for number, (label, _, states) in enumerate(found.predicted):
        colour, width, dash = _style(session, number, look)
        data.append(_trace(states[:, x], states[:, y], colour, width, label, dash))
    now = found.predicted[0][2][0]
    dot = {"size": 9, "color": look.measured, "line": {"width": 2, "color": look.grid}}
    data.append({"type": "scatter", "mode": "markers", "x": [float(now[x])], "y": [float(now[y])], "marker": dot,
                 "hovertemplate": "start<extra></extra>"})  # fmt: skip
    near = np.concatenate([found.measured[:, [x, y]], *(states[:, [x, y]] for _, _, states in found.predicted[-1:])])
    near = near[np.isfinite(near).all(axis=1)]
    middle = 0.5 * (near.max(axis=0) + near.min(axis=0))
    half = max(_SMALLEST, 0.62 * float(np.ptp(near, axis=0).max()))
    layout = frame(
        look,
        dragmode=False,
        xaxis=axis(look, "x [m]", range=[float(middle[0] - half), float(middle[0] + half)], constrain="domain"),
        yaxis=axis(
            look,
            "y [m]",
            range=[float(middle[1] - half), float(middle[1] + half)],
            scaleanchor="x",
            constrain="domain",
        ),
        margin={"l": 66, "r": 8, "t": 6, "b": 38},  # room for wide numbers; automargin would never settle next to x
    )
    return {"data": data, "layout": layout, "config": CONFIG}


def curves_figure(session: Session, found: Excerpt, look: ColourTheme) -> dict[str, Any]:
    """Every state but the place along time, one panel each."""
    states = session.comparison.windows.system.state
    shown = [index for index, state in enumerate(states) if not (len(found.whole) and state.name in PLACE)]
    data = []
    layout = frame(
        look,
        dragmode=False,
        grid={"rows": len(shown), "columns": 1, "pattern": "independent", "ygap": 0.2},
        margin={"l": 56, "r": 8, "t": 6, "b": 36},
    )
    for place, index in enumerate(shown):
        suffix = "" if place == 0 else str(place + 1)
        axes = {"xaxis": f"x{suffix}", "yaxis": f"y{suffix}"}
        data.append(_trace(found.t, found.measured[:, index], look.measured, 3.0, "measured") | axes)
        for number, (label, t, predicted) in enumerate(found.predicted):
            colour, width, dash = _style(session, number, look)
            data.append(_trace(t, predicted[:, index], colour, width, label, dash) | axes)
        last = place == len(shown) - 1
        layout[f"xaxis{suffix}"] = axis(look, "time from the start [s]" if last else "", showticklabels=last,
                                        range=[float(found.t[0]), float(found.t[-1])])  # fmt: skip
        layout[f"yaxis{suffix}"] = axis(look, f"{states[index].name} [{states[index].unit}]", nticks=4,
                                        range=_range(found, index))  # fmt: skip
    return {"data": data, "layout": layout, "config": CONFIG}


def _range(found: Excerpt, index: int) -> list[float]:
    """Both ends of what is measured and of what the last version predicts, with room; first versions may leave it."""
    parts = [found.measured[:, index], *(states[:, index] for _, _, states in found.predicted)]
    values = np.concatenate(parts)
    values = values[np.isfinite(values)]
    room = 0.06 * float(np.ptp(values)) + 1e-3
    return [float(values.min() - room), float(values.max() + room)]


def _style(session: Session, number: int, look: ColourTheme) -> tuple[str, float, str]:
    """Colour, width and dash of a version: the given one, those between, the one that is looked at."""
    looked_at = session.number if session.shown is None else session.shown
    if number == looked_at:
        return look.present, 2.5, "solid"
    return (look.given, 2.0, "dash") if number == 0 else (look.between, 1.2, "dot")


def _trace(x: FloatArray, y: FloatArray, colour: str, width: float, name: str, dash: str = "solid",
           *, hover: bool = True) -> dict[str, Any]:  # fmt: skip
    trace = {
        "type": "scatter",
        "mode": "lines",
        "x": [float(f"{value:.5g}") if np.isfinite(value) else None for value in x.tolist()],
        "y": [float(f"{value:.5g}") if np.isfinite(value) else None for value in y.tolist()],
        "line": {"color": colour, "width": width, "dash": dash},
        "name": name,
        "hovertemplate": f"{name}<br>%{{x:.2f}}, %{{y:.2f}}<extra></extra>",
    }
    return trace if hover else {**trace, "hoverinfo": "skip", "hovertemplate": None}
