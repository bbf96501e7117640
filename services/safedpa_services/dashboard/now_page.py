"""The text page of one robot: its state now, what it is waiting for, and the newest log lines."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Sequence

from safedpa.bus import FindingMessage, LatentMessage, Message, StateMessage, SurroundingsMessage, VerdictMessage
from safedpa.bus.monitor import MeasurementTimes, age_text, headline, is_stale
from safedpa.safety.deadlock.detector import what_to_do
from safedpa_services.dashboard.display_settings import DisplaySettings
from safedpa_services.dashboard.shapes import MarkdownPage, Note

_MOST_LINES = 8
_LONGEST = 300
"""Characters of a sentence."""
_SILENT_SECONDS = 1.0
_FIRST_SECONDS = 2.0
"""Grace period after the first state in which nothing is reported as missing."""
_MARKDOWN = re.compile(r"([\\`*_\[\]<>#|~])")


class NowPage:
    """The text page of one robot; ``now`` [s] is the dashboard's monotonic clock."""

    def __init__(self, display: DisplaySettings) -> None:
        self._display = display
        self._lines: deque[tuple[float, str]] = deque(maxlen=_MOST_LINES)
        self._state: StateMessage | None = None
        self._verdict: VerdictMessage | None = None
        self._finding: FindingMessage | None = None
        self._seen: SurroundingsMessage | None = None
        self._heard: dict[type[Message], float] = {}
        """By type: when the newest message was measured."""
        self._times = MeasurementTimes()
        self._since = 0.0
        self._ended = ""

    def take(self, message: Message, now: float) -> None:
        """Stores a message that arrived at ``now``."""
        if isinstance(message, StateMessage) and self._state is not None and self._state.epoch != message.epoch:
            self._times = MeasurementTimes()
        if isinstance(message, StateMessage):
            if self._state is None or self._state.epoch != message.epoch:
                self._verdict, self._finding, self._seen, self._heard, self._since = None, None, None, {}, now
            self._state, self._ended = message, ""
        elif isinstance(message, VerdictMessage):
            self._verdict = message
        elif isinstance(message, FindingMessage):
            self._finding = message
        elif isinstance(message, SurroundingsMessage):
            self._seen = message
        self._heard[type(message)] = self._times.of(message, now)

    def headline(self, now: float) -> str:
        """Returns what is wrong at ``now`` with the robot's messages; empty if they are recent, or while it starts."""
        if self._state is None or self._ended:
            return ""
        verdict_age = self._age(VerdictMessage, now)
        if verdict_age is None and now - self._since < _FIRST_SECONDS:
            verdict_age = 0.0
        return headline(self._age(StateMessage, now), verdict_age, self._state.period)

    def _age(self, kind: type[Message], now: float) -> float | None:
        return max(0.0, now - self._heard[kind]) if kind in self._heard else None

    def add(self, at: float, note: Note) -> None:
        """Adds a log line, at time ``at`` [s] of the time line."""
        self._lines.append((at, note.text[:_LONGEST]))

    def end(self, sentence: str) -> None:
        """Puts ``sentence``, the reason why nothing more arrives, at the top of the page until the next state."""
        self._ended = sentence

    def page(self, now: float) -> MarkdownPage:
        """Returns the page at ``now``."""
        present = self.headline(now)
        parts = [f"**{_plain(present[:1].upper() + present[1:])}.**"] if present else []
        parts += [f"**{_plain(self._ended)}**"] if self._ended else self._verdict_lines(now) + self._waiting_lines(now)
        parts.append(self._summary(now))
        if self._lines:
            log = "\n".join(f"- {at:.1f} s: {_plain(text)}" for at, text in reversed(self._lines))
            parts.append(f"Last messages:\n\n{log}")
        return MarkdownPage("\n\n".join(part for part in parts if part))

    def _verdict_lines(self, now: float) -> list[str]:
        """Returns the verdict; an old one after the headline, with its age, and not in bold."""
        verdict, age = self._verdict, self._age(VerdictMessage, now)
        if verdict is None or age is None or self._state is None:
            return []
        sentence = f"{_plain(verdict.sentence[:_LONGEST])} ({age_text(age)})"
        if self.headline(now) or is_stale(age, self._state.period):
            return [f"Last verdict: {_plain(verdict.status)}: {sentence}"]
        lines = [f"**{_plain(verdict.status)}**: {sentence}"]
        if verdict.stationary_reason:
            standing = f"**Stationary for {verdict.stationary_for:.0f} s**, {_plain(verdict.stationary_reason)}."
            lines.append(f"{standing} {_plain(what_to_do(verdict.stationary_reason))}")
        return lines

    def _waiting_lines(self, now: float) -> list[str]:
        return [f"**Waiting for** {_plain(missing)}." for missing in self._missing(now)]

    def _missing(self, now: float) -> list[str]:
        """Returns which messages are missing, and the consequence."""
        if self._state is None:
            return ["the robot's first state: it sends heartbeats, but does not drive yet"]
        if is_stale(self._age(StateMessage, now), self._state.period):
            return []  # the headline says so, and everything else follows from it
        if now - self._since < _FIRST_SECONDS:
            return []
        missing = []
        if self._state.sources and now - self._heard.get(SurroundingsMessage, -1e9) > _SILENT_SECONDS:
            missing.append("perception, without which a robot with sensors brakes")
        if self._display.latent_names and now - self._heard.get(LatentMessage, -1e9) > _SILENT_SECONDS:
            missing.append("an estimate of the adaptation; meanwhile the filter uses the model's default latent")
        if FindingMessage not in self._heard:
            missing.append("the diagnosis, which is not needed for driving: the error panes are empty without it")
        return missing

    def _summary(self, now: float) -> str:
        """Returns the newest values of each kind with their age."""
        state, verdict, finding = self._state, self._verdict, self._finding
        if state is None:
            return ""
        old = {kind: age_text(self._age(kind, now) or 0.0) for kind in self._heard}
        counts = f"goals {state.goals_reached}, collisions {state.collisions}"
        parts = [f"clock {state.robot_time:.1f} s, {counts} ({old[StateMessage]})"]
        if verdict is not None:
            unit = self._display.h_unit
            parts.append(f"h {verdict.h_now:.2f}{unit}, margin {verdict.margin:.3f}{unit} ({old[VerdictMessage]})")
        if self._seen is not None:
            parts += _sources_line(state.sources, self._seen, self._age(SurroundingsMessage, now) or 0.0)
        if finding is not None:
            parts.append(f"model {finding.model[:8]}, diagnosis {finding.stage} ({old[FindingMessage]})")
        return _plain("; ".join(parts))


