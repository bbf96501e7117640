"""The live story: a robot drives, something about it changes, and its model is corrected. Told, and measured.

    fall = 1 - mean error from 10 s after the change of the model on / mean error from the finding to that change

of the error over one second of driving that the diagnosis tells once a second (docs/live.md).
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from math import hypot
from queue import SimpleQueue
from statistics import fmean
from typing import Any, Final

from safedpa.bus import Answer, Bus, FindingMessage, Request, StateMessage
from safedpa.errors import SafedpaError
from safedpa.limits import parse_json
from safedpa.live.named_candidate import named_candidate
from safedpa_services.supervisor.watch import RunMonitor

__all__ = ["WANTED_FALL", "DemoNarrator", "DemoSummary", "UnreportedStop"]

WANTED_FALL: Final = 0.6
"""Of the error before; a candidate that promises less on unseen data is not accepted without a person."""
_SETTLED: Final = 10.0
"""s after the change of the model from which on the error counts."""
_ENOUGH: Final = 20.0
"""s after the change of the model at which the story is told."""
_ASK_SECONDS: Final = 2.0
_WAY: Final = 0.1
"""m; a robot that has not moved farther stands."""
_SEARCHES: Final = 2
"""So many are awaited while the data cannot tell the first effect from another one, as a patient engineer would."""
_AGAIN: Final = 5.0
"""s between two attempts to accept, while the one before is refused."""


@dataclass
class UnreportedStop:
    """How long a robot stood at most without a word about it, by its own clock; ``longest`` [s]."""

    longest: float = 0.0
    _place: tuple[float, ...] = ()
    _since: float = 0.0

    def look(self, state: StateMessage, *, notice: bool) -> None:
        """Takes a state; ``notice``: whether something tells now that it stands."""
        place = state.values[:2]
        if notice or not self._place or hypot(place[0] - self._place[0], place[1] - self._place[1]) > _WAY:
            self._place, self._since = place, state.robot_time
        self.longest = max(self.longest, state.robot_time - self._since)


@dataclass
class DemoSummary:
    """What became of the story; times in s by the robot's clock, None for what did not happen."""

    raised: float | None = None
    candidates: float | None = None
    effect: str = ""
    """Best candidate of the newest search."""
    taken: float | None = None
    """When the corrected model was in force."""
    error_before: float | None = None
    error_after: float | None = None
    fall: float | None = None
    way_after: float = 0.0
    """m driven since the model was changed."""


