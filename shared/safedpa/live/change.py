"""Model changes: all services of a robot use the new model from the same tick on, or none does.

A change is offered to every service. When all have answered that they loaded and checked the model, the decision is
stored and the tick of the change is announced (``take``). If a service refuses or does not answer, the offer is
dropped. Source: two-phase commit with presumed abort (Mohan, Lindsay, Obermarck, 1986).

Heartbeats reveal services that use another model than the agreed one, for example after a restart during a change. They
receive the agreed model by the same two phases. If one cannot use it, all services return to the previous version.

This module is independent of the network: messages go in and out, and time is counted in ticks of the robot.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from threading import RLock
from typing import Final, Literal, final

from safedpa.bus import Answer, HealthMessage, ModelMessage, Request, StateMessage, TakeoverMessage
from safedpa.bus.messages.messages import header
from safedpa.bus.service.sandbox import OFFER_SECONDS
from safedpa.errors import RecordingError, did_you_mean
from safedpa.live.versions import ModelVersion, OfferedEffect, PersistedState, VersionFolder

SERVICES = ("adaptation", "policy", "safety_filter")
"""The services that use the model and take part in a change."""


@dataclass
class ChangeInProgress:
    """A change from the request to the confirmation of the last service."""

    number: int
    why: str
    who: str
    replaces: str
    """Fingerprint of the model that was active when the change began."""
    versions: tuple[ModelVersion, ...]
    """The agreed versions if the change succeeds; the last one is then active."""
    version: ModelVersion | None
    """The last of them; None while its model is being created."""
    candidate: OfferedEffect = field(default_factory=lambda: OfferedEffect(""))
    """The accepted candidate."""
    repair: bool = False
    """Whether the change offers the active version again."""
    attempt: int = 1
    """Number of the attempt: an offer that was not answered in time is made again."""
    stage: Literal["preparing", "offer", "take"] = "preparing"
    steps: int = 0
    """Ticks since the stage began."""
    ready: set[str] = field(default_factory=set)
    taken: set[str] = field(default_factory=set)
    refused: str = ""
    """Why the change failed before the decision."""
    expected_effect: str = ""
    """Effect of the change that a service expects."""
    epoch: int = 0
    from_tick: int = 0

    @property
    def name(self) -> str:
        """Name of the change in sentences."""
        return f"change {self.number} ({self.why})"

    @property
    def consequence(self) -> str:
        """Expected effect as the end of a sentence; empty without one."""
        return f"; {self.expected_effect}" if self.expected_effect else ""

    @property
    def unconfirmed(self) -> str:
        """Names of the services that have not confirmed the new model."""
        return ", ".join(sorted(set(SERVICES) - self.taken))

    @property
    def unready(self) -> str:
        """Names of the services that have not answered the offer."""
        return ", ".join(sorted(set(SERVICES) - self.ready))

    def enter(self, stage: Literal["offer", "take"]) -> None:
        """Enters the next stage."""
        self.stage, self.steps, self.refused = stage, 0, ""

    def complete(self, made: OfferedEffect) -> None:
        """Sets the model to offer."""
        self.version = ModelVersion(
            made.fingerprint, made.document, made.margin, self.number, self.why, self.who, made.data
        )
        self.versions = (*self.versions, self.version)

    def hear(self, message: TakeoverMessage) -> None:
        """Handles a service's answer; ignores other changes and services that do not use the model."""
        if self.version is None or message.change != self.number or message.service not in SERVICES:
            return
        if message.fingerprint != self.version.fingerprint:
            self.refused = f"{message.service} answered for model {message.fingerprint}"
        elif message.state == "refused":
            self.refused = f"{message.service} refused it: {message.reason}"
        elif message.state in ("ready", "taken"):
            self.ready.add(message.service)
            self.expected_effect = message.expected_effect or self.expected_effect
            if message.state == "taken":
                self.taken.add(message.service)

    def message(self, step: Literal["offer", "take", "drop"], reason: str = "") -> ModelMessage:
        """Returns the message for a step, without a tick; ``reason`` is why the change is dropped."""
        version = self.version or ModelVersion("", "")
        offers, takes = step == "offer", step == "take"
        return ModelMessage(
            **header(),
            step=step,
            change=self.number,
            fingerprint=version.fingerprint,
            replaces=self.replaces,
            document=version.document if offers else "",
            margin=version.margin if offers else "",
            from_tick=self.from_tick if takes else 0,
            who=self.who,
            why=f"{self.why}: {reason}" if reason else self.why,
            data=version.data,
        )


