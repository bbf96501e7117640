"""Recent history of each robot on the bus: path, errors, findings and model changes."""

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
from safedpa.bus.monitor import MeasurementTimes, headline, is_stale
from safedpa.errors import InputError
from safedpa.limits import parse_json
from safedpa.safety.deadlock.detector import Stand, record_deadlock, what_to_do

_MAX_STATES = 4000
_MAX_ERRORS = 900
"""Findings that are kept; one a second, so a quarter of an hour."""
_MAX_MARKS = 60
_SILENCE_SECONDS = 3.0
"""s without a message, by this machine's clock, after which a sender counts as silent."""
_MEDIAN_OF = 5
"""Number of errors before a model change whose median is shown as the error before it."""


@dataclass(frozen=True)
class TimelineMark:
    """An event on the robot's time line."""

    t: float
    """Time by the robot's clock, s."""
    kind: str
    """``finding`` or ``model``"""
    text: str


@dataclass
class RobotHistory:
    """History of one robot, since the server started to listen or since the robot's last start."""

    name: str
    epoch: int = 0
    state: StateMessage | None = None
    verdict: VerdictMessage | None = None
    predicted_path: tuple[tuple[float, ...], ...] = ()
    """Latest path that the filter predicted: one state per step."""
    finding: FindingMessage | None = None
    path: deque[tuple[float, tuple[float, ...]]] = field(default_factory=lambda: deque(maxlen=_MAX_STATES))
    """(time by the robot's clock [s], state)"""
    errors: deque[tuple[float, float, float, float, float]] = field(default_factory=lambda: deque(maxlen=_MAX_ERRORS))
    """(time by the robot's clock [s], error, band, evidence, threshold)"""
    marks: deque[TimelineMark] = field(default_factory=lambda: deque(maxlen=_MAX_MARKS))
    models: dict[str, str] = field(default_factory=dict)
    """Fingerprint of the model in use, by service."""
    report: dict[str, Any] | None = None
    """Report of the search after the latest finding."""
    report_number: int = 0
    """Number of the finding that the report belongs to."""
    error_before_change: float | None = None
    """Error before the last model change: the median over the last seconds before it."""
    heard_at: float = 0.0
    """Time at which the last state was measured, s by this machine's clock."""
    verdict_at: float | None = None
    """The same of the state that the last verdict is about; None if there was none."""
    times: MeasurementTimes = field(default_factory=MeasurementTimes)
    diagnosis_heard_at: float | None = None
    """Time of arrival of the last finding message, s by this machine's clock; None if there was none."""
    finding_at: float = 0.0
    """Time at which the state was measured that the finding is about."""
    problems: deque[str] = field(default_factory=lambda: deque(maxlen=5))
    """Refused messages about this robot, with the reason."""
    deadlocks: list[Stand] = field(default_factory=list)
    """Each stop of more than 5 s while motion was requested, since the robot's start."""

    def update(self, message: Message, at: float) -> None:
        """Adds one message, received at ``at`` [s by this machine's clock]."""
        if isinstance(message, StateMessage):
            self._state(message, at)
        elif isinstance(message, VerdictMessage):
            self.verdict, self.verdict_at = message, self.times.of(message, at)
            self._update_deadlocks(message)
            if len(message.predicted) != 1:  # a single state is the next one, not a path
                self.predicted_path = message.predicted
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
            self._restart(message.epoch)
        if not self.path or message.robot_time > self.path[-1][0]:  # in lockstep a waiting robot repeats its state
            self.path.append((message.robot_time, message.values))
        self.state, self.heard_at = message, self.times.of(message, at)

    def _update_deadlocks(self, verdict: VerdictMessage) -> None:
        known = len(self.deadlocks)
        record_deadlock(self.deadlocks, verdict)
        if len(self.deadlocks) > known:
            self.marks.append(
                TimelineMark(float(self.deadlocks[-1]["from"]), "model", f"stationary: {verdict.stationary_reason}")
            )

    def _restart(self, epoch: int) -> None:
        """Clears the history when the robot has restarted."""
        self.epoch = epoch
        for entries in (self.path, self.errors, self.marks, self.deadlocks):
            entries.clear()
        self.finding, self.report, self.report_number, self.error_before_change = None, None, 0, None

    def _finding(self, message: FindingMessage, at: float) -> None:
        last = self.finding
        changed = last is None or (last.stage, last.number) != (message.stage, message.number)
        begins = last is None or last.stage == "learning"
        if changed and not (begins and message.stage in ("learning", "watching")):
            self.marks.append(TimelineMark(message.robot_time, "finding", message.sentence))
        self.finding, self.diagnosis_heard_at = message, at
        self.finding_at = self.times.of(message, at)
        self.errors.append((message.robot_time, message.error, message.band, message.evidence, message.threshold))
        if message.report:
            self._store_report(message)
        elif message.stage in ("learning", "watching", "raised"):
            self.report = None

    def _store_report(self, message: FindingMessage) -> None:
        try:
            report = parse_json(message.report)
        except InputError:
            report = None
        if not isinstance(report, dict) or not isinstance(report.get("candidates"), list):
            self.problems.append("the diagnosis sent an invalid report, which was ignored")
            return
        self.report, self.report_number = report, message.number

    def _model(self, message: ModelMessage) -> None:
        if message.step == "take":
            errors = sorted(entry[1] for entry in list(self.errors)[-_MEDIAN_OF:])
            self.error_before_change = errors[len(errors) // 2] if errors else None
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
        """Latest time by the robot's clock, s."""
        return self.path[-1][0] if self.path else 0.0

    @property
    def error(self) -> float | None:
        """The latest error; None if there is none."""
        return self.errors[-1][1] if self.errors else None

    def mismatch(self) -> str:
        """A warning that names the services whose models differ; empty if all agree."""
        present = {name: self.models[name] for name in ("adaptation", "policy", "safety_filter") if name in self.models}
        if len(set(present.values())) < 2:
            return ""
        listed = ", ".join(f"{name} {value[:8]}" for name, value in present.items())
        return f"The services use different models ({listed}); the filter uses its fallback where they matter."

    def ages(self, now: float) -> tuple[float | None, float | None]:
        """Ages of the latest state and verdict at ``now``, s by this machine's clock; None if there was none."""
        of_state = None if self.state is None else max(0.0, now - self.heard_at)
        return of_state, None if self.verdict_at is None else max(0.0, now - self.verdict_at)

    def finding_age(self, now: float) -> float | None:
        """Age of the latest finding at ``now``, s by this machine's clock; None if there was none."""
        return None if self.finding is None else max(0.0, now - self.finding_at)

    def headline(self, now: float) -> str:
        """What is wrong with the robot's messages at ``now``; empty if they are recent."""
        sentence = headline(*self.ages(now), 0.0 if self.state is None else self.state.period)
        return f"{self.name}: {sentence}." if sentence else ""

    def deadlock_message(self, now: float) -> str:
        """How long the robot has been stationary, why, and what to do; empty unless motion is requested now."""
        verdict = self.verdict
        if verdict is None or not verdict.stationary_reason or is_stale(self.ages(now)[1]):
            return ""
        message = f"{self.name} has been stationary for {verdict.stationary_for:.0f} s, {verdict.stationary_reason}."
        return f"{message} {what_to_do(verdict.stationary_reason)}".rstrip()

    def summary(self) -> str:
        """A sentence with the duration, goals and collisions of the drive."""
        state = self.state
        if state is None:
            return "Nothing was driven."
        goals, collisions = state.goals_reached, state.collisions
        driven = f"{self.name} drove for {state.robot_time:.0f} s: {goals} goal{'s' * (goals != 1)}"
        return f"{driven}, {collisions} collision{'s' * (collisions != 1)}."

    def silence_message(self, at: float) -> str:
        """Names the sender that is silent at time ``at`` [s by this machine's clock]; empty if there is none."""
        present = self.headline(at)
        if present:
            return f"{present} {self.summary()}"
        if self.diagnosis_heard_at is None:
            return "No message from a diagnosis. The page shows the robot alone, which does not need the diagnosis."
        if at - self.diagnosis_heard_at > _SILENCE_SECONDS:
            silent_for = at - self.diagnosis_heard_at
            return f"The diagnosis has been silent for {silent_for:.0f} s. The robot continues without it."
        return ""


class LiveStore:
    """History of every robot that has sent a message."""

    def __init__(self) -> None:
        self.robots: dict[str, RobotHistory] = {}
        self.refused = 0
        """Number of refused messages."""
        self.last_refusal = ""

    def update(self, items: Iterable[ReceivedMessage | RejectedMessage]) -> None:
        """Adds received messages."""
        for item in items:
            if isinstance(item, RejectedMessage):
                self.refused += 1
                self.last_refusal = f"{item.key}: {item.reason}"[:300]
                if item.robot in self.robots:
                    self.robots[item.robot].problems.append(f"a message was refused: {item.reason}"[:300])
            elif item.robot in self.robots or isinstance(item.message, StateMessage):
                self.robots.setdefault(item.robot, RobotHistory(item.robot)).update(item.message, item.at)
