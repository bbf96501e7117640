"""Turns the messages of a fleet into frames. Nothing here draws, blocks, or raises on an unexpected message.

Entries that are drawn only when they change are drawn again every second, as keyframes. A viewer that joins late gets
the newest data first and only as much old data as the server's memory holds; the last second always shows everything.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from safedpa.bus import HEALTH, NO_ROBOT, STATE, HealthMessage, ReceivedMessage, RejectedMessage, StateMessage, Topic
from safedpa_services.dashboard.display_settings import DisplaySettings
from safedpa_services.dashboard.now_page import waiting_page
from safedpa_services.dashboard.palette import ORANGE
from safedpa_services.dashboard.pendulum import phase_bounds
from safedpa_services.dashboard.robot_view import RobotView
from safedpa_services.dashboard.shapes import MarkdownPage, Note, TimelineEntry, TimelineFrame
from safedpa_services.dashboard.world import field_of

SHORTEST_INTERVAL = 0.05
"""Shortest robot time between two drawn messages of one kind [s]."""

_BEHIND_SECONDS = 0.5
_CAUGHT_UP_SECONDS = 0.1
_CALM_SECONDS = 2.0
_LARGEST_FACTOR = 64


class DrawingRate:
    """The drawing rate of the dashboard: every ``factor``-th frame is drawn.

    The factor doubles while drawing is behind.
    """

    def __init__(self) -> None:
        self.factor = 1
        self._calm_since: float | None = None

    def observe(self, lag: float, now: float) -> bool:
        """Takes the delay of the oldest message [s]; returns whether the factor changed."""
        before = self.factor
        if lag > _BEHIND_SECONDS:
            self.factor = min(2 * self.factor, _LARGEST_FACTOR)
            self._calm_since = None
        elif lag > _CAUGHT_UP_SECONDS:
            self._calm_since = None
        elif self._calm_since is None:
            self._calm_since = now
        elif now - self._calm_since >= _CALM_SECONDS:
            self.factor = max(self.factor // 2, 1)
            self._calm_since = now
        return self.factor != before


class DrawingThrottle:
    """Decides which messages of one robot are drawn, and counts those that are left out because drawing is behind."""

    def __init__(self) -> None:
        self._last: dict[str, float] = {}
        self.left_out = 0

    def draws(self, kind: str, robot_time: float, factor: int) -> bool:
        """Returns whether a message stamped ``robot_time`` [s] is drawn."""
        last = self._last.get(kind)
        passed = None if last is None else robot_time - last
        if passed is None or passed < 0.0 or passed > 0.9 * factor * SHORTEST_INTERVAL:
            self._last[kind] = robot_time
            return True
        self.left_out += passed > 0.9 * SHORTEST_INTERVAL
        return False


_LARGEST_TIME = 1e9
"""s; about thirty years. Limits what a wrong stamp does to the time line."""


class TimeLine:
    """The time line of all robots: t = robot time + offset of the robot's epoch.

    The first robot's offset is 0. A robot that appears later or restarts begins at the current t, so that the view of
    the last seconds shows all robots, and a restarted robot does not overwrite its earlier data.
    """

    def __init__(self) -> None:
        self._offsets: dict[tuple[str, int], float] = {}
        self._newest: tuple[float, float] | None = None

    def now(self, clock: float) -> float:
        """Returns t at ``clock`` [s] of the dashboard's monotonic clock; 0 before the first robot."""
        return 0.0 if self._newest is None else self._newest[0] + (clock - self._newest[1])

    def at(self, robot: str, epoch: int, robot_time: float, clock: float) -> float:
        """Returns t of a message that arrived at ``clock``."""
        robot_time = max(-_LARGEST_TIME, min(robot_time, _LARGEST_TIME))
        key = (robot, epoch)
        if key not in self._offsets:
            self._offsets = {other: offset for other, offset in self._offsets.items() if other[0] != robot}
            self._offsets[key] = 0.0 if self._newest is None else self.now(clock) - robot_time
        moment = robot_time + self._offsets[key]
        if self._newest is None or moment > self._newest[0]:
            self._newest = (moment, clock)
        return moment

    def offset(self, robot: str, epoch: int) -> float:
        """Returns t - robot time [s]; 0 for an unknown epoch."""
        return self._offsets.get((robot, epoch), 0.0)


MOST_ROBOTS = 32
"""Number of robots that are drawn; bounds the memory against a flood of names."""

_REPORTED_REFUSALS = 20
"""Logged refusals per robot; further ones are only counted."""