# Ticks after a change before a heartbeat with another model counts: it may have been sent before the change.
_SETTLE_TICKS = 10
# Ticks to wait after a failed repair; doubled each time, up to an hour at 20 Hz. A service that can never use the model
# must not cause a change every few seconds.
_FIRST_PAUSE = 200
_LONGEST_PAUSE = 72000


@final
class ModelMismatchMonitor:
    """Finds services with another model from their newest heartbeats, with an exponential back-off of repairs."""

    def __init__(self) -> None:
        self._health: dict[str, HealthMessage] = {}
        self._since: tuple[int, int] | None = None
        self._ticks = 0
        self._again_at, self._pause = 0, _FIRST_PAUSE

    def hear(self, message: HealthMessage) -> None:
        """Stores a heartbeat."""
        if message.service in SERVICES:
            self._health[message.service] = message

    def settle(self, state: StateMessage, *, again: bool) -> None:
        """Counts ticks; call once per tick, and with ``again`` at the tick from which another version is active."""
        if self._since is None or self._since[0] != state.epoch or again:
            self._since = (state.epoch, state.tick)
        self._ticks += not again

    def found(self, fingerprint: str) -> str:
        """Describes services that use another model than the active one; empty if there are none, or it is too
        early."""
        if self._since is None or self._ticks < self._again_at:
            return ""
        epoch, tick = self._since
        strays = {
            name: health.model
            for name, health in self._health.items()
            if health.epoch == epoch and health.tick >= tick + _SETTLE_TICKS and health.model not in ("", fingerprint)
        }
        # The next report needs new heartbeats, sent after the repair that follows this one.
        if strays:
            self._health = {}
        return ", ".join(f"{name} uses {model}" for name, model in sorted(strays.items()))

    def corrected(self) -> None:
        """Resets the back-off after a successful change."""
        self._pause = _FIRST_PAUSE

    def not_corrected(self) -> None:
        """Delays the next repair after a failed one."""
        self._again_at = self._ticks + self._pause
        self._pause = min(2 * self._pause, _LONGEST_PAUSE)


@dataclass(frozen=True)
class ChangeSettings:
    """Limits in ticks of the robot, unless stated otherwise."""

    prepare: float = 60.0
    """Seconds of robot time to create the model of an accepted effect, which takes 1.2 s of processor time."""
    ready: float = OFFER_SECONDS + 5.0
    """Seconds of robot time for all services to load and check an offer: the limit of the check itself, and 5 s for the
    offer and the answers. The check takes 0.3 s of processor time, at a low priority."""
    attempts: int = 3
    """Number of times that a model is awaited or offered before the change is given up for lack of time."""
    ahead: int = 5
    """From the decision to the tick of the change: 0.25 s at 20 Hz, so that the message reaches all services before."""
    taken: int = 40
    """After that tick, for all services to confirm that they use the new model."""
    repeat: int = 10
    """Between two repetitions of a decision to services that have not confirmed it."""


_REQUESTS: Final = ("accept", "reject", "roll_back", "status")


