"""What is heard of the robots on the bus, kept for a page: paths, errors, findings, changes of the model."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from safedpa.bus import (
    FindingMessage,
    HealthMessage,
    Message,
    ModelMessage,
    ReceivedMessage,
    RejectedMessage,
    StateMessage,
    TakeoverMessage,
    VerdictMessage,
)
from safedpa.errors import InputError
from safedpa.limits import parse_json
from safedpa.safety.deadlock.detector import Stand, record_deadlock, what_to_do

__all__ = ["LiveStore", "RobotHistory", "TimelineMark"]

_MOST_STATES = 4000
_MOST_ERRORS = 900
"""Findings that are kept, a quarter of an hour."""
_MOST_MARKS = 60
_SILENT = 3.0
"""s without a message, by this machine's clock, from which something is called silent."""
_SETTLED = 5
"""Errors before a change of which the median is told."""


@dataclass(frozen=True)
class TimelineMark:
    """Something that happened, on the robot's clock."""

    t: float
    """s"""
    kind: str
    """``finding`` or ``model``"""
    text: str


@dataclass
class RobotHistory:
    """One robot since this page's server listens, or since the robot's last start."""

    name: str
    epoch: int = 0
    state: StateMessage | None = None
    verdict: VerdictMessage | None = None
    ahead: tuple[tuple[float, ...], ...] = ()
    """The path that was predicted last."""
    finding: FindingMessage | None = None
    path: deque[tuple[float, tuple[float, ...]]] = field(default_factory=lambda: deque(maxlen=_MOST_STATES))
    """(s by the robot's clock, state)"""
    errors: deque[tuple[float, float, float, float, float]] = field(default_factory=lambda: deque(maxlen=_MOST_ERRORS))
    """(s, error, band, evidence, threshold)"""
    marks: deque[TimelineMark] = field(default_factory=lambda: deque(maxlen=_MOST_MARKS))
    models: dict[str, str] = field(default_factory=dict)
    """By service: the fingerprint that it has in force."""
    report: dict[str, Any] | None = None
    """Of the search after the newest finding."""
    report_of: int = 0
    before: float | None = None
    """Error before the last change of the model (median of the last seconds)."""
    seen: float = 0.0
    """When the robot was heard last, s by this machine's clock."""
    found: float | None = None
    """When the diagnosis was heard last; None: never."""
    troubles: deque[str] = field(default_factory=lambda: deque(maxlen=5))
    """Messages about this robot that were refused, and why."""

    stationary_for: list[Stand] = field(default_factory=list)
    """Every stand of more than 5 s while something was requested, since the start."""

    def take(self, message: Message, at: float) -> None:
        """Takes one message in, heard at ``at`` [s]."""
        if isinstance(message, StateMessage):
            self._state(message, at)
        elif isinstance(message, VerdictMessage):
            self.verdict = message
            self._stand(message)
            if len(message.predicted) != 1:  # not the next state alone
                self.ahead = message.predicted
        elif isinstance(message, FindingMessage):
            self._finding(message, at)
        elif isinstance(message, ModelMessage):
            self._model(message)
        elif isinstance(message, TakeoverMessage):
            self._takeover(message)
        elif isinstance(message, HealthMessage) and message.model:
            self.models[message.service] = message.model

    def _state(self, message: StateMessage, at: float) -> None:
        if message.epoch != self.epoch:
            self._again(message.epoch)
        if not self.path or message.robot_time > self.path[-1][0]:  # in lockstep a waiting robot repeats itself
            self.path.append((message.robot_time, message.values))
        self.state, self.seen = message, at

    def _stand(self, verdict: VerdictMessage) -> None:
        known = len(self.stationary_for)
        record_deadlock(self.stationary_for, verdict)
        if len(self.stationary_for) > known:
            self.marks.append(
                TimelineMark(float(self.stationary_for[-1]["from"]), "model", f"stands: {verdict.stationary_reason}")
            )

    def _again(self, epoch: int) -> None:
        """Forgets what was before the robot's start."""
        self.epoch = epoch
        for retained in (self.path, self.errors, self.marks, self.stationary_for):
            retained.clear()
        self.finding, self.report, self.report_of, self.before = None, None, 0, None

    def _finding(self, message: FindingMessage, at: float) -> None:
        last = self.finding
        changed = last is None or (last.stage, last.number) != (message.stage, message.number)
        begins = last is None or last.stage == "learning"
        if changed and not (begins and message.stage in ("learning", "watching")):
            self.marks.append(TimelineMark(message.robot_time, "finding", message.sentence))
        self.finding, self.found = message, at
        self.errors.append((message.robot_time, message.error, message.band, message.evidence, message.threshold))
        if message.report:
            self._report(message)
        elif message.stage in ("learning", "watching", "raised"):
            self.report = None

    def _report(self, message: FindingMessage) -> None:
        try:
            report = parse_json(message.report)
        except InputError:
            report = None
        if not isinstance(report, dict) or not isinstance(report.get("candidates"), list):
            self.troubles.append("the diagnosis sent a report that is none; it is left out")
            return
        self.report, self.report_of = report, message.number

    def _model(self, message: ModelMessage) -> None:
        if message.step == "take":
            errors = sorted(entry[1] for entry in list(self.errors)[-_SETTLED:])
            self.before = errors[len(errors) // 2] if errors else None
        phrase = {"offer": "is offered", "take": "is taken", "drop": "is dropped"}.get(message.step, message.step)
        who = f" by {message.who}" if message.who else ""
        why = f": {message.why}" if message.why else ""
        text = f"change {message.change}, model {message.fingerprint[:8]} {phrase}{who}{why}"
        self.marks.append(TimelineMark(message.robot_time, "model", text))

    def _takeover(self, message: TakeoverMessage) -> None:
        if message.state == "refused":
            text = f"{message.service} refuses change {message.change}: {message.reason}"
            self.marks.append(TimelineMark(message.robot_time, "model", text))
        elif message.expected_effect:
            self.marks.append(
                TimelineMark(message.robot_time, "model", f"change {message.change}: {message.expected_effect}")
            )
        elif message.state == "taken":
            self.models[message.service] = message.fingerprint

    @property
    def now(self) -> float:
        """s by the robot's clock."""
        return self.path[-1][0] if self.path else 0.0

    @property
    def error(self) -> float | None:
        """The newest error."""
        return self.errors[-1][1] if self.errors else None

    def mismatch(self) -> str:
        """Which services have different models in force; empty where all agree."""
        present = {name: self.models[name] for name in ("adaptation", "policy", "safety_filter") if name in self.models}
        if len(set(present.values())) < 2:
            return ""
        listed = ", ".join(f"{name} {value[:8]}" for name, value in present.items())
        return f"The services have different models in force ({listed}); the filter falls back where they matter."

    def stationary_reason(self) -> str:
        """For how long the robot stands, why, and what to do about it; empty while it moves or nothing is requested."""
        verdict = self.verdict
        if verdict is None or not verdict.stationary_reason:
            return ""
        reported = f"{self.name} stands for {verdict.stationary_for:.0f} s, {verdict.stationary_reason}."
        return f"{reported} {what_to_do(verdict.stationary_reason)}".rstrip()

    def account(self) -> str:
        """The drive in a sentence."""
        state = self.state
        if state is None:
            return "Nothing was driven."
        goals, collisions = state.goals_reached, state.collisions
        driven = f"{self.name} drove for {state.robot_time:.0f} s: {goals} goal{'s' * (goals != 1)}"
        return f"{driven}, {collisions} collision{'s' * (collisions != 1)}."

    def silence(self, at: float) -> str:
        """Who should be heard and is not, in words; empty while everything speaks."""
        if at - self.seen > _SILENT:
            since = f"{self.name} was heard last {at - self.seen:.0f} s ago"
            return f"{since}: its drive has ended, or the link to it is broken. {self.account()}"
        if self.found is None:
            return "No diagnosis is heard; what is shown comes from the robot alone. The robot does not need it."
        if at - self.found > _SILENT:
            return f"The diagnosis is silent since {at - self.found:.0f} s. The robot drives on without it."
        return ""


class LiveStore:
    """Every robot that was heard."""

    def __init__(self) -> None:
        self.robots: dict[str, RobotHistory] = {}
        self.refused = 0
        """Messages that were none."""
        self.last_refusal = ""

    def take(self, items: Iterable[ReceivedMessage | RejectedMessage]) -> None:
        """Takes in what arrived."""
        for item in items:
            if isinstance(item, RejectedMessage):
                self.refused += 1
                self.last_refusal = f"{item.key}: {item.reason}"[:300]
                if item.robot in self.robots:
                    self.robots[item.robot].troubles.append(f"a message was refused: {item.reason}"[:300])
            elif item.robot in self.robots or isinstance(item.message, StateMessage):
                self.robots.setdefault(item.robot, RobotHistory(item.robot)).take(item.message, item.at)
