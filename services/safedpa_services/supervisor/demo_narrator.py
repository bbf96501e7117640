"""Narrates and measures ``safedpa demo``: a robot drives, a fault occurs, and its model is corrected.

    fall = 1 - mean error from 10 s after the change of the model on / mean error from the finding to that change

The error is the prediction error over one second of driving, which the diagnosis publishes once a second
(docs/guides/live.md).
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from math import dist
from queue import SimpleQueue
from statistics import fmean
from typing import Any, Final

from safedpa.bus import Answer, Bus, FindingMessage, Request, StateMessage
from safedpa.errors import SafedpaError
from safedpa.limits import parse_json
from safedpa.live.search_jobs import named_candidate
from safedpa_services.supervisor.run_monitor import RunMonitor

WANTED_FALL: Final = 0.6
"""Smallest reduction of the error, as a fraction. A candidate that promises less on unseen data is not accepted
automatically."""
_SETTLING_SECONDS: Final = 10.0
"""Time after the change of the model from which on the error counts: the diagnosis averages over past seconds."""
_END_SECONDS: Final = 20.0
"""Time after the change of the model at which the demo ends."""
_LATEST_END_SECONDS: Final = 40.0
"""The same while the error of the corrected model or its file is missing: a demo ends also if the diagnosis does not
answer any more."""
_TIMEOUT_SECONDS: Final = 2.0
_ATTEMPTS: Final = 5
"""Number of times that a request is made which the diagnosis does not answer in time."""
_STATIONARY_METRES: Final = 0.1
"""A robot that moved less than this counts as stationary."""
_SEARCHES: Final = 2
"""Number of searches to wait for while the best effect cannot be distinguished from another: the second has twice the
data."""
_RETRY_SECONDS: Final = 5.0
"""Time between two attempts to accept after a refusal."""


@dataclass
class UnreportedStop:
    """Measures the longest time [s] for which the robot was stationary without a reported reason, in robot time."""

    longest: float = 0.0
    _position: tuple[float, ...] = ()
    _since: float = 0.0

    def look(self, state: StateMessage, *, has_reason: bool) -> None:
        """Takes a state; ``has_reason``: whether a reason for standing is reported now."""
        position = state.values[:2]
        if has_reason or not self._position or dist(position, self._position) > _STATIONARY_METRES:
            self._position, self._since = position, state.robot_time
        self.longest = max(self.longest, state.robot_time - self._since)


@dataclass
class DemoSummary:
    """The results of the demo; times are robot times [s], None for what did not happen."""

    raised: float | None = None
    candidates: float | None = None
    effect: str = ""
    """Best candidate of the newest search."""
    taken: float | None = None
    """When the corrected model came into force."""
    error_before: float | None = None
    error_after: float | None = None
    fall: float | None = None
    way_after: float = 0.0
    """Distance driven since the model was changed [m]."""


@dataclass
class DemoNarrator:
    """Follows the run: call ``look`` often. Reports events through ``report_progress`` and never blocks."""

    bus: Bus
    robot: str
    report_progress: Callable[[str], None]
    accepts: bool
    """Whether it accepts a candidate itself (``--yes``) instead of waiting for the user."""
    summary: DemoSummary = field(default_factory=DemoSummary)
    unreported_stop: UnreportedStop = field(default_factory=UnreportedStop)
    report: str = ""
    """report.json of the newest search before the model was changed."""
    models: list[str] = field(default_factory=list)
    """The model files before and after the change."""
    _before: list[float] = field(default_factory=list)
    _after: list[float] = field(default_factory=list)
    _stage: str = ""
    _seen: FindingMessage | None = None
    _model: str = ""
    _position: tuple[float, ...] = ()
    _now: float = 0.0
    _searches: int = 0
    _accepting: str = ""
    """Effect to accept."""
    _next_attempt: float = 0.0
    _last_sentence: str = ""
    """Last status sentence of the diagnosis that was shown to the user."""
    _background: threading.Thread | None = None
    _lines: SimpleQueue[str] = field(default_factory=SimpleQueue)

    @property
    def done(self) -> bool:
        """Whether the error with the corrected model was measured long enough, or cannot be measured."""
        since = 0.0 if self.summary.taken is None else self._now - self.summary.taken
        is_complete = bool(self._after) and len(self.models) > 1
        return since >= (_END_SECONDS if is_complete else _LATEST_END_SECONDS)

    def document(self) -> dict[str, Any]:
        """Returns the summary as a JSON document."""
        return {**asdict(self.summary), "longest_stand_unsaid": round(self.unreported_stop.longest, 3)}

    def look(self, watch: RunMonitor) -> None:
        """Processes the newest messages that the monitor received."""
        if watch.state is not None:
            self._now = watch.state.robot_time
            self.unreported_stop.look(watch.state, has_reason=bool(watch.verdict and watch.verdict.stationary_reason))
            self._add_distance(watch.state.values[:2])
        finding = watch.finding
        if finding is not None and finding is not self._seen:
            self._seen = finding
            self._on_finding(finding)
        if self._accepting and self.summary.taken is None and self._now >= self._next_attempt:
            self._next_attempt, effect = self._now + _RETRY_SECONDS, self._accepting
            self._in_background(lambda: self._accept(effect))
        elif self._last_sentence and self.summary.taken is None and self._now >= self._next_attempt:
            self._next_attempt = self._now + _RETRY_SECONDS
            self._in_background(self._report_answer)
        while not self._lines.empty():
            self.report_progress(self._lines.get())

    def _add_distance(self, position: tuple[float, ...]) -> None:
        if self.summary.taken is not None and self._position:
            self.summary.way_after += dist(position, self._position)
        self._position = position

    def _on_finding(self, finding: FindingMessage) -> None:
        if not self._model:
            self._model = finding.model
            self._in_background(self._keep_model)
        if self.summary.taken is not None:
            self._measure(finding)
        elif finding.model != self._model:
            self.summary.taken = finding.robot_time
            models = f"model {finding.model[:8]} is in force instead of {self._model[:8]}"
            self.report_progress(f"{models}, in all services at one tick")
            self._in_background(self._keep_model)
        else:
            self._search(finding)

    def _search(self, finding: FindingMessage) -> None:
        if finding.stage != self._stage:
            self._stage = finding.stage
            self.report_progress(finding.sentence)
        if finding.number == 0 or finding.stage in ("learning", "watching"):
            return
        if self.summary.raised is None:
            self.summary.raised = finding.robot_time
            self.report_progress(f"where: {finding.where}")
        self._before.append(finding.error)
        if finding.report and finding.report != self.report:
            self.report = finding.report
            self._searches += 1
            self._in_background(lambda: self._propose(finding, self.report))

    def _measure(self, finding: FindingMessage) -> None:
        summary = self.summary
        if summary.taken is None or finding.robot_time < summary.taken + _SETTLING_SECONDS or not self._before:
            return
        if not finding.error:  # not measured yet: the robot was stationary
            return
        self._after.append(finding.error)
        summary.error_before, summary.error_after = fmean(self._before), fmean(self._after)
        summary.fall = 1.0 - summary.error_after / summary.error_before

    # requests run on a thread, so that ``look`` never blocks

    def _in_background(self, do: Callable[[], None]) -> None:
        """Runs ``do`` on a thread, after the previous background task has ended; again if it fails."""
        before = self._background

        def work() -> None:
            if before is not None:
                before.join()
            for attempt in range(_ATTEMPTS):
                try:
                    do()
                except SafedpaError as error:
                    if not attempt:
                        self._lines.put(f"{error}; trying again")
                else:
                    return

        self._background = threading.Thread(target=work, daemon=True)
        self._background.start()

    def _request(self, request: Request) -> Answer:
        answer = self.bus.request(self.robot, request, _TIMEOUT_SECONDS)
        if answer is None:
            raise SafedpaError("the diagnosis did not answer in time")
        return answer

    def _keep_model(self) -> None:
        self.models.append(self._request(Request(do="status")).document)

    def _propose(self, finding: FindingMessage, report: str) -> None:
        """Accepts the best candidate, asks the user to accept it, or waits for another search."""
        seen = self._request(Request(do="status"))
        if not seen.candidates:
            return
        effect = seen.candidates[0]
        promised, group = _promise(report, effect)
        self.summary.effect = effect
        if self.summary.candidates is None:
            self.summary.candidates = finding.robot_time
        if not self.accepts:
            self._last_sentence = seen.sentence
            self._lines.put(f"your turn: accept {effect} or another effect on the page; the robot drives on meanwhile")
        elif promised >= WANTED_FALL and (not group or self._searches >= _SEARCHES):
            self._lines.put(f"--yes: accepting {effect}, which promises {100 * promised:.0f} % less error")
            self._accepting = effect
        else:
            promise = f"promises {100 * promised:.0f} % less error"
            why = f"cannot be distinguished from {', '.join(group)} yet" if group else promise
            self._lines.put(f"{effect} {why}: waiting for one more search, with twice the data")

    def _report_answer(self) -> None:
        """Reports that a change was refused or dropped, after which the user has to click again."""
        seen = self._request(Request(do="status"))
        if not seen.pending and seen.sentence != self._last_sentence and seen.fingerprint == self._model:
            self._last_sentence = seen.sentence
            self._lines.put(f"{seen.sentence}; click Accept again")

    def _accept(self, effect: str) -> None:
        seen = self._request(Request(do="status"))
        if seen.pending or effect not in seen.candidates:
            return
        own = Request(do="accept", effect=effect, model=seen.fingerprint, finding=seen.finding, who="safedpa demo")
        answer = self._request(own)
        if not answer.ok:
            self._lines.put(answer.sentence)


def _promise(report: str, effect: str) -> tuple[float, tuple[str, ...]]:
    """Returns the expected reduction of the error on unseen data, as a fraction, and the indistinguishable effects."""
    document = parse_json(report)
    before = document["stages"][0]["heldout_error"]
    own = named_candidate(document["candidates"], effect)
    if own is None or own["heldout_error"] is None or not before:
        return 0.0, ()
    return 1.0 - own["heldout_error"] / before, tuple(own["indistinguishable_from"])