@final
class ModelChanges:
    """The versions of one robot's model, and the change in progress. Thread-safe.

    ``step`` is called once per tick and returns the message to publish; ``hear`` handles messages of services;
    ``answer`` handles requests. With a folder, the agreed versions survive a restart of the process. Raises InputError
    if the folder cannot be read.
    """

    def __init__(
        self, first: ModelVersion, folder: VersionFolder | None = None, settings: ChangeSettings | None = None
    ) -> None:
        self._lock = RLock()
        self._folder, self._settings = folder, settings or ChangeSettings()
        retained = None if folder is None else folder.load()
        self._retained = retained or PersistedState((first,))
        self._version = self._retained.versions[-1]
        self._coming: ModelVersion | None = None
        self._state: StateMessage | None = None
        self._change: ChangeInProgress | None = None
        self._reported: deque[ModelMessage] = deque()
        self._strays = ModelMismatchMonitor()
        self._finding = 0
        self._candidates: dict[str, OfferedEffect] = {}
        self.sentence = "this is the robot's initial model" if retained is None else "restored after a restart"
        """Result of the last change."""
        # An offer without a decision before the restart: presumed abort. The services must discard it.
        if self._retained.offered:
            lost = ChangeInProgress(
                self._retained.change, "undecided", "", self.fingerprint, (), ModelVersion(self._retained.offered, "")
            )
            self._reported.append(lost.message("drop", "the diagnosis was restarted"))
            self._retained = replace(self._retained, offered="")

    @property
    def version(self) -> ModelVersion:
        """The version that is active at the newest state's tick."""
        return self._version

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the active model."""
        return self._version.fingerprint

    @property
    def versions(self) -> tuple[ModelVersion, ...]:
        """The agreed versions, oldest first. The last is active, or will be in a few ticks. ``roll_back`` removes
        it."""
        return self._retained.versions

    @property
    def under_way(self) -> str:
        """Stage of the change in progress, ``preparing``, ``offer`` or ``take``; empty without one."""
        change = self._change
        return "" if change is None else change.stage

    @property
    def wanted(self) -> OfferedEffect | None:
        """An accepted candidate whose model has to be created: answer with ``prepared`` or ``failed``."""
        change = self._change
        return change.candidate if change is not None and change.version is None else None

    @property
    def rejected(self) -> frozenset[tuple[int, str]]:
        """(finding, effect) of the rejected candidates."""
        return frozenset(self._retained.rejected)

    def propose(self, finding: int, candidates: Mapping[str, OfferedEffect]) -> None:
        """Sets the candidates of a finding that may be accepted from now on, by effect, best first."""
        with self._lock:
            self._finding, self._candidates = finding, dict(candidates)

    def prepared(self, made: OfferedEffect) -> None:
        """Continues the change with the created model; ignored if it is no longer wanted."""
        with self._lock:
            if self._change is not None and self.wanted is not None and self.wanted.effect == made.effect:
                self._change.complete(made)

    def failed(self, reason: str) -> None:
        """Ends the change because the wanted model cannot be created."""
        with self._lock:
            if self._change is not None and self.wanted is not None:
                self._change.refused = reason

    def hear(self, message: TakeoverMessage | HealthMessage) -> None:
        """Handles a service's answer to an offer, or its heartbeat with the model that it uses."""
        with self._lock:
            if isinstance(message, HealthMessage):
                self._strays.hear(message)
            elif self._change is not None:
                self._change.hear(message)

    def step(self, state: StateMessage) -> ModelMessage | None:
        """Advances the change in progress; returns the message to publish, if any. Call once per tick, in order."""
        with self._lock:
            self._state = state
            self._settle(state)
            if self._reported:
                return replace(self._reported.popleft(), **header(state))
            self._change = self._change or self._repair()
            message = None if self._change is None else self._advance(self._change, state)
            return None if message is None else replace(message, **header(state))

    def answer(self, request: Request) -> Answer:
        """Carries out a request or refuses it with the reason; may be called on any thread."""
        with self._lock:
            refusal = self._refusal(request)
            if refusal:
                return self._answer(False, f"refused: {refusal}")
            if request.do == "status":
                return self._status()
            if request.do == "reject":
                return self._reject(request)
            change = self._roll_back(request.who) if request.do == "roll_back" else self._accept(request)
            return self._answer(True, f"{change.name} begins")

    def _refusal(self, request: Request) -> str:
        """Returns why a request is refused; empty if it is not."""
        if request.do not in _REQUESTS:
            return f"'{request.do}': {did_you_mean(request.do, _REQUESTS)}"
        if request.do == "status":
            return ""
        if self._change is not None:
            who = self._change.who or "someone"
            return f"{self._change.name} by {who} is in progress; ask again when it is done"
        if self._state is None:
            return "the robot has not sent a state yet; start it first"
        return self._outdated(request)

    def _outdated(self, request: Request) -> str:
        # A user decides on the basis of what a page shows, which may be outdated.
        if request.model != self.fingerprint:
            seen = f"you saw {request.model}" if request.model else "you name none"
            return f"the active model is {self.fingerprint}, {seen}; look at it again first"
        if request.do == "roll_back":
            alone = len(self._retained.versions) < 2
            return "this is the robot's initial model; there is no earlier one" if alone else ""
        if request.finding != self._finding:
            return f"the newest finding has number {self._finding}, you name {request.finding}; look at it again first"
        if request.effect not in (candidates := self._open_candidates()):
            known = did_you_mean(request.effect, candidates) if candidates else "nothing is proposed now"
            return f"effect '{request.effect}' is not a candidate; {known}"
        return ""

    def _accept(self, request: Request) -> ChangeInProgress:
        change = self._begun(f"accept {request.effect} of finding {request.finding}", request.who)
        change.candidate = self._candidates[request.effect]
        if change.candidate.document:
            change.complete(change.candidate)
        return change

    def _roll_back(self, who: str, reason: str = "") -> ChangeInProgress:
        *before, last = self._retained.versions
        change = self._begun(f"roll back {last.why or 'the last change'}{reason}", who)
        change.version, change.versions = before[-1], tuple(before)
        return change

    def _begun(self, why: str, who: str) -> ChangeInProgress:
        self._retained = replace(self._retained, change=self._retained.change + 1)
        self._change = ChangeInProgress(
            self._retained.change, why, who, self.fingerprint, self._retained.versions, None
        )
        return self._change

    def _reject(self, request: Request) -> Answer:
        rejected = (*self._retained.rejected, (request.finding, request.effect))
        problem = self._keep(replace(self._retained, change=self._retained.change + 1, rejected=rejected))
        if problem:
            return self._answer(False, f"refused: {problem}")
        what = f"reject {request.effect} of finding {request.finding}"
        noted = ChangeInProgress(self._retained.change, what, request.who, self.fingerprint, (), None)
        self._reported.append(noted.message("drop"))  # only for the recording: nothing was offered to the services
        return self._answer(True, f"{request.effect} is rejected")

    def _open_candidates(self) -> tuple[str, ...]:
        return tuple(effect for effect in self._candidates if (self._finding, effect) not in self.rejected)

    def _settle(self, state: StateMessage) -> None:
        """Activates the new version from its tick on, or at once if the robot has restarted."""
        self._strays.settle(state, again=False)
        change, coming = self._change, self._coming
        if coming is None or change is None:
            return
        if state.epoch != change.epoch or state.tick >= change.from_tick:
            self._version, self._coming = coming, None
            self._strays.settle(state, again=True)

    def _advance(self, change: ChangeInProgress, state: StateMessage) -> ModelMessage | None:
        change.steps += 1
        if change.stage == "take":
            return self._collect(change)
        if change.refused:
            return self._give_up(change, change.refused)
        if change.stage == "preparing":
            return self._await_document(change, state)
        if not change.unready:
            return self._decide(change, state)
        if change.steps * state.period <= self._settings.ready:
            return None
        return self._too_late(change, f"{change.unready} did not answer within {self._settings.ready:.0f} s")

    def _too_late(self, change: ChangeInProgress, reason: str) -> ModelMessage:
        message = self._give_up(change, reason)
        self._try_again(change, reason)
        return message

    def _try_again(self, dropped: ChangeInProgress, reason: str) -> None:
        """Waits for the same version or offers it again: what was busy or restarting may answer now."""
        if dropped.attempt >= self._settings.attempts or dropped.repair or self._change is not None:
            return
        change = self._begun(dropped.why, dropped.who)
        change.version, change.versions, change.candidate = dropped.version, dropped.versions, dropped.candidate
        change.attempt = dropped.attempt + 1
        self.sentence = f"{dropped.name}: {reason}; attempt {change.attempt} of {self._settings.attempts} begins"

    def _await_document(self, change: ChangeInProgress, state: StateMessage) -> ModelMessage | None:
        if change.version is None:
            if change.steps * state.period <= self._settings.prepare:
                return None
            return self._too_late(change, f"its model was not made within {self._settings.prepare:.0f} s")
        problem = self._keep(replace(self._retained, offered=change.version.fingerprint))
        if problem:
            return self._give_up(change, problem)
        change.enter("offer")
        return change.message("offer")

    def _decide(self, change: ChangeInProgress, state: StateMessage) -> ModelMessage | None:
        """Decides the change: all services are ready."""
        # Store the decision before announcing it: after a crash in between, services that ask get the decision.
        problem = self._keep(replace(self._retained, versions=change.versions, offered=""))
        if problem:
            return self._give_up(change, problem)
        change.enter("take")
        change.epoch, change.from_tick = state.epoch, state.tick + self._settings.ahead
        self._coming = change.version
        if not change.repair:
            self._candidates = {}  # they were found for the model that is replaced
        self.sentence = f"{change.name}: used from tick {change.from_tick} on{change.consequence}"
        return change.message("take")

    def _collect(self, change: ChangeInProgress) -> ModelMessage | None:
        late = bool(change.refused) or change.steps > self._settings.ahead + self._settings.taken
        if not change.unconfirmed and self._coming is None:
            self._finish(f"{change.name}: taken by all services{change.consequence}")
            self._strays.corrected()
        elif late and self._coming is None:
            self._finish(f"{change.name}: {change.unconfirmed} did not confirm it")
        elif change.steps % self._settings.repeat == 0:
            return change.message("take")
        return None

    def _give_up(self, change: ChangeInProgress, reason: str) -> ModelMessage:
        """Drops the change: all services keep the active version, or go back if one of them cannot use that."""
        self._finish(f"{change.name}: dropped, {reason}")
        self._keep(replace(self._retained, offered=""))
        if change.repair:
            self._strays.not_corrected()
            if change.refused and len(self._retained.versions) > 1:
                self._roll_back("diagnosis", f", as {reason}")
        return change.message("drop", reason)

    def _finish(self, sentence: str) -> None:
        self._change, self.sentence = None, sentence

    def _repair(self) -> ChangeInProgress | None:
        """Offers the active version again if a service uses another one."""
        strays = self._strays.found(self.fingerprint)
        if not strays:
            return None
        change = self._begun(f"repair, {strays}", "diagnosis")
        change.version, change.repair = self._version, True
        return change

    def _keep(self, retained: PersistedState) -> str:
        """Stores the state; returns why that failed, in which case the previous state remains."""
        try:
            if self._folder is not None:
                self._folder.save(retained)
        except RecordingError as error:
            return str(error)
        self._retained = retained
        return ""

    def _status(self) -> Answer:
        version, change = self._version, self._change
        answer = replace(self._answer(True, self.sentence), document=version.document, margin=version.margin)
        if change is None:
            return answer
        coming = change.version or ModelVersion("", "")
        return replace(
            answer,
            pending=change.stage,
            pending_fingerprint=coming.fingerprint,
            pending_document=coming.document,
            pending_margin=coming.margin,
            epoch=change.epoch,
            from_tick=change.from_tick,
        )

    def _answer(self, ok: bool, sentence: str) -> Answer:
        return Answer(
            ok=ok,
            sentence=sentence,
            change=self._retained.change,
            fingerprint=self.fingerprint,
            finding=self._finding,
            candidates=self._open_candidates(),
            earlier=len(self._retained.versions) - 1,
        )
