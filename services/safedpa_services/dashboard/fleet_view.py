"""Every robot of the fleet: what arrived in, frames out. Nothing here draws, waits or raises on a strange message."""

from __future__ import annotations

from dataclasses import dataclass, field

from safedpa.bus import HEALTH, NO_ROBOT, STATE, HealthMessage, Received, Refused, StateMessage
from safedpa_services.dashboard.look import Look
from safedpa_services.dashboard.palette import ORANGE
from safedpa_services.dashboard.pendulum import phase_bounds
from safedpa_services.dashboard.robot_view import RobotView
from safedpa_services.dashboard.shapes import Entry, Frame, Note
from safedpa_services.dashboard.thinner import Pace, Thinner
from safedpa_services.dashboard.time_line import TimeLine
from safedpa_services.dashboard.world import field_of

__all__ = ["FleetView", "Scene"]

MOST_ROBOTS = 32
"""Robots that are drawn; a flood of names must not fill the memory."""

_TOLD_REFUSALS = 20
"""Lines in the log about refused messages per robot; the rest is counted."""

Scene = tuple[float, float, float, float]
"""The field: lowest x, highest x, lowest y, highest y in m; of a pendulum, the bounds of its phase plane in rad."""


@dataclass
class _Robot:
    view: RobotView
    thinner: Thinner = field(default_factory=Thinner)
    epoch: int | None = None
    refused: int = 0


class FleetView:
    """Turns received messages into frames, oldest first."""

    def __init__(self, look: Look) -> None:
        self._look = look
        self._robots: dict[str, _Robot] = {}
        self._time = TimeLine()
        self.pace = Pace()
        self.fields: dict[str, Scene] = {}
        """Robots that have sent a state, in order of appearance, with the field that their view shall show."""
        self.refused = 0

    def take(self, items: list[Received | Refused], now: float) -> list[Frame]:
        """Frames of what arrived until ``now`` [s], the dashboard's monotonic clock."""
        lag = max((now - item.at for item in items if isinstance(item, Received)), default=0.0)
        frames = self._pace_note(now) if self.pace.observe(lag, now) else []
        for item in items:
            if isinstance(item, Received) and item.robot == NO_ROBOT:
                frames += self._take_fleet_health(item)
            else:
                frames.append(self._refuse(item, now) if isinstance(item, Refused) else self._take(item))
        for name, robot in self._robots.items():
            silent = robot.view.health.silences(now)
            if silent:
                frames.append(Frame(self._time.now(now), _under(name, silent)))
        return [frame for frame in frames if frame.entries]

    @property
    def left_out(self) -> int:
        """Messages not drawn because drawing was behind."""
        return sum(robot.thinner.left_out for robot in self._robots.values())

    def _take(self, item: Received) -> Frame:
        message, nothing = item.message, Frame(0.0, ())
        robot = self._robots.get(item.robot)
        if robot is None and item.topic not in (STATE, HEALTH):
            return nothing
        entries: list[Entry] = []
        if robot is None:
            if len(self._robots) >= MOST_ROBOTS:
                return nothing
            robot = self._robots[item.robot] = _Robot(RobotView(self._look))
            entries = robot.view.start()
        if isinstance(message, StateMessage):
            self._know_field(item.robot, message)
            robot.epoch = message.epoch
        at = self._moment(item, robot)
        draw = item.topic is HEALTH or robot.thinner.draws(item.topic.name, message.robot_time, self.pace.factor)
        return Frame(at, _under(item.robot, entries + robot.view.take(message, item.at, draw=draw)))

    def _take_fleet_health(self, item: Received) -> list[Frame]:
        message = item.message
        if not isinstance(message, HealthMessage) or message.service == "dashboard":
            return []
        at = self._time.now(item.at)
        return [
            Frame(at, _under(name, robot.view.health.add(message, item.at, own=False)))
            for name, robot in self._robots.items()
        ]

    def _moment(self, item: Received, robot: _Robot) -> float:
        if item.topic is HEALTH or item.message.epoch != robot.epoch:
            return self._time.now(item.at)  # a heartbeat may be of a robot's earlier life
        return self._time.at(item.robot, item.message.epoch, item.message.robot_time, item.at)

    def _know_field(self, name: str, state: StateMessage) -> None:
        if name not in self.fields:
            own = phase_bounds(state, self._look) if self._look.is_pendulum else field_of(state)
            self.fields[name] = own or (-1.4, 1.4, -1.4, 1.4)

    def _refuse(self, item: Refused, now: float) -> Frame:
        self.refused += 1
        robot = self._robots.get(item.robot)
        if robot is None:
            return Frame(0.0, ())
        robot.refused += 1
        if robot.refused > _TOLD_REFUSALS:
            return Frame(0.0, ())
        last = " (further ones are not told)" if robot.refused == _TOLD_REFUSALS else ""
        note = Note(f"refused {item.reason[:200]}{last}", ORANGE, "WARN")
        return Frame(self._time.now(now), _under(item.robot, [Entry(("log",), note)]))

    def _pace_note(self, now: float) -> list[Frame]:
        factor = self.pace.factor
        text = "dashboard: every picture is drawn" if factor == 1 else f"dashboard: behind, draws one in {factor}"
        note = Note(f"{text}; {self.left_out} left out so far", ORANGE, "INFO" if factor == 1 else "WARN")
        return [Frame(self._time.now(now), _under(name, [Entry(("log",), note)])) for name in self.fields]


def _under(robot: str, entries: list[Entry]) -> tuple[Entry, ...]:
    return tuple(Entry(("robots", robot, *entry.path), entry.shape, entry.static) for entry in entries)
