"""Shapes of the world from above: field, obstacles, goal, robot, trail, prediction.

Also what perception sees: static and moving objects, hidden areas, zones, and the objects that limit the action.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from safedpa.bus import StateMessage, SurroundingsMessage
from safedpa.drawing import Discs, Lines, Point, Rings
from safedpa_services.dashboard.display_settings import DisplaySettings
from safedpa_services.dashboard.palette import (
    GREY,
    INK,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    YELLOW,
    faded,
)
from safedpa_services.dashboard.shapes import TimelineEntry, drawable

_MOST_OBSTACLES = 256
_LONGEST_STRETCH = 50.0
"""Longest drawn stopping distance [m]; a longer one is an error."""

_BODY_REAR, _BODY_FRONT, _BODY_WIDTH = -0.25, 1.25, 0.75
"""Drawn body in wheelbases, from the centre of the rear axle."""
_BALL, _NOSE = 0.1, 0.1
"""Radius of the point robot's ball and edge length of its nose [m]."""
_WHEEL_LENGTH, _WHEEL_WIDTH, _TRACK = 0.30, 0.10, 0.62
_ARC_POINTS = 12


@dataclass(frozen=True, slots=True)
class _Pose:
    """Position [m] and yaw [rad] of a body."""

    x: float
    y: float
    yaw: float

    def place(self, points: Sequence[Point]) -> tuple[Point, ...]:
        """Transforms points from the body's frame (ahead, left) to the world."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return tuple((self.x + c * ahead - s * left, self.y + s * ahead + c * left) for ahead, left in points)


def _rectangle(rear: float, front: float, width: float) -> tuple[Point, ...]:
    """Returns the closed outline of a rectangle from ``rear`` to ``front`` [m] ahead of the origin."""
    half = 0.5 * width
    return ((rear, -half), (front, -half), (front, half), (rear, half), (rear, -half))


def _capsule(rear: float, front: float, radius: float) -> tuple[Point, ...]:
    """Returns the closed outline of a capsule from ``rear`` to ``front`` ahead of the origin, with ``radius`` [m]."""
    angles = [math.pi * (step / _ARC_POINTS - 0.5) for step in range(_ARC_POINTS + 1)]
    nose = [(front + radius * math.cos(angle), radius * math.sin(angle)) for angle in angles]
    tail = [(rear - radius * math.cos(angle), -radius * math.sin(angle)) for angle in angles]
    return (*nose, *tail, nose[0])


def field_of(state: StateMessage) -> tuple[float, float, float, float] | None:
    """Returns (lowest x, highest x, lowest y, highest y) [m]; None if the message has no field that can be drawn."""
    if len(state.field) != 4 or not drawable(*state.field):
        return None
    low_x, high_x, low_y, high_y = state.field
    return (low_x, high_x, low_y, high_y) if low_x < high_x and low_y < high_y else None


def scene_entries(state: StateMessage, display: DisplaySettings) -> list[TimelineEntry]:
    """Returns what changes seldom: field, obstacles with the rings that the filter keeps free around them, goal."""
    entries = [TimelineEntry(("world", "goal"), _goal(state))]
    field = field_of(state)
    if field is not None:
        low_x, high_x, low_y, high_y = field
        corners = ((low_x, low_y), (high_x, low_y), (high_x, high_y), (low_x, high_y), (low_x, low_y))
        entries.append(TimelineEntry(("world", "field"), Lines((corners,), (GREY,), 0.015)))
    rows = [row for row in state.obstacles[:_MOST_OBSTACLES] if len(row) == 3 and drawable(*row) and row[2] >= 0.0]
    centres = tuple((row[0], row[1]) for row in rows)
    entries.append(TimelineEntry(("world", "obstacles"), Discs(centres, tuple(row[2] for row in rows), 0x6E7681FF)))
    reach = display.clearance
    if len(state.footprint) == 3 and drawable(*state.footprint):
        reach += abs(state.footprint[2])
    rings = Rings(centres, tuple(row[2] + reach for row in rows), faded(ORANGE, 0.7), 0.006)
    return [*entries, TimelineEntry(("world", "clearance"), rings)]


def _goal(state: StateMessage) -> Rings:
    there = len(state.goal) == 2 and drawable(*state.goal)
    x, y = (state.goal[0], state.goal[1]) if there else (0.0, 0.0)
    radii = (0.30, 0.16, 0.05) if there else ()
    return Rings(tuple((x, y) for _ in radii), radii, YELLOW, 0.012)


def body_entries(state: StateMessage, display: DisplaySettings) -> list[TimelineEntry]:
    """Returns the robot: outline and wheels, load and hitch, and the capsule that the filter keeps free."""
    if display.is_pendulum:
        return _pendulum(state)
    if len(state.values) < 2 or not drawable(*state.values[:2]):
        return []
    if display.drawn is not None:
        return [TimelineEntry(("world", name), shape) for name, shape in display.drawn(state).items()]
    if len(state.values) < 3:
        return []
    pose = _Pose(state.values[0], state.values[1], state.values[2])
    if display.is_point:
        return _point(pose)
    entries = [TimelineEntry(("world", "body"), _car(pose, state, display))]
    swept = _swept(pose, state, display)
    if swept is not None:
        entries.append(TimelineEntry(("world", "swept"), swept))
    load = _load(pose, state, display)
    return [*entries, TimelineEntry(("world", "load"), load)]


def _car(pose: _Pose, state: StateMessage, display: DisplaySettings) -> Lines:
    base = display.wheelbase or 0.3
    steer = state.applied[1] if len(state.applied) == 2 and display.system.action_names[1] == "steer" else 0.0
    outline = pose.place(_rectangle(_BODY_REAR * base, _BODY_FRONT * base, _BODY_WIDTH * base))
    nose = pose.place(((base, 0.0), (_BODY_FRONT * base, 0.0)))
    wheel = _rectangle(-0.5 * _WHEEL_LENGTH * base, 0.5 * _WHEEL_LENGTH * base, _WHEEL_WIDTH * base)
    strips = [outline, nose]
    for ahead, turn in ((0.0, 0.0), (base, steer)):
        for left in (-0.5 * _TRACK * base, 0.5 * _TRACK * base):
            strips.append(pose.place(_Pose(ahead, left, turn).place(wheel)))
    return Lines(tuple(strips), (INK, INK, GREY, GREY, YELLOW, YELLOW), 0.012)


def _point(pose: _Pose) -> list[TimelineEntry]:
    """Returns the point robot: a ball with a box as its nose."""
    nose = pose.place(_rectangle(_BALL - 0.5 * _NOSE, _BALL + 0.5 * _NOSE, _NOSE))
    ball = Rings(((pose.x, pose.y),), (_BALL,), INK, 0.012)
    return [TimelineEntry(("world", "nose"), Lines((nose,), (YELLOW,), 0.012)), TimelineEntry(("world", "ball"), ball)]


def _swept(pose: _Pose, state: StateMessage, display: DisplaySettings) -> Lines | None:
    swept = display.swept(state)
    if swept is None or not drawable(*swept) or max(map(abs, swept)) > _LONGEST_STRETCH:
        return None
    rear, front, radius = swept
    return Lines((pose.place(_capsule(rear, front, abs(radius))),), (faded(ORANGE, 0.7),), 0.006)


def _load(pose: _Pose, state: StateMessage, display: DisplaySettings) -> Lines:
    if len(state.load_pose) != 5 or not drawable(*state.load_pose):
        return Lines((), (), 0.012)
    x, y, yaw, length, width = state.load_pose
    load = _Pose(x, y, yaw)
    hitch = (*pose.place(((_BODY_REAR * (display.wheelbase or 0.3), 0.0),)), *load.place(((0.5 * length, 0.0),)))
    return Lines((load.place(_rectangle(-0.5 * length, 0.5 * length, width)), hitch), (PURPLE, PURPLE), 0.012)


def _pendulum(state: StateMessage) -> list[TimelineEntry]:
    if not state.values or not math.isfinite(state.values[0]):
        return []
    tip = (-math.sin(state.values[0]), math.cos(state.values[0]))
    rod = Lines((((0.0, 0.0), tip),), (INK,), 0.02)
    return [TimelineEntry(("world", "rod"), rod), TimelineEntry(("world", "tip"), Discs((tip,), (0.08,), SKY))]


_MOST = 512
"""Largest number of drawn discs per kind, and of vertices of zones."""
_MOST_ZONES = 64
"""Largest number of zones in a perception file."""
_KINDS = ("points", "movers", "hidden")


def seen_entries(seen: SurroundingsMessage) -> list[TimelineEntry]:
    """Returns discs of static and of possibly moving objects, rings of hidden areas, and the borders of zones."""
    points, movers, hidden = (_discs(getattr(seen, name)) for name in _KINDS)
    return [
        TimelineEntry(("world", "seen", "at_rest"), Discs(*points, GREY)),
        TimelineEntry(("world", "seen", "hidden"), Rings(*hidden, faded(PURPLE, 0.55), 0.008)),
        TimelineEntry(("world", "seen", "may_move"), Discs(*movers, faded(VERMILION, 0.75))),
        TimelineEntry(("world", "seen", "zones"), _zones(seen)),
    ]


def _zones(seen: SurroundingsMessage) -> Lines:
    """Returns the borders of the active zones: closed ones in the colour of obstacles, ignored ones in another."""
    strips, colours, rows = [], [], [row for row in seen.borders[:_MOST] if len(row) == 3]
    for number, name in enumerate(seen.zones[:_MOST_ZONES]):
        corners = [(row[1], row[2]) for row in rows if row[0] == number]
        if len(corners) > 2 and all(drawable(*corner) for corner in corners):
            strips.append((*corners, corners[0]))
            colours.append(INK if name.startswith("closed") else SKY)
    return Lines(tuple(strips), tuple(colours), 0.02, on_top=True)


def holding_entry(active: Sequence[str], seen: SurroundingsMessage | None, robot: Point | None) -> TimelineEntry:
    """Returns lines from the robot to the discs that limit its action."""
    ends = [place for name in active for place in _named(name, seen)]
    strips = () if robot is None else tuple((robot, end) for end in ends)
    colours = tuple(INK if _kind(name) == _KINDS[0] else ORANGE for name in active if _named(name, seen))
    return TimelineEntry(("world", "seen", "holds_back"), Lines(strips, colours[: len(strips)], 0.012, on_top=True))


def _named(name: str, seen: SurroundingsMessage | None) -> list[Point]:
    """Returns the position of the disc with this name: ``mover 3`` is the fourth of the movers."""
    kind, index = _kind(name), name.rpartition(" ")[2]
    if seen is None or not kind or not index.isdigit():
        return []
    rows = getattr(seen, kind)[int(index) : int(index) + 1]
    return [(row[0], row[1]) for row in rows if len(row) >= 2 and drawable(*row[:2])]


def _kind(name: str) -> str:
    """Returns the field of the message that has the disc of a barrier with this name; empty if there is none."""
    kind = name.partition(" ")[0]
    return next((field for field in _KINDS if field in (kind, f"{kind}s")), "")


def _discs(rows: Sequence[Sequence[float]]) -> tuple[tuple[Point, ...], tuple[float, ...]]:
    known = [row for row in rows[:_MOST] if len(row) >= 3 and drawable(*row[:3]) and row[2] >= 0.0]
    return tuple((row[0], row[1]) for row in known), tuple(row[2] for row in known)
