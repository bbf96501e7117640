"""The text page of one robot: its state now, what it is waiting for, and the newest log lines."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Sequence

from safedpa.bus import FindingMessage, LatentMessage, Message, StateMessage, SurroundingsMessage, VerdictMessage
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
        self._since = 0.0
        self._ended = ""

    def take(self, message: Message, now: float) -> None:
        """Stores a message that arrived at ``now``."""
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
        self._heard[type(message)] = now

    def add(self, at: float, note: Note) -> None:
        """Adds a log line, at time ``at`` [s] of the time line."""
        self._lines.append((at, note.text[:_LONGEST]))

    def end(self, sentence: str) -> None:
        """Puts ``sentence``, the reason why nothing more arrives, at the top of the page until the next state."""
        self._ended = sentence

    def page(self, now: float) -> MarkdownPage:
        """Returns the page at ``now``."""
        parts = [f"**{_plain(self._ended)}**"] if self._ended else [*self._verdict_lines(), *self._waiting_lines(now)]
        parts.append(self._summary())
        if self._lines:
            log = "\n".join(f"- {at:.1f} s: {_plain(text)}" for at, text in reversed(self._lines))
            parts.append(f"Last messages:\n\n{log}")
        return MarkdownPage("\n\n".join(part for part in parts if part))

    def _verdict_lines(self) -> list[str]:
        verdict = self._verdict
        if verdict is None:
            return []
        lines = [f"**{_plain(verdict.status)}**: {_plain(verdict.sentence[:_LONGEST])}"]
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
        silent = now - self._heard.get(StateMessage, now)
        if silent > _SILENT_SECONDS:
            return [f"the robot's states: silent for {silent:.0f} s; it has ended, or its link is broken"]
        if now - self._since < _FIRST_SECONDS:
            return []
        missing = []
        if self._state.sources and now - self._heard.get(SurroundingsMessage, -1e9) > _SILENT_SECONDS:
            missing.append("perception, without which a robot with sensors brakes")
        if now - self._heard.get(VerdictMessage, -1e9) > _SILENT_SECONDS:
            missing.append("a verdict of the safety filter, without which the robot brakes by itself")
        if self._display.latent_names and now - self._heard.get(LatentMessage, -1e9) > _SILENT_SECONDS:
            missing.append("an estimate of the adaptation; meanwhile the filter uses the model's default latent")
        if FindingMessage not in self._heard:
            missing.append("the diagnosis, which is not needed for driving: the error panes are empty without it")
        return missing

    def _summary(self) -> str:
        state, verdict, finding = self._state, self._verdict, self._finding
        if state is None:
            return ""
        parts = [f"clock {state.robot_time:.1f} s", f"goals {state.goals_reached}", f"collisions {state.collisions}"]
        if verdict is not None:
            unit = self._display.h_unit
            parts.append(f"h {verdict.h_now:.2f}{unit}, margin {verdict.margin:.3f}{unit}")
        if self._seen is not None:
            parts += _sources_line(state.sources, self._seen)
        if finding is not None:
            parts.append(f"model {finding.model[:8]}, diagnosis {finding.stage}")
        return _plain("; ".join(parts))


def _sources_line(names: Sequence[str], seen: SurroundingsMessage) -> list[str]:
    """Returns the age of each source's data, problems, and zones and switches set by the user."""
    ages = [
        f"{name} {'no data' if age < 0.0 else f'{age:.2f} s old'}" for name, age in zip(names, seen.ages, strict=False)
    ]
    zones = [f"zones: {', '.join(seen.zones)}"] if seen.zones else []
    ordered = [f"switched: {seen.ordered}"] if seen.ordered else []
    return [text[:_LONGEST] for text in (*ages, *seen.problems, *zones, *ordered)]


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
