"""One robot in the dashboard: each message updates its state and returns the entries to draw."""

from __future__ import annotations

from collections.abc import Sequence

from safedpa.bus import (
    FINDING,
    HEALTH,
    STATE,
    VERDICT,
    FindingMessage,
    HealthMessage,
    LatentMessage,
    Message,
    ModelMessage,
    StateMessage,
    SurroundingsMessage,
    VerdictMessage,
)
from safedpa.drawing import Lines, Point
from safedpa_services.dashboard.curves import (
    action_entries,
    barrier_entries,
    latent_entries,
    residual_entry,
    style_entries,
)
from safedpa_services.dashboard.display_settings import DisplaySettings
from safedpa_services.dashboard.histories import FindingHistory, HealthHistory, ResidualHistory
from safedpa_services.dashboard.now_page import NowPage
from safedpa_services.dashboard.palette import IN_FORCE_COLOURS, INK, NO_VERDICT, UNKNOWN_STATUS, VERDICT_COLOURS
from safedpa_services.dashboard.pendulum import phase_point, phase_state, sector_entries, wind_entry
from safedpa_services.dashboard.shapes import Note, States, StateSet, TimelineEntry, drawable
from safedpa_services.dashboard.world import body_entries, holding_entry, scene_entries, seen_entries

_MOST_PREDICTED = 64
_LARGEST_STEP = 1.0
"""Largest change of a pendulum's angle between two drawn states [rad]; beyond it the angle has wrapped around."""
_LONGEST_GAP_TICKS = 4
"""After this many ticks without a verdict, the trail is drawn in the colour of an unknown status."""