KEYFRAME_SECONDS = 1.0
_QUIET_SECONDS = 10.0
"""Without any message for this long, no further keyframe is drawn, except for the text page with its ages."""

Scene = tuple[float, float, float, float]
"""Bounds of the shown field: lowest x, highest x, lowest y, highest y [m]; for a pendulum of its phase plane [rad]."""


@dataclass
class _RobotDisplay:
    view: RobotView
    throttle: DrawingThrottle = field(default_factory=DrawingThrottle)
    epoch: int | None = None
    refused: int = 0
    headline: str = ""
    """The headline of the page that was drawn last."""
    newest: dict[str, float] = field(default_factory=dict)
    """By topic: time of its last frame [s]. Keyframes are drawn at that time, so that none precedes a later change."""


class FleetView:
    """Turns received messages into frames, oldest first."""

    def __init__(self, display: DisplaySettings, fleet: str = "fleet") -> None:
        self._display = display
        self._fleet = fleet
        self._services: dict[str, str] = {}
        self._waiting = waiting_page(fleet, {})
        self._refusal = ""
        self._heard = 0.0
        self._next_keyframe = 0.0
        self._robots: dict[str, _RobotDisplay] = {}
        self._time = TimeLine()
        self.pace = DrawingRate()
        self.fields: dict[str, Scene] = {}
        """The shown field of each robot that has sent a state, in order of appearance."""
        self.refused = 0

    def take(
        self, items: list[ReceivedMessage | RejectedMessage], now: float, *, waited: float = 0.0
    ) -> list[TimelineFrame]:
        """Returns the frames of messages that arrived until ``now`` [s] of the dashboard's monotonic clock.

        :param waited: time [s] for which earlier frames have been waiting for a viewer
        """
        lag = max((waited, *(now - item.at for item in items if isinstance(item, ReceivedMessage))))
        frames = [self._waiting_frame()]
        frames += self._pace_note(now) if self.pace.observe(lag, now) else []
        self._heard = now if items else self._heard
        for item in items:
            if isinstance(item, ReceivedMessage) and item.robot == NO_ROBOT:
                frames += self._take_fleet_health(item)
            else:
                frames.append(self._refuse(item, now) if isinstance(item, RejectedMessage) else self._take(item))
        for name, robot in self._robots.items():
            silent = robot.view.silences(now)
            if silent:
                frames.append(self._frame(name, HEALTH, self._time.now(now), silent))
        if now >= self._next_keyframe:
            self._next_keyframe = now + KEYFRAME_SECONDS
            frames += self._keyframes(now) if now - self._heard < _QUIET_SECONDS else self._pages(now)
        else:
            frames += self._pages(now, changed=True)
        return [frame for frame in frames if frame.entries]

    def end(self, sentence: str, now: float) -> list[TimelineFrame]:
        """Returns the last frames, which show ``sentence`` as the reason why nothing more arrives."""
        frames = []
        for name in self.fields:
            robot = self._robots[name]
            robot.view.now.end(sentence)
            at = max(robot.newest.values(), default=0.0)
            frames.append(self._frame(name, None, at, [TimelineEntry(("log",), Note(sentence, ORANGE))]))
        if not self.fields:
            text = f"# Ended while waiting for a robot\n\n{sentence}"
            frames.append(TimelineFrame(0.0, (TimelineEntry(("waiting",), MarkdownPage(text), static=True),)))
        return [*frames, *self._keyframes(now)]

    @property
    def left_out(self) -> int:
        """Number of messages that were not drawn because drawing was behind."""
        return sum(robot.throttle.left_out for robot in self._robots.values())

    def _take(self, item: ReceivedMessage) -> TimelineFrame:
        message, nothing = item.message, TimelineFrame(0.0, ())
        robot = self._robots.get(item.robot)
        if robot is None and item.topic not in (STATE, HEALTH):
            return nothing
        entries: list[TimelineEntry] = []
        if isinstance(message, HealthMessage):
            self._note_service(f"{message.service} of {item.robot}", message.state)
        if robot is None:
            if len(self._robots) >= MOST_ROBOTS:
                return nothing
            robot = self._robots[item.robot] = _RobotDisplay(RobotView(self._display))
            entries = robot.view.start()
        if isinstance(message, StateMessage):
            self._note_field(item.robot, message)
            robot.epoch = message.epoch
        at = self._time_of(item, robot)
        draw = item.topic is HEALTH or robot.throttle.draws(item.topic.name, message.robot_time, self.pace.factor)
        return self._frame(item.robot, item.topic, at, entries + robot.view.take(message, item.at, draw=draw))

    def _take_fleet_health(self, item: ReceivedMessage) -> list[TimelineFrame]:
        message = item.message
        if not isinstance(message, HealthMessage) or message.service == "dashboard":
            return []
        self._note_service(message.service, message.state)
        at = self._time.now(item.at)
        return [
            self._frame(name, HEALTH, at, robot.view.health.add(message, item.at, own=False))
            for name, robot in self._robots.items()
        ]

    def _note_service(self, service: str, state: str) -> None:
        if service in self._services or len(self._services) < MOST_ROBOTS:
            self._services[service] = state

    def _time_of(self, item: ReceivedMessage, robot: _RobotDisplay) -> float:
        if item.topic is HEALTH or item.message.epoch != robot.epoch:
            return self._time.now(item.at)  # a heartbeat may be from before the robot's restart
        return self._time.at(item.robot, item.message.epoch, item.message.robot_time, item.at)

    def _note_field(self, name: str, state: StateMessage) -> None:
        if name not in self.fields:
            own = phase_bounds(state, self._display) if self._display.is_pendulum else field_of(state)
            self.fields[name] = own or (-1.4, 1.4, -1.4, 1.4)

    def _refuse(self, item: RejectedMessage, now: float) -> TimelineFrame:
        self.refused += 1
        self._refusal = self._refusal or f"{item.key}: {item.reason}"
        robot = self._robots.get(item.robot)
        if robot is None:
            return TimelineFrame(0.0, ())
        robot.refused += 1
        if robot.refused > _REPORTED_REFUSALS:
            return TimelineFrame(0.0, ())
        last = " (further ones are not reported)" if robot.refused == _REPORTED_REFUSALS else ""
        note = Note(f"refused {item.reason[:200]}{last}", ORANGE, "WARN")
        return self._frame(item.robot, None, self._time.now(now), [TimelineEntry(("log",), note)])

    def _pace_note(self, now: float) -> list[TimelineFrame]:
        factor = self.pace.factor
        text = "dashboard: every frame is drawn" if factor == 1 else f"dashboard: behind, draws one frame in {factor}"
        note = Note(f"{text}; {self.left_out} left out so far", ORANGE, "INFO" if factor == 1 else "WARN")
        at = self._time.now(now)
        return [self._frame(name, None, at, [TimelineEntry(("log",), note)]) for name in self.fields]

    def _frame(self, name: str, topic: Topic | None, at: float, entries: list[TimelineEntry]) -> TimelineFrame:
        """Returns a frame of one robot, and updates its page and the time of its next keyframe."""
        robot = self._robots[name]
        if topic is not None:
            robot.newest[topic.name] = max(at, robot.newest.get(topic.name, at))
        for entry in entries:
            if isinstance(entry.shape, Note):
                robot.view.now.add(at, entry.shape)
        return TimelineFrame(at, _under(name, entries))

    def _keyframes(self, now: float) -> list[TimelineFrame]:
        frames = []
        for name in self.fields:
            robot = self._robots[name]
            frames += [
                TimelineFrame(robot.newest[topic], _under(name, entries))
                for topic, entries in robot.view.keyframe().items()
                if topic in robot.newest
            ]
        return [*frames, *self._pages(now)]

    def _pages(self, now: float, *, changed: bool = False) -> list[TimelineFrame]:
        """Returns the text page of every robot; with ``changed``, of those whose headline has changed."""
        frames = []
        for name in self.fields:
            robot = self._robots[name]
            headline = robot.view.now.headline(now)
            if changed and headline == robot.headline:
                continue
            robot.headline = headline
            page = TimelineEntry(("now",), robot.view.now.page(now))
            # while nothing arrives the time line goes on, so that the curves of the past leave the panes
            at = max(self._time.now(now) if headline else 0.0, *robot.newest.values())
            robot.newest["page"] = at  # no later page is drawn at an earlier time, which the viewer would not show
            frames.append(TimelineFrame(at, _under(name, [page])))
        return frames

    def _waiting_frame(self) -> TimelineFrame:
        """Returns the page that is shown while there is no robot, if it changed."""
        page = self._waiting if self.fields else waiting_page(self._fleet, self._services, self._refusal)
        if page == self._waiting:
            return TimelineFrame(0.0, ())
        self._waiting = page
        return TimelineFrame(0.0, (TimelineEntry(("waiting",), page, static=True),))


def _under(robot: str, entries: list[TimelineEntry]) -> tuple[TimelineEntry, ...]:
    return tuple(TimelineEntry(("robots", robot, *entry.path), entry.shape, entry.static) for entry in entries)
