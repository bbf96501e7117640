"""One robot in the dashboard: each message updates its state and returns the entries to draw."""

from __future__ import annotations

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
from safedpa_services.dashboard.palette import IN_FORCE_COLOURS, UNKNOWN_STATUS, VERDICT_COLOURS
from safedpa_services.dashboard.pendulum import (
    phase_history,
    phase_prediction,
    phase_state,
    sector_entries,
    wind_entry,
)
from safedpa_services.dashboard.shapes import Note, States, StateSet, TimelineEntry
from safedpa_services.dashboard.world import (
    body_entries,
    history_entry,
    holding_entry,
    prediction_entry,
    scene_entries,
    seen_entries,
)

__all__ = ["RobotView"]

_LONGEST_GAP_TICKS = 4
"""After this many ticks without a verdict, the trail is drawn in the colour of an unknown status."""


class RobotView:
    """Turns messages of one robot into entries. ``draw`` False: the message only updates the state."""

    def __init__(self, display: DisplaySettings) -> None:
        self._display = display
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
        return {
            STATE.name: [*self._scenery, *in_force],
            VERDICT.name: status,
            FINDING.name: self._findings.lanes(),
            HEALTH.name: self.health.lanes(),
        }

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
            return [*latent_entries(message, self._display), *self._wind(message)]
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
        entries += self._history(state)
        if residual is not None:
            entries.append(residual_entry(residual))
        self._drawn = state
        return entries

    def _history(self, state: StateMessage) -> list[TimelineEntry]:
        before = self._drawn
        if before is None or not (self._display.is_planar or self._display.is_pendulum):
            return []
        known = self._verdict is not None and state.tick - self._verdict.tick <= _LONGEST_GAP_TICKS
        status = self._verdict.status if self._verdict and known else ""
        if self._display.is_pendulum:
            entry = phase_history(before, state, status, self._display)
        else:
            entry = history_entry(before, state, status)
        return [] if entry is None else [entry]

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
        if len(verdict.predicted) == 1:  # only the next state: keep the last predicted path
            pass
        elif self._display.is_planar:
            entries.append(prediction_entry(verdict, self._position()))
        elif self._display.is_pendulum:
            entries.append(phase_prediction(verdict, self._display))
        if self._seen is not None:
            of_tick = self._seen if self._seen.tick == verdict.tick else None
            entries.append(holding_entry(verdict.active, of_tick, self._position()))
        return [*entries, *barrier_entries(verdict), *action_entries(verdict, self._display)]

    def _wind(self, latent: LatentMessage) -> list[TimelineEntry]:
        entry = wind_entry(latent, self._display) if self._display.is_pendulum else None
        return [] if entry is None else [entry]

    def _position(self) -> tuple[float, float] | None:
        if self._drawn is None or len(self._drawn.values) < 2:
            return None
        return self._drawn.values[0], self._drawn.values[1]

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
