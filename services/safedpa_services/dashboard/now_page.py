"""What a person reads first of one robot: how it is now, what is awaited and from whom, what was said last."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Sequence

from safedpa.bus import FindingMessage, LatentMessage, Message, StateMessage, SurroundingsMessage, VerdictMessage
from safedpa.safety.deadlock.detector import what_to_do
from safedpa_services.dashboard.look import DisplaySettings
from safedpa_services.dashboard.shapes import MarkdownPage, Note

__all__ = ["NowPage", "waiting_page"]

_MOST_LINES = 8
_LONGEST = 300
"""Characters of a sentence."""
_SILENT_SECONDS = 1.0
_FIRST_SECONDS = 2.0
"""Until then after the first state nothing is called missing."""
_MARKDOWN = re.compile(r"([\\`*_\[\]<>#|~])")


class NowPage:
    """Of one robot; ``now`` [s] is the dashboard's monotonic clock."""

    def __init__(self, look: DisplaySettings) -> None:
        self._look = look
        self._lines: deque[tuple[float, str]] = deque(maxlen=_MOST_LINES)
        self._state: StateMessage | None = None
        self._verdict: VerdictMessage | None = None
        self._finding: FindingMessage | None = None
        self._seen: SurroundingsMessage | None = None
        self._heard: dict[type[Message], float] = {}
        self._since = 0.0
        self._ended = ""

    def take(self, message: Message, now: float) -> None:
        """Remembers a message that was heard at ``now``."""
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
        """A line of the log, ``at`` [s] on the time line."""
        self._lines.append((at, note.text[:_LONGEST]))

    def end(self, sentence: str) -> None:
        """From now on the page begins with why nothing more comes; until the next state."""
        self._ended = sentence

    def page(self, now: float) -> MarkdownPage:
        """The page as it is at ``now``."""
        parts = [f"**{_plain(self._ended)}**"] if self._ended else [*self._verdict_lines(), *self._waiting_lines(now)]
        parts.append(self._numbers())
        if self._lines:
            reported = "\n".join(f"- {at:.1f} s: {_plain(text)}" for at, text in reversed(self._lines))
            parts.append(f"Said last:\n\n{reported}")
        return MarkdownPage("\n\n".join(part for part in parts if part))

    def _verdict_lines(self) -> list[str]:
        verdict = self._verdict
        if verdict is None:
            return []
        lines = [f"**{_plain(verdict.status)}**: {_plain(verdict.sentence[:_LONGEST])}"]
        if verdict.stationary_reason:
            stationary_for = f"**Stands for {verdict.stationary_for:.0f} s**, {_plain(verdict.stationary_reason)}."
            lines.append(f"{stationary_for} {_plain(what_to_do(verdict.stationary_reason))}")
        return lines

    def _waiting_lines(self, now: float) -> list[str]:
        return [f"**Waiting for** {_plain(missing)}." for missing in self._missing(now)]

    def _missing(self, now: float) -> list[str]:
        """Who should speak and does not, and what for."""
        if self._state is None:
            return ["the robot's first state: its heartbeat is heard, it does not drive yet"]
        silent = now - self._heard.get(StateMessage, now)
        if silent > _SILENT_SECONDS:
            return [f"the robot's states: silent for {silent:.0f} s; it has ended, or the link to it is broken"]
        if now - self._since < _FIRST_SECONDS:
            return []
        missing = []
        if self._state.sources and now - self._heard.get(SurroundingsMessage, -1e9) > _SILENT_SECONDS:
            missing.append("perception, without which a robot that sees for itself brakes")
        if now - self._heard.get(VerdictMessage, -1e9) > _SILENT_SECONDS:
            missing.append("a verdict of the safety filter: without one the robot brakes by itself")
        if self._look.latent_names and now - self._heard.get(LatentMessage, -1e9) > _SILENT_SECONDS:
            missing.append("an estimate of the adaptation; the filter uses the model's own numbers meanwhile")
        if FindingMessage not in self._heard:
            missing.append("the diagnosis, which no one needs to drive: the panes of the error are empty without it")
        return missing

    def _numbers(self) -> str:
        state, verdict, finding = self._state, self._verdict, self._finding
        if state is None:
            return ""
        parts = [f"clock {state.robot_time:.1f} s", f"goals {state.goals_reached}", f"collisions {state.collisions}"]
        if verdict is not None:
            unit = self._look.h_unit
            parts.append(f"room left h {verdict.h_now:.2f}{unit}, margin {verdict.margin:.3f}{unit}")
        if self._seen is not None:
            parts += _sources_line(state.sources, self._seen)
        if finding is not None:
            parts.append(f"model {finding.model[:8]}, diagnosis {finding.stage}")
        return _plain("; ".join(parts))


def _sources_line(names: Sequence[str], seen: SurroundingsMessage) -> list[str]:
    """How old what each source measured is, what is wrong with one, and what a person marked and switched."""
    ages = [
        f"{name} {'never heard' if age < 0.0 else f'{age:.2f} s old'}"
        for name, age in zip(names, seen.ages, strict=False)
    ]
    zones = [f"zones: {', '.join(seen.zones)}"] if seen.zones else []
    ordered = [f"switched: {seen.ordered}"] if seen.ordered else []
    return [reported[:_LONGEST] for reported in (*ages, *seen.problems, *zones, *ordered)]


def waiting_page(fleet: str, heard: dict[str, str], refused: str = "") -> MarkdownPage:
    """While no robot has sent a state: what is awaited, who was heard, by name with its state, and what was refused."""
    parts = [
        "# Waiting for a robot",
        f"No one has sent a state in fleet **{_plain(fleet)}** yet; a tab for each robot appears as soon as it speaks.",
    ]
    if heard:
        listed = ", ".join(f"{_plain(name)} ({_plain(state)})" for name, state in sorted(heard.items()))
        parts.append(f"Heard so far: {listed}. They wait for the robot too.")
    else:
        parts.append("Nothing at all is heard: start `safedpa up`, or check `--fleet` and `--connect`.")
    if refused:
        parts.append(f"Refused: {_plain(refused[:_LONGEST])}.")
    return MarkdownPage("\n\n".join(parts))


def _plain(text: str) -> str:
    """As it stands, whatever signs of Markdown are in it."""
    return _MARKDOWN.sub(r"\\\1", " ".join(text.split()))
