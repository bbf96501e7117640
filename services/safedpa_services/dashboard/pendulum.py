"""Shapes of the pendulum: rod and sector, estimated wind, and the phase plane with the safe set."""

from __future__ import annotations

import math
from collections.abc import Sequence

from safedpa.bus import LatentMessage, StateMessage
from safedpa.drawing import Discs, Lines, Point, Rings
from safedpa_services.dashboard.display_settings import DisplaySettings
from safedpa_services.dashboard.palette import (
    GREEN,
    GREY,
    ORANGE,
    SKY,
    VERMILION,
    YELLOW,
    faded,
)
from safedpa_services.dashboard.shapes import TimelineEntry, drawable

_ARC_STEP = math.radians(4.0)
_COMPASS, _COMPASS_RADIUS, _COMPASS_SPEED = (-1.12, 1.12), 0.26, 5.0
"""Centre and radius of the wind's compass in rod lengths, and the wind speed of its ring [m/s]."""
_FASTEST = 12.0
"""Largest rate in the phase plane [rad/s]."""


def _at(angle: float, radius: float = 1.0) -> Point:
    """Returns the point at an angle, counted counter-clockwise from upright."""
    return -radius * math.sin(angle), radius * math.cos(angle)


def _corridor(state: StateMessage) -> tuple[float, float] | None:
    if len(state.corridor) != 2 or not drawable(*state.corridor) or state.corridor[0] >= state.corridor[1]:
        return None
    return state.corridor[0], state.corridor[1]


def _goal(state: StateMessage) -> float | None:
    return state.goal[0] if len(state.goal) == 1 and drawable(*state.goal) else None


def sector_entries(state: StateMessage, display: DisplaySettings) -> list[TimelineEntry]:
    """Returns what changes seldom: allowed angles green, forbidden ones red, goal, safe set in the phase plane."""
    corridor, goal = _corridor(state), _goal(state)
    marks = (_at(goal),) if goal is not None else ()
    entries = [TimelineEntry(("world", "goal"), Rings(marks * 2, (0.13, 0.05) if marks else (), YELLOW, 0.012))]
    entries.append(TimelineEntry(("world", "compass"), Rings((_COMPASS,), (_COMPASS_RADIUS,), GREY, 0.004)))
    if corridor is None:
        return entries
    low, high = corridor
    strips, colours = [_arc(low, high, 1.15)], [GREEN]
    forbidden = low + 2 * math.pi
    if high < forbidden:
        strips += [_arc(high, forbidden, radius) for radius in (0.55, 0.75, 0.95, 1.15)]
        colours += [faded(VERMILION, 0.55)] * 3 + [VERMILION]
        strips += [((0.0, 0.0), _at(edge, 1.15)) for edge in corridor]
        colours += [VERMILION] * 2
    entries.append(TimelineEntry(("world", "sector"), Lines(tuple(strips), tuple(colours), 0.012)))
    return [*entries, *_safe_set(corridor, goal, display)]


def _arc(start: float, end: float, radius: float) -> tuple[Point, ...]:
    steps = max(2, math.ceil(min(end - start, 2 * math.pi) / _ARC_STEP))
    return tuple(_at(start + share / steps * min(end - start, 2 * math.pi), radius) for share in range(steps + 1))


def _safe_set(corridor: tuple[float, float], goal: float | None, display: DisplaySettings) -> list[TimelineEntry]:
    """Returns the safe set.

    The y axis is the change of angle within the filter's look-ahead, so that h = 0 is at 45 degrees.
    """
    low, high = corridor
    reach = display.corridor_seconds * _FASTEST
    # {low <= angle <= high, low <= angle + ahead <= high}
    outline = tuple((x, y) for x, y in ((low, 0.0), (low, high - low), (high, 0.0), (high, low - high), (low, 0.0)))
    edges = [((edge, -reach), (edge, reach)) for edge in corridor]
    axis = ((low, 0.0), (high, 0.0))
    colours = (ORANGE, VERMILION, VERMILION, faded(GREY, 0.6))
    entries = [TimelineEntry(("phase", "safe_set"), Lines((outline, *edges, axis), colours, 0.006 * (high - low)))]
    if goal is not None:
        entries.append(TimelineEntry(("phase", "goal"), Rings(((goal, 0.0),), (0.08,), YELLOW, 0.012)))
    return entries


def phase_bounds(state: StateMessage, display: DisplaySettings) -> tuple[float, float, float, float] | None:
    """Returns the bounds of the phase plane: lowest and highest angle, then its change; None without a corridor."""
    corridor = _corridor(state)
    if corridor is None:
        return None
    room = 0.1 * (corridor[1] - corridor[0])
    reach = min(display.corridor_seconds * _FASTEST, 0.6 * (corridor[1] - corridor[0]))
    return corridor[0] - room, corridor[1] + room, -reach, reach


def phase_state(state: StateMessage, display: DisplaySettings) -> list[TimelineEntry]:
    """Returns the point of the current state in the phase plane."""
    point = phase_point(state.values, display)
    return [] if point is None else [TimelineEntry(("phase", "now"), Discs((point,), (0.03,), SKY))]


def phase_point(values: Sequence[float], display: DisplaySettings) -> Point | None:
    """Returns a state's point in the phase plane: angle, and its change within the filter's look-ahead."""
    if len(values) != 2 or not drawable(*values):
        return None
    return values[0], display.corridor_seconds * values[1]


def wind_entry(latent: LatentMessage, display: DisplaySettings) -> TimelineEntry | None:
    """Returns the wind that the latent represents as an arrow; None if it represents none."""
    wind = display.wind(latent.values)
    if wind is None or not drawable(*wind):
        return None
    scale = _COMPASS_RADIUS / _COMPASS_SPEED
    x, y = -scale * wind[0], scale * wind[1]
    tip = (_COMPASS[0] + x, _COMPASS[1] + y)
    barbs = tuple((tip[0] - 0.3 * x + 0.2 * side * y, tip[1] - 0.3 * y - 0.2 * side * x) for side in (-1.0, 1.0))
    strips = ((_COMPASS, tip), (barbs[0], tip, barbs[1]))
    return TimelineEntry(("world", "wind"), Lines(strips, (SKY,), 0.014))