def _sources_line(names: Sequence[str], seen: SurroundingsMessage, since: float) -> list[str]:
    """Returns the age of each source's data, problems, and zones and switches set by the user.

    :param since: age of the message [s]
    """
    known = zip(names, seen.ages, strict=False)
    ages = [f"{name} {'no data' if age < 0.0 else f'{age + since:.2f} s old'}" for name, age in known]
    zones = [f"zones: {', '.join(seen.zones)}"] if seen.zones else []
    ordered = [f"switched: {seen.ordered}"] if seen.ordered else []
    reported = [f"{text[:_LONGEST]} ({age_text(since)})" for text in (*seen.problems, *zones, *ordered)]
    return [*(text[:_LONGEST] for text in ages), *reported]


def waiting_page(fleet: str, services: dict[str, str], refused: str = "") -> MarkdownPage:
    """Returns the page that is shown until a robot sends a state: known processes with their states, and refusals."""
    parts = [
        "# Waiting for a robot",
        f"No robot of fleet **{_plain(fleet)}** has sent a state yet. A tab appears for each robot that does.",
    ]
    if services:
        listed = ", ".join(f"{_plain(name)} ({_plain(state)})" for name, state in sorted(services.items()))
        parts.append(f"Processes found: {listed}. They are waiting for the robot, too.")
    else:
        parts.append("No process found: start `safedpa up`, or check `--fleet` and `--connect`.")
    if refused:
        parts.append(f"Refused: {_plain(refused[:_LONGEST])}.")
    return MarkdownPage("\n\n".join(parts))


def _plain(text: str) -> str:
    """Escapes Markdown."""
    return _MARKDOWN.sub(r"\\\1", " ".join(text.split()))
