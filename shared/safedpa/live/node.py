"""The node of the diagnosis: monitors the model of each robot and carries out model changes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import RLock
from typing import final

from safedpa.bus import (
    FINDING,
    HEALTH,
    LATENT,
    MODEL,
    NO_ROBOT,
    TAKEOVER,
    VERDICT,
    AbstractNode,
    Answer,
    HealthMessage,
    Inputs,
    LatentMessage,
    Message,
    Outputs,
    Request,
    StateMessage,
    TakeoverMessage,
    VerdictMessage,
)
from safedpa.dynamics import fingerprint, parse_model
from safedpa.errors import MessageError
from safedpa.live.candidate_forecasts import CandidateForecasts, PredictEffect
from safedpa.live.change import ModelChanges
from safedpa.live.finding import RobotDiagnosis
from safedpa.live.search_jobs import AbstractWorker, SearchJob, WorkOutcome
from safedpa.live.versions import ModelVersion, OfferedEffect
from safedpa.systems import System


@dataclass
class _DiagnosedRobot:
    diagnosis: RobotDiagnosis
    footprint: tuple[float, ...] = ()
    reported: WorkOutcome | None = None
    """Search result whose candidates were proposed."""
    preparing: SearchJob | None = None
    ahead: CandidateForecasts = field(default_factory=CandidateForecasts)


@final
class DiagnosisNode(AbstractNode):
    """Monitors the model of every robot, searches for missing effects, and changes the model on request.

    ``document`` is the text of the initial model's file, ``margin`` that of the filter's margin for it (empty: the
    shipped one), and ``folder`` has the weights of a learned model. ``changes(robot, first)`` creates the store of a
    robot's versions; by default it is in memory. ``predict_effect`` predicts the effect of a candidate's margin;
    without it nothing is predicted. ``answer`` may be called from any thread. Raises ModelFileError for an invalid
    document.
    """

    name = "diagnosis"
    inputs = (LATENT, VERDICT)
    outputs = (FINDING, MODEL)
    listens = (TAKEOVER, HEALTH)
    share = 0.9
    every_tick = True

    def __init__(
        self,
        document: str,
        worker: AbstractWorker,
        margin: str = "",
        changes: Callable[[str, ModelVersion], ModelChanges] = lambda _robot, first: ModelChanges(first),
        folder: Path | None = None,
        predict_effect: PredictEffect | None = None,
    ) -> None:
        model = parse_model(document, folder)
        self._folder = folder
        self._system: System = model.system
        self._first = ModelVersion(fingerprint(model), document, margin)
        self._worker = worker
        self._predict_effect = predict_effect
        self._new_changes = changes
        self._lock = RLock()
        self._changes: dict[str, ModelChanges] = {}
        self._numbers: dict[str, int] = {}
        self._robots: dict[str, _DiagnosedRobot] = {}

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        self._check(state)
        if state.applied_by == "watchdog":  # the loop was late, perhaps for lack of processor time
            self._worker.give_way()
        changes = self.changes_of(robot)
        change = changes.step(state)
        known = self._robot(robot, changes, state.period)
        known.footprint = state.footprint
        if known.diagnosis.fingerprint != changes.version.fingerprint:
            known.diagnosis.adopt(changes.version.document)
        latent, verdict = inputs[LATENT], inputs[VERDICT]
        finding = known.diagnosis.observe(
            state,
            latent if isinstance(latent, LatentMessage) else None,
            verdict if isinstance(verdict, VerdictMessage) else None,
        )
        known.ahead.verdict = verdict if isinstance(verdict, VerdictMessage) else known.ahead.verdict
        self._propose(known, changes)
        self._prepare(robot, known, changes)
        found: dict[object, Message | None] = {FINDING: finding, MODEL: change}
        return {topic: message for topic, message in found.items() if message is not None}  # type: ignore[misc]

    def hear(self, robot: str, message: Message) -> None:  # noqa: D102
        if robot != NO_ROBOT and isinstance(message, TakeoverMessage | HealthMessage):
            self.changes_of(robot).hear(message)

    def answer(self, robot: str, request: Request) -> Answer:
        """Carries out a request about a robot, or refuses it with the reason."""
        changes = self.changes_of(robot)
        answer, known = changes.answer(request), self._robots.get(robot)
        if request.do != "status" or known is None or self._predict_effect is None:
            return answer
        reported = known.ahead.reported(changes.version.margin, self._predict_effect)
        return replace(answer, foreseen=tuple(reported.get(effect, "") for effect in answer.candidates))

    def changes_of(self, robot: str) -> ModelChanges:
        """Returns the versions of a robot's model, which survive a restart of the robot."""
        with self._lock:
            if robot not in self._changes:
                self._changes[robot] = self._new_changes(robot, self._first)
            return self._changes[robot]

    def diagnosis_of(self, robot: str) -> RobotDiagnosis | None:
        """Returns the diagnosis of a robot that is driving; None for any other robot."""
        known = self._robots.get(robot)
        return None if known is None else known.diagnosis

    def model_of(self, robot: str) -> str:  # noqa: D102
        return self.changes_of(robot).version.fingerprint if robot in self._changes else ""

    def forget(self, robot: str) -> None:  # noqa: D102
        known = self._robots.pop(robot, None)
        if known is not None:
            self._numbers[robot] = known.diagnosis.number
            known.diagnosis.close()
            self.changes_of(robot).propose(known.diagnosis.number, {})

    def _robot(self, robot: str, changes: ModelChanges, period: float) -> _DiagnosedRobot:
        if robot not in self._robots:
            number = self._numbers.get(robot, 0)
            diagnosis = RobotDiagnosis(
                robot, changes.version.document, self._worker, folder=self._folder, period=period, number=number
            )
            self._robots[robot] = _DiagnosedRobot(diagnosis)
        return self._robots[robot]

    def _check(self, state: StateMessage) -> None:
        if len(state.values) != len(self._system.state) or len(state.applied) != len(self._system.action):
            raise MessageError(
                f"state: got {len(state.values)} values and {len(state.applied)} actions, wanted those of a "
                f"{self._system.name}"
            )

    def _propose(self, known: _DiagnosedRobot, changes: ModelChanges) -> None:
        """Proposes the candidates of a new search result; closes the finding once all were rejected."""
        outcome, number = known.diagnosis.outcome, known.diagnosis.number
        if outcome is not known.reported:
            known.reported = outcome
            effects = () if outcome is None else outcome.effects
            changes.propose(number, {effect: OfferedEffect(effect) for effect in effects})
            if self._predict_effect is not None:
                known.ahead.begin(self._works(known, changes, effects))
        if outcome is not None and outcome.effects and {(number, e) for e in outcome.effects} <= changes.rejected:
            known.diagnosis.dismiss()

    def _prepare(self, robot: str, known: _DiagnosedRobot, changes: ModelChanges) -> None:
        """Has the worker create the model with the accepted effect and calibrate its margin on the newest data."""
        wanted = changes.wanted
        if wanted is None and known.preparing is None:
            known.ahead.step(robot, self._worker)
            return
        if known.preparing is not None:
            if wanted is None or wanted.effect != known.preparing.effect:
                self._worker.cancel(robot)
                known.preparing = None
            elif (outcome := self._worker.outcome(robot)) is not None:
                work, known.preparing = known.preparing, None
                _hand_over(changes, work, outcome)
            return
        works = [] if wanted is None else self._works(known, changes, (wanted.effect,))
        if not works:
            changes.failed("the finding is closed: the error is back in its band")
            return
        # The worker does one job per robot; an accepted effect has priority over a search.
        known.diagnosis.pause()
        known.ahead.interrupted()
        known.preparing = works[0]
        self._worker.begin(robot, known.preparing)

    def _works(self, known: _DiagnosedRobot, changes: ModelChanges, effects: tuple[str, ...]) -> list[SearchJob]:
        """Returns the jobs that create the models with these effects on the newest data; none without a finding."""
        run, outcome = known.diagnosis.data(), known.diagnosis.outcome
        if run is None or outcome is None:
            return []
        work = SearchJob("prepare", changes.version.document, run, footprint=known.footprint, folder=self._folder)
        return [replace(work, effect=effect, document=outcome.documents.get(effect, "")) for effect in effects]


def _hand_over(changes: ModelChanges, work: SearchJob, outcome: WorkOutcome) -> None:
    if outcome.failure:
        changes.failed(outcome.failure)
        return
    document = outcome.documents[work.effect]
    data = f"{work.run.name}, {work.run.t[0]:.2f} to {work.run.t[-1]:.2f} s of its clock"
    version = OfferedEffect(
        work.effect, fingerprint(parse_model(document, work.folder)), document, outcome.margin, data
    )
    changes.prepared(version)
