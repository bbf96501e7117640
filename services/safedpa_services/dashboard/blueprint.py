"""How the panes of a robot are arranged."""

from __future__ import annotations

from typing import Any

import rerun as rr
import rerun.blueprint as rrb
from rerun.encodings import TimeRange

from safedpa.systems import Variable
from safedpa_services.dashboard.curves import legend_names
from safedpa_services.dashboard.fleet_view import Scene
from safedpa_services.dashboard.look import Look

__all__ = ["MOST_TABS", "TIME_LINE", "blueprint_of"]

TIME_LINE = "t"
MOST_TABS = 8
"""Robots with a tab; of further ones everything is recorded, and a pane can be added by hand."""

_SHOWN_SECONDS = 20.0
_PANE_POINTS, _LETTER_POINTS, _FRAME_POINTS = 370.0, 6.8, 46.0
"""Widths of a plot in a window of 1400, of a letter of its legend, and of the legend's frame."""
_BACKGROUND = [24, 26, 30]
_LOG_COLUMNS = rrb.TextLogColumns(timeline_columns=[], text_log_columns=["Body"])


def blueprint_of(fields: dict[str, Scene], look: Look) -> rrb.Blueprint:
    """One tab for each of the first robots; a page that says what is awaited while there is none."""
    tabs = [_tab(name, scene, look) for name, scene in list(fields.items())[:MOST_TABS]]
    waiting = rrb.TextDocumentView(origin="/waiting", name="waiting for a robot")
    return rrb.Blueprint(
        rrb.Tabs(*tabs) if tabs else waiting,
        rrb.TopPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=TIME_LINE, play_state="following"),
        auto_views=False,
    )


def _tab(name: str, scene: Scene, look: Look) -> Any:
    origin = str(rr.new_entity_path(["robots", name]))
    words = rrb.Tabs(
        rrb.TextDocumentView(origin=f"{origin}/now", name="now, and said last"),
        rrb.TextLogView(origin=f"{origin}/log", name="all that changed", columns=_LOG_COLUMNS),
        rrb.TextDocumentView(origin="/meaning", name="what the panes mean"),
        active_tab=0,
    )
    planes = _planes(origin, scene, look)
    left = rrb.Vertical(*planes, words, row_shares=[2.0, 1.7, 1.3] if look.is_pendulum else [3.4, 1.5])
    middle = rrb.Vertical(
        _curves(f"{origin}/barrier", f"room left h{_bracketed(look.h_unit)}: keep above the margin", 11),
        *[_action(origin, variable) for variable in look.system.action],
        _lanes(f"{origin}/verdict", "verdict, diagnosis, model"),
        row_shares=[1.2, *(1.2 for _ in look.system.action), 1.6],
    )
    right = rrb.Vertical(
        _curves(f"{origin}/latent", "estimate, one sigma", max(map(len, legend_names(look)), default=0)),
        _curves(
            f"{origin}/residual", "measured - predicted", max(len(v.name) + len(v.unit) + 3 for v in look.system.state)
        ),
        _curves(f"{origin}/diagnosis/error", "error over 1 s [of its usual change]", 15),
        _curves(f"{origin}/steps", "time of a step [ms]", 13),
        _lanes(f"{origin}/services", "services"),
        row_shares=[0.75, 1.2, 0.7, 1.2, 1.6],
    )
    return rrb.Horizontal(left, middle, right, column_shares=[1.48, 1, 1], name=name)


def _bracketed(unit: str) -> str:
    return f" [{unit.strip()}]" if unit else ""


def _action(origin: str, variable: Variable) -> Any:
    return _curves(f"{origin}/action/{variable.name}", f"{variable.name} [{variable.unit}]: wished and let through", 8)


def _planes(origin: str, scene: Scene, look: Look) -> list[Any]:
    if not look.is_pendulum:
        return [_plane(origin, "world", "world from above [m]", scene)]
    seconds = f"{look.corridor_seconds:g} s"
    return [
        _plane(origin, "world", "pendulum and the wind as estimated (ring: 5 m/s)", (-1.4, 1.4, -1.25, 1.4)),
        _plane(origin, "phase", f"angle across, angle gained in {seconds} up [rad]; safe set orange", scene),
    ]


def _plane(origin: str, part: str, title: str, scene: Scene) -> Any:
    low_x, high_x, low_y, high_y = scene
    edge = 0.04 * max(high_x - low_x, high_y - low_y)
    trail = rrb.VisibleTimeRanges([_last_seconds()])
    return rrb.Spatial2DView(
        origin=origin,
        contents=[f"{origin}/{part}/**"],
        name=title,
        background=_BACKGROUND,
        visual_bounds=rrb.VisualBounds2D(
            x_range=[low_x - edge, high_x + edge], y_range=[-high_y - edge, -low_y + edge]
        ),
        overrides={f"{origin}/{part}/trail": [trail]},
    )


def _curves(origin: str, name: str, letters: int) -> Any:
    """The curves end at the cursor; a legend of so many letters stands right of it, where there is nothing to cover."""
    share = min((_LETTER_POINTS * letters + _FRAME_POINTS) / _PANE_POINTS, 0.6)
    seconds = rrb.TimeRangeBoundary.cursor_relative
    shown = TimeRange(
        start=seconds(seconds=-_SHOWN_SECONDS), end=seconds(seconds=_SHOWN_SECONDS * share / (1.0 - share))
    )
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        time_ranges=[_last_seconds()],
        axis_x=rrb.archetypes.TimeAxis(view_range=shown),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
    )


def _lanes(origin: str, name: str) -> Any:
    return rrb.StateTimelineView(origin=origin, name=name, time_ranges=[_last_seconds()])


def _last_seconds() -> Any:
    return rrb.VisibleTimeRange(
        TIME_LINE,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-_SHOWN_SECONDS),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
