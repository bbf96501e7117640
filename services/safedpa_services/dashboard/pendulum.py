"""The pendulum's own pictures: rod and sector, the wind as it is estimated, the phase plane with the safe set."""

from __future__ import annotations

import math
from itertools import pairwise

from safedpa.bus import LatentMessage, StateMessage, VerdictMessage
from safedpa_services.dashboard.geometry import drawable
from safedpa_services.dashboard.look import DisplaySettings
from safedpa_services.dashboard.palette import (
    GREEN,
    GREY,
    INK,
    ORANGE,
    SKY,
    UNKNOWN_STATUS,
    VERDICT_COLOURS,
    VERMILLION,
    YELLOW,
    faded,
)
from safedpa_services.dashboard.shapes import Discs, Lines, Point, Rings, TimelineEntry

__all__ = ["phase_bounds", "phase_history", "phase_prediction", "phase_state", "sector_entries", "wind_entry"]

_ARC_STEP = math.radians(4.0)
_COMPASS, _COMPASS_RADIUS, _COMPASS_SPEED = (-1.12, 1.12), 0.26, 5.0
"""Where the wind's arrow is, in lengths of the rod; its ring stands for so many m/s."""
_FASTEST = 12.0
"""rad/s; the edge of the phase plane."""
_LARGEST_STEP = 1.0
"""rad between two drawn states; beyond it a new swing has begun."""


def _at(angle: float, radius: float = 1.0) -> Point:
    """In the picture, angles grow counter-clockwise from upright."""
    return -radius * math.sin(angle), radius * math.cos(angle)


def _corridor(state: StateMessage) -> tuple[float, float] | None:
    if len(state.corridor) != 2 or not drawable(*state.corridor) or state.corridor[0] >= state.corridor[1]:
        return None
    return state.corridor[0], state.corridor[1]


def _goal(state: StateMessage) -> float | None:
    return state.goal[0] if len(state.goal) == 1 and drawable(*state.goal) else None


def sector_entries(state: StateMessage, look: DisplaySettings) -> list[TimelineEntry]:
    """Allowed angles green, the hazard hatched red, the goal; the safe set of the phase plane: what changes seldom."""
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
        colours += [faded(VERMILLION, 0.55)] * 3 + [VERMILLION]
        strips += [((0.0, 0.0), _at(edge, 1.15)) for edge in corridor]
        colours += [VERMILLION] * 2
    entries.append(TimelineEntry(("world", "sector"), Lines(tuple(strips), tuple(colours), 0.012)))
    return [*entries, *_safe_set(corridor, goal, look)]


def _arc(start: float, end: float, radius: float) -> tuple[Point, ...]:
    steps = max(2, math.ceil(min(end - start, 2 * math.pi) / _ARC_STEP))
    return tuple(_at(start + share / steps * min(end - start, 2 * math.pi), radius) for share in range(steps + 1))


def _safe_set(corridor: tuple[float, float], goal: float | None, look: DisplaySettings) -> list[TimelineEntry]:
    """Angle across; up, the angle that is gained in the filter's time ahead, so that h = 0 falls at 45 degrees."""
    low, high = corridor
    reach = look.corridor_seconds * _FASTEST
    # {low <= angle <= high, low <= angle + ahead <= high}
    outline = tuple((x, y) for x, y in ((low, 0.0), (low, high - low), (high, 0.0), (high, low - high), (low, 0.0)))
    edges = [((edge, -reach), (edge, reach)) for edge in corridor]
    axis = ((low, 0.0), (high, 0.0))
    colours = (ORANGE, VERMILLION, VERMILLION, faded(GREY, 0.6))
    entries = [TimelineEntry(("phase", "safe_set"), Lines((outline, *edges, axis), colours, 0.006 * (high - low)))]
    if goal is not None:
        entries.append(TimelineEntry(("phase", "goal"), Rings(((goal, 0.0),), (0.08,), YELLOW, 0.012)))
    return entries


def phase_bounds(state: StateMessage, look: DisplaySettings) -> tuple[float, float, float, float] | None:
    """(lowest, highest angle, lowest, highest angle ahead) that the phase plane shows; None without a corridor."""
    corridor = _corridor(state)
    if corridor is None:
        return None
    room = 0.1 * (corridor[1] - corridor[0])
    reach = min(look.corridor_seconds * _FASTEST, 0.6 * (corridor[1] - corridor[0]))
    return corridor[0] - room, corridor[1] + room, -reach, reach


def phase_state(state: StateMessage, look: DisplaySettings) -> list[TimelineEntry]:
    """Where it is now."""
    place = _in_phase(state.values, look)
    return [] if place is None else [TimelineEntry(("phase", "now"), Discs((place,), (0.03,), SKY))]


def phase_history(before: StateMessage, now: StateMessage, status: str, look: DisplaySettings) -> TimelineEntry | None:
    """The stretch between two drawn states in the colour of the verdict over it; None without one."""
    ends = [_in_phase(state.values, look) for state in (before, now)]
    if ends[0] is None or ends[1] is None or abs(ends[1][0] - ends[0][0]) > _LARGEST_STEP:
        return None
    colour = VERDICT_COLOURS.get(status, UNKNOWN_STATUS)
    return TimelineEntry(("phase", "history"), Lines(((ends[0], ends[1]),), (colour,), 0.012))


def phase_prediction(verdict: VerdictMessage, look: DisplaySettings) -> TimelineEntry:
    """The predicted next states as a line."""
    places = [_in_phase(row, look) for row in verdict.predicted[:64]]
    points = tuple(place for place in places if place is not None)
    strips = (points,) if len(points) > 1 and any(a != b for a, b in pairwise(points)) else ()
    return TimelineEntry(("phase", "predicted"), Lines(strips, (VERDICT_COLOURS.get(verdict.status, INK),), 0.012))


def _in_phase(values: tuple[float, ...], look: DisplaySettings) -> Point | None:
    if len(values) != 2 or not drawable(*values):
        return None
    return values[0], look.corridor_seconds * values[1]


def wind_entry(latent: LatentMessage, look: DisplaySettings) -> TimelineEntry | None:
    """The wind that the latent stands for, as an arrow; the compass' ring is 5 m/s. None where it stands for none."""
    wind = look.wind(latent.values)
    if wind is None or not drawable(*wind):
        return None
    scale = _COMPASS_RADIUS / _COMPASS_SPEED
    x, y = -scale * wind[0], scale * wind[1]
    tip = (_COMPASS[0] + x, _COMPASS[1] + y)
    barbs = tuple((tip[0] - 0.3 * x + 0.2 * side * y, tip[1] - 0.3 * y - 0.2 * side * x) for side in (-1.0, 1.0))
    strips = ((_COMPASS, tip), (barbs[0], tip, barbs[1]))
    return TimelineEntry(("world", "wind"), Lines(strips, (SKY,), 0.014))