class RobotView:
    """Turns messages of one robot into entries. ``draw`` False: the message only updates the state."""

    def __init__(self, display: DisplaySettings) -> None:
        self._display = display
        self._plane, self._widths = ("phase", (0.012, 0.012)) if display.is_pendulum else ("world", (0.016, 0.02))
        self.health = HealthHistory()
        self._findings = FindingHistory()
        self._residuals = ResidualHistory(display.system)
        self._epoch: int | None = None
        self._state: StateMessage | None = None
        self._drawn: StateMessage | None = None
        self._scene: tuple[object, ...] = ()
        self._verdict: VerdictMessage | None = None
        self._seen: SurroundingsMessage | None = None
        self._status = ""
        self._in_force = ""
        self._scenery: list[TimelineEntry] = []
        self.now = NowPage(display)

    def keyframe(self) -> dict[str, list[TimelineEntry]]:
        """Returns the current entries that are otherwise drawn on change only, by topic, for viewers that join late."""
        in_force = [TimelineEntry(("verdict", "in_force"), States(self._in_force))] if self._in_force else []
        status = [TimelineEntry(("verdict", "filter"), States(self._status))] if self._status else []
        # The end of a verdict has the time of the silences; at the verdict's own time it would replace the verdict.
        ended = self._status == NO_VERDICT
        return {
            STATE.name: [*self._scenery, *in_force],
            VERDICT.name: [] if ended else status,
            FINDING.name: self._findings.lanes(),
            HEALTH.name: [*self.health.lanes(), *(status if ended else [])],
        }

    def silences(self, now: float) -> list[TimelineEntry]:
        """Returns the entries of what fell silent since the last call: services, the verdict, and the robot."""
        entries = self.health.silences(now)
        if self.now.headline(now) and self._status not in ("", NO_VERDICT):
            self._status = NO_VERDICT
            entries.append(TimelineEntry(("verdict", "filter"), States(NO_VERDICT)))
            entries.append(TimelineEntry(("log",), Note(self.now.headline(now), UNKNOWN_STATUS, "WARN")))
        return entries

    def start(self) -> list[TimelineEntry]:
        """Returns the static entries with names and colours."""
        return [
            TimelineEntry(("verdict", "filter"), StateSet(VERDICT_COLOURS), static=True),
            TimelineEntry(("verdict", "in_force"), StateSet(IN_FORCE_COLOURS), static=True),
            *self._findings.start(),
            *style_entries(self._display),
        ]

    def take(self, message: Message, now: float, *, draw: bool = True) -> list[TimelineEntry]:
        """Returns the entries of a message; changes of status are drawn in any case."""
        self.now.take(message, now)
        if isinstance(message, HealthMessage):
            return self.health.add(message, now)
        if isinstance(message, FindingMessage | ModelMessage):
            return self._findings.add(message)
        self._change_epoch(message)
        self._seen = message if isinstance(message, SurroundingsMessage) else self._seen
        if isinstance(message, StateMessage):
            return self._take_state(message, draw)
        if isinstance(message, VerdictMessage):
            return self._take_verdict(message, draw)
        return self._other_entries(message) if draw else []

    def _other_entries(self, message: Message) -> list[TimelineEntry]:
        """Returns the entries of surroundings and latents."""
        if isinstance(message, SurroundingsMessage):
            return seen_entries(message)
        if isinstance(message, LatentMessage):
            wind = wind_entry(message, self._display) if self._display.is_pendulum else None
            return [*latent_entries(message, self._display), *([] if wind is None else [wind])]
        return []

    def _change_epoch(self, message: Message) -> None:
        if message.epoch != self._epoch and isinstance(message, StateMessage):
            self._epoch = message.epoch
            self._residuals = ResidualHistory(self._display.system)
            self._state = self._drawn = self._verdict = self._seen = None

    def _take_state(self, state: StateMessage, draw: bool) -> list[TimelineEntry]:
        if self._state is not None and state.tick <= self._state.tick:
            return []  # sent again in lockstep while the robot waits for the action
        self._state = state
        residual = self._residuals.add_state(state)
        entries = self._in_force_change(state.applied_by)
        if not draw:
            return entries
        scene = (state.field, state.obstacles, state.footprint, state.goal, state.corridor)
        if scene != self._scene:
            self._scene = scene
            drawn = sector_entries if self._display.is_pendulum else scene_entries
            self._scenery = drawn(state, self._display)
            entries += self._scenery
        entries += body_entries(state, self._display)
        if self._display.is_pendulum:
            entries += phase_state(state, self._display)
        entries += self._driven_path(state)
        if residual is not None:
            entries.append(residual_entry(residual))
        self._drawn = state
        return entries

    def _point(self, values: Sequence[float]) -> Point | None:
        """Returns the point of a state on the plane, for a pendulum on its phase plane; None if it has none."""
        if self._display.is_pendulum:
            return phase_point(values, self._display)
        planar = self._display.is_planar and len(values) >= 2 and drawable(*values[:2])
        return (values[0], values[1]) if planar else None

    def _driven_path(self, state: StateMessage) -> list[TimelineEntry]:
        """Returns the path since the last drawn state, in the colour of the verdict."""
        ends = [self._point(known.values) for known in (self._drawn, state) if known is not None]
        if len(ends) != 2 or ends[0] is None or ends[1] is None:
            return []
        if self._display.is_pendulum and abs(ends[1][0] - ends[0][0]) > _LARGEST_STEP:
            return []
        known = self._verdict is not None and state.tick - self._verdict.tick <= _LONGEST_GAP_TICKS
        status = self._verdict.status if self._verdict and known else ""
        path = Lines(((ends[0], ends[1]),), (VERDICT_COLOURS.get(status, UNKNOWN_STATUS),), self._widths[0])
        return [TimelineEntry((self._plane, "trail"), path)]

    def _prediction(self, verdict: VerdictMessage) -> list[TimelineEntry]:
        """Returns the predicted states as a line, on the plane from the current position on."""
        if not (self._display.is_pendulum or self._display.is_planar):
            return []
        start = [] if self._display.is_pendulum or self._drawn is None else [self._drawn.values]
        found = [self._point(values) for values in (*start, *verdict.predicted[:_MOST_PREDICTED])]
        points = tuple(point for point in found if point is not None)
        strips = (points,) if len(set(points)) > 1 else ()
        line = Lines(strips, (VERDICT_COLOURS.get(verdict.status, INK),), self._widths[1])
        return [TimelineEntry((self._plane, "predicted"), line)]

    def _take_verdict(self, verdict: VerdictMessage, draw: bool) -> list[TimelineEntry]:
        if verdict.epoch != self._epoch or (self._verdict is not None and verdict.tick <= self._verdict.tick):
            return []  # sent again, or from before the robot's restart
        self._verdict = verdict
        residual = self._residuals.add_verdict(verdict)
        entries = self._status_change(verdict)
        if not draw:
            return entries
        if residual is not None:
            entries.append(residual_entry(residual[1]))
        if len(verdict.predicted) != 1:  # only the next state: keep the last predicted path
            entries += self._prediction(verdict)
        if self._seen is not None:
            of_tick = self._seen if self._seen.tick == verdict.tick else None
            position = None if self._drawn is None else self._point(self._drawn.values)
            entries.append(holding_entry(verdict.active, of_tick, position))
        return [*entries, *barrier_entries(verdict), *action_entries(verdict, self._display)]

    def _status_change(self, verdict: VerdictMessage) -> list[TimelineEntry]:
        if verdict.status == self._status:
            return []
        self._status = verdict.status
        colour = VERDICT_COLOURS.get(verdict.status, UNKNOWN_STATUS)
        level = "WARN" if verdict.status in ("relaxed", "violated", "fallback", "disabled") else "INFO"
        note = Note(f"{verdict.status}: {verdict.sentence}", colour, level)
        return [TimelineEntry(("verdict", "filter"), States(verdict.status)), TimelineEntry(("log",), note)]

    def _in_force_change(self, applied_by: str) -> list[TimelineEntry]:
        if applied_by == self._in_force:
            return []
        self._in_force = applied_by
        entries = [TimelineEntry(("verdict", "in_force"), States(applied_by))]
        if applied_by == "watchdog":
            note = Note("No action arrived in time: the robot's watchdog brakes.", IN_FORCE_COLOURS["watchdog"], "WARN")
            entries.append(TimelineEntry(("log",), note))
        return entries