@dataclass
class DemoNarrator:
    """Look at it after each turn of the loop; it speaks by ``report_progress`` and never waits."""

    bus: Bus
    robot: str
    report_progress: Callable[[str], None]
    accepts: bool
    """Whether it accepts by itself; else a person does."""
    reported: DemoSummary = field(default_factory=DemoSummary)
    unsaid: UnreportedStop = field(default_factory=UnreportedStop)
    report: str = ""
    """report.json of the newest search before the model was changed."""
    models: list[str] = field(default_factory=list)
    """Documents of the model before and after."""
    _before: list[float] = field(default_factory=list)
    _after: list[float] = field(default_factory=list)
    _stage: str = ""
    _seen: FindingMessage | None = None
    _model: str = ""
    _place: tuple[float, ...] = ()
    _now: float = 0.0
    _searches: int = 0
    _nominal: str = ""
    """Effect that is to be accepted."""
    _next: float = 0.0
    _reported_person: str = ""
    """What the diagnosis answered last, where a person accepts."""
    _asking: threading.Thread | None = None
    _lines: SimpleQueue[str] = field(default_factory=SimpleQueue)

    @property
    def done(self) -> bool:
        """Whether the error was seen long enough with the corrected model."""
        since = 0.0 if self.reported.taken is None else self._now - self.reported.taken
        return since >= _ENOUGH and bool(self._after) and len(self.models) > 1

    def document(self) -> dict[str, Any]:
        """The story in numbers."""
        return {**asdict(self.reported), "longest_stand_unsaid": round(self.unsaid.longest, 3)}

    def look(self, watch: RunMonitor) -> None:
        """Takes in what the watch heard."""
        if watch.state is not None:
            self._now = watch.state.robot_time
            self.unsaid.look(watch.state, notice=bool(watch.verdict and watch.verdict.stationary_reason))
            self._drive(watch.state.values[:2])
        finding = watch.finding
        if finding is not None and finding is not self._seen:
            self._seen = finding
            self._hear(finding)
        if self._nominal and self.reported.taken is None and self._now >= self._next:
            self._next, effect = self._now + _AGAIN, self._nominal
            self._alongside(lambda: self._accept(effect))
        elif not self.accepts and self._reported_person and self.reported.taken is None and self._now >= self._next:
            self._next = self._now + _AGAIN
            self._alongside(self._report_answer)
        while not self._lines.empty():
            self.report_progress(self._lines.get())

    def _drive(self, place: tuple[float, ...]) -> None:
        if self.reported.taken is not None and self._place:
            self.reported.way_after += hypot(place[0] - self._place[0], place[1] - self._place[1])
        self._place = place

    def _hear(self, finding: FindingMessage) -> None:
        if not self._model:
            self._model = finding.model
            self._alongside(self._keep_model)
        if self.reported.taken is not None:
            self._measure(finding)
        elif finding.model != self._model:
            self.reported.taken = finding.robot_time
            self.report_progress(
                f"model {finding.model[:8]} is in force instead of {self._model[:8]}, in all services at one tick"
            )
            self._alongside(self._keep_model)
        else:
            self._search(finding)

    def _search(self, finding: FindingMessage) -> None:
        if finding.stage != self._stage:
            self._stage = finding.stage
            self.report_progress(finding.sentence)
        if finding.number == 0 or finding.stage in ("learning", "watching"):
            return
        if self.reported.raised is None:
            self.reported.raised = finding.robot_time
            self.report_progress(f"where: {finding.where}")
        self._before.append(finding.error)
        if finding.report and finding.report != self.report:
            self.report = finding.report
            self._searches += 1
            self._alongside(lambda: self._propose(finding, self.report))

    def _measure(self, finding: FindingMessage) -> None:
        reported = self.reported
        if reported.taken is None or finding.robot_time < reported.taken + _SETTLED or not self._before:
            return
        self._after.append(finding.error)
        reported.error_before, reported.error_after = fmean(self._before), fmean(self._after)
        reported.fall = 1.0 - reported.error_after / reported.error_before

    # asking, next to the turns of the loop

    def _alongside(self, do: Callable[[], None]) -> None:
        """Does it on a thread of its own, after what was begun before."""
        before = self._asking

        def work() -> None:
            if before is not None:
                before.join()
            try:
                do()
            except SafedpaError as error:
                self._lines.put(str(error))

        self._asking = threading.Thread(target=work, daemon=True)
        self._asking.start()

    def _asked(self, request: Request) -> Answer:
        answer = self.bus.request(self.robot, request, _ASK_SECONDS)
        if answer is None:
            raise SafedpaError("the diagnosis did not answer in time; it is asked again")
        return answer

    def _keep_model(self) -> None:
        self.models.append(self._asked(Request(do="status")).document)

    def _propose(self, finding: FindingMessage, report: str) -> None:
        """Candidates stand there: the first one is to be accepted, or the person is told."""
        seen = self._asked(Request(do="status"))
        if not seen.candidates:
            return
        effect = seen.candidates[0]
        promised, group = _promise(report, effect)
        self.reported.effect = effect
        if self.reported.candidates is None:
            self.reported.candidates = finding.robot_time
        if not self.accepts:
            self._reported_person = seen.sentence
            self._lines.put(f"your turn: accept {effect} on the page, or another one; it drives on meanwhile")
        elif promised >= WANTED_FALL and (not group or self._searches >= _SEARCHES):
            self._lines.put(f"--yes: {effect} is accepted; it promises {100 * promised:.0f} % less error")
            self._nominal = effect
        else:
            why = (
                f"cannot be told from {', '.join(group)} yet"
                if group
                else f"promises {100 * promised:.0f} % less error"
            )
            self._lines.put(f"{effect} {why}: one more search, with twice the data, is awaited")

    def _report_answer(self) -> None:
        """What came of the person's click, also where a change was dropped and wants another click."""
        seen = self._asked(Request(do="status"))
        if not seen.pending and seen.sentence != self._reported_person and seen.fingerprint == self._model:
            self._reported_person = seen.sentence
            self._lines.put(f"{seen.sentence}; click Accept again")

    def _accept(self, effect: str) -> None:
        seen = self._asked(Request(do="status"))
        if seen.pending or effect not in seen.candidates:
            return
        own = Request(do="accept", effect=effect, model=seen.fingerprint, finding=seen.finding, who="safedpa demo")
        answer = self._asked(own)
        if not answer.ok:
            self._lines.put(answer.sentence)


def _promise(report: str, effect: str) -> tuple[float, tuple[str, ...]]:
    """By how much an effect lets the error on unseen data fall, as a share, and what cannot be told from it."""
    document = parse_json(report)
    before = document["stages"][0]["heldout_error"]
    own = named_candidate(document["candidates"], effect)
    if own is None or own["heldout_error"] is None or not before:
        return 0.0, ()
    return 1.0 - own["heldout_error"] / before, tuple(own["indistinguishable_from"])
