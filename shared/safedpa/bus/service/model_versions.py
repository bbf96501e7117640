"""The models of a service by robot, and the two-phase protocol by which they change.

Model changes use a two-phase commit, so that either all services of a robot use the new model from the same tick on, or
none does. After an ``offer``, a service prepares the new model alongside the active one, in the pause after a tick. It
uses the new model after a ``take``, from the named tick on, and discards it after a ``drop``. The service answers every
step. Once it has answered ``ready`` it no longer refuses, because others may already use the new model.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Generic, TypeVar, final

from safedpa.bus.messages.messages import Message, ModelMessage, StateMessage, TakeoverMessage, header
from safedpa.bus.messages.requests import Answer
from safedpa.bus.messages.topics import MODEL, TAKEOVER, Topic
from safedpa.bus.service.node import AbstractNode, Outputs
from safedpa.bus.service.sandbox import JobHandle
from safedpa.limits import limit, too_much

Held = TypeVar("Held")
"""The object that the service creates from a model; robots with the same model share it."""

# Characters of a reason. It may quote a foreign document, and ends up in messages, logs and web pages.
_LONGEST_REASON = 300


@dataclass(frozen=True)
class _Version(Generic[Held]):
    held: Held
    fingerprint: str
    margin: str = ""
    change: int = 0
    document: str = ""
    """Empty for the model of the command line, which was not offered by the diagnosis."""


@dataclass
class _RobotModels(Generic[Held]):
    """A robot's active model, and the one that may replace it."""

    version: _Version[Held]
    offer: ModelMessage | None = None
    """The offer while it is not ready yet."""
    ticket: JobHandle | None = None
    """The trial of the offer in the sandbox."""
    prepared: _Version[Held] | None = None
    take: ModelMessage | None = None
    """The decision from which tick on the prepared version is active."""
    answers: deque[tuple[ModelMessage, str, str]] = field(default_factory=deque)
    """Queued answers: (message to answer, state, reason of a refusal or expected effect); one is sent per tick."""


@final
class ModelVersions(Generic[Held]):
    """Holds the active model of every robot and carries out model changes.

    ``load(robot, offer)`` creates the service's object from an offered model. If it raises, the offer is refused with
    that reason. ``predict_effect(robot, held)`` describes the expected effect of a change before it is decided.
    ``first`` is the initial model of every robot.
    """

    def __init__(
        self,
        service: str,
        first: Held,
        fingerprint: str,
        load: Callable[[str, ModelMessage], Held],
        predict_effect: Callable[[str, Held], str] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._service, self._load, self._predict_effect, self._clock = service, load, predict_effect, clock
        self._next_load = clock()
        """Earliest time [s] of the next load. Trials for several robots may end together, and a load blocks the loop
        for up to 14 ms; after each one, the loop has the same time for its other work."""
        self._first = _Version(first, fingerprint)
        self._robots: dict[str, _RobotModels[Held]] = {}
        self.submit: Callable[[str, ModelMessage], JobHandle] | None = None
        """Tries an offer in the sandbox; None loads offers directly, for trusted senders in the same process."""

    def of(self, robot: str) -> Held:
        """Returns the active model of the robot."""
        return self._version(robot).held

    def fingerprint(self, robot: str) -> str:
        """Returns the fingerprint of the robot's active model."""
        return self._version(robot).fingerprint

    def _version(self, robot: str) -> _Version[Held]:
        known = self._robots.get(robot)
        return self._first if known is None else known.version

    def prepared(self, robot: str) -> Held | None:
        """Returns the offered model that is ready but not active yet."""
        known = self._robots.get(robot)
        return None if known is None or known.prepared is None else known.prepared.held

    def agreed(self, robot: str) -> Answer | None:
        """Returns the active model for a service that was restarted; None if it was not agreed with others."""
        version = self._version(robot)
        if not version.document:
            return None
        return Answer(
            ok=True,
            sentence=f"as {self._service} has it",
            change=version.change,
            fingerprint=version.fingerprint,
            document=version.document,
            margin=version.margin,
        )

    def hear(self, robot: str, message: ModelMessage) -> None:
        """Handles one step of a change; ``answer`` returns the answer later."""
        known = self._robot(robot)
        if message.step == "offer":
            self._hear_offer(known, message)
        elif message.step == "take":
            self._hear_take(known, message)
        elif message.step == "drop":
            self._hear_drop(known, message)

    def adopt_model(self, robot: str, status: Answer | None) -> None:
        """Adopts the active model that the diagnosis reports, and a pending change.

        A model that cannot be loaded is refused like an offer, and the robot is served with the initial one.
        """
        if status is None or not status.ok or not status.fingerprint:
            return
        known = self._robot(robot)
        # While a change is pending, status.change is the number of that change and not of the active model.
        settled = status.pending != "take" or status.fingerprint == status.pending_fingerprint
        if status.document:
            number = status.change if settled and status.pending != "offer" else 0
            content = {"document": status.document, "margin": status.margin}
            agreed = _message("offer", status, number, status.fingerprint, **content)
            known.version = self._made(robot, known, agreed) or known.version
        if status.pending in ("offer", "take") and known.offer is None and known.prepared is None:
            self._take_up(robot, known, status)

    def _take_up(self, robot: str, known: _RobotModels[Held], status: Answer) -> None:
        """Joins a pending change."""
        content = {"document": status.pending_document, "margin": status.pending_margin}
        pending = _message("offer", status, status.change, status.pending_fingerprint, **content)
        self._hear_offer(known, pending)
        if status.pending == "take":
            # Without a trial in the sandbox: it is decided, so every service has already checked this model, and the
            # others switch to it at a tick that will not wait.
            self._load_offer(robot, known, pending)
            known.offer = None
            take = _message("take", status, status.change, pending.fingerprint, from_tick=status.from_tick)
            self._hear_take(known, take)

    def begin(self, robot: str, state: StateMessage) -> bool:
        """Starts a tick; True if another model is active from this tick on. Call it once per tick, first."""
        known = self._robots.get(robot)
        if known is None or known.take is None or known.prepared is None:
            return False
        take = known.take
        if state.epoch == take.epoch and state.tick < take.from_tick:
            return False
        # A robot that restarted has another epoch, whose ticks begin at 0 again: it uses the new model from the start.
        before, known.version, known.prepared, known.take = known.version, known.prepared, None, None
        known.answers.append((take, "taken", ""))
        return before.held is not known.version.held

    def answer(self, robot: str, state: StateMessage) -> TakeoverMessage | None:
        """Prepares an offer and returns the next answer to send. Call it in the pause after a tick."""
        known = self._robots.get(robot)
        if known is None:
            return None
        self._prepare(robot, known, wait=state.lockstep)
        if not known.answers:
            return None
        message, outcome, notice = known.answers.popleft()
        return TakeoverMessage(
            **header(state),
            service=self._service,
            change=message.change,
            fingerprint=message.fingerprint,
            state=outcome,
            reason=notice if outcome == "refused" else "",
            expected_effect=notice if outcome == "ready" else "",
        )

    def forget(self, robot: str) -> None:
        """Forgets a robot that left. When it returns, it has the initial model until the handshake says otherwise."""
        self._robots.pop(robot, None)

    def _robot(self, robot: str) -> _RobotModels[Held]:
        return self._robots.setdefault(robot, _RobotModels(self._first))

    def _hear_offer(self, known: _RobotModels[Held], message: ModelMessage) -> None:
        if _is(known.prepared, message):
            # The diagnosis repeats a step until it has the answer, since messages may be lost.
            known.answers.append((message, "ready", ""))
        elif _is(known.version, message):
            known.answers.append((message, "taken", ""))
        else:
            known.offer, known.ticket, known.prepared, known.take = message, None, None, None

    def _hear_take(self, known: _RobotModels[Held], message: ModelMessage) -> None:
        if _is(known.prepared, message):
            known.take = message
        elif _is(known.version, message):
            known.answers.append((message, "taken", ""))  # a repeated step, as above
        else:
            known.answers.append((message, "refused", "this process did not receive the offer"))

    def _hear_drop(self, known: _RobotModels[Held], message: ModelMessage) -> None:
        if known.offer is not None and known.offer.change == message.change:
            known.offer = known.ticket = None
        # After a take, a late or reordered drop must not undo the decision: others may use the model already.
        if known.prepared is not None and known.prepared.change == message.change and known.take is None:
            known.prepared = None

    def _prepare(self, robot: str, known: _RobotModels[Held], *, wait: bool) -> None:
        offer = known.offer
        if offer is None:
            return
        if self.submit is not None and self._loaded(known, offer) is None:
            if known.ticket is None:
                longest = max(len(offer.document), len(offer.margin))
                if longest > limit("offer_bytes"):
                    known.offer = None
                    known.answers.append((offer, "refused", str(too_much("offer_bytes", f"{longest} characters"))))
                    return
                known.ticket = self.submit(robot, offer)
            outcome = known.ticket.outcome(wait=wait) if wait or self._clock() >= self._next_load else None
            if outcome is None:
                return
            known.offer = known.ticket = None
            problem = str(outcome.get("problem", ""))
            if problem:
                known.answers.append((offer, "refused", problem[:_LONGEST_REASON]))
                return
            # The sandbox returns the document in canonical form; only that is parsed in this process.
            offer = replace(offer, document=str(outcome.get("document", offer.document)))
        known.offer, began = None, self._clock()
        self._load_offer(robot, known, offer)
        self._next_load = 2.0 * self._clock() - began  # now + the duration of this load

    def _load_offer(self, robot: str, known: _RobotModels[Held], offer: ModelMessage) -> None:
        known.prepared = self._made(robot, known, offer)
        if known.prepared is not None:
            reported = "" if self._predict_effect is None else self._predict_effect(robot, known.prepared.held)
            known.answers.append((offer, "ready", reported[:_LONGEST_REASON]))

    def _loaded(self, known: _RobotModels[Held], offer: ModelMessage) -> _Version[Held] | None:
        """Returns the version that is already loaded for an offer, as in a roll-back to the initial model."""
        wanted = (offer.fingerprint, offer.margin)
        both = (known.version, self._first)
        return next((version for version in both if (version.fingerprint, version.margin) == wanted), None)

    def _made(self, robot: str, known: _RobotModels[Held], offer: ModelMessage) -> _Version[Held] | None:
        loaded = self._loaded(known, offer)
        try:
            held = self._load(robot, offer) if loaded is None else loaded.held
            return _Version(held, offer.fingerprint, offer.margin, offer.change, offer.document)
        except Exception as error:  # noqa: BLE001
            # A foreign document may cause any exception. The robot continues with its active model.
            reason = " ".join(str(error).split()) or type(error).__name__
            known.answers.append((offer, "refused", reason[:_LONGEST_REASON]))
            return None


class ModelNode(AbstractNode, Generic[Held]):
    """A node whose models may change while it runs. A subclass sets ``_versions`` and calls their ``begin``."""

    listens: ClassVar[tuple[Topic, ...]] = (MODEL,)
    _versions: ModelVersions[Held]

    def hear(self, robot: str, message: Message) -> None:  # noqa: D102
        assert isinstance(message, ModelMessage)
        self._versions.hear(robot, message)

    def use_sandbox(self, submit: Callable[[str, ModelMessage], JobHandle]) -> None:  # noqa: D102
        self._versions.submit = submit

    def adopt_model(self, robot: str, status: Answer | None) -> None:  # noqa: D102
        self._versions.adopt_model(robot, status)

    def agreed(self, robot: str) -> Answer | None:  # noqa: D102
        return self._versions.agreed(robot)

    def model_of(self, robot: str) -> str:  # noqa: D102
        return self._versions.fingerprint(robot)

    def leave(self, robot: str) -> None:  # noqa: D102
        self.forget(robot)
        self._versions.forget(robot)

    def _answer(self, robot: str, state: StateMessage) -> Outputs:
        """Prepares an offered model and returns the answer to send, if any; call it in ``afterwards``."""
        answer = self._versions.answer(robot, state)
        return {} if answer is None else {TAKEOVER: answer}


def _is(version: _Version[Held] | None, message: ModelMessage) -> bool:
    """Whether a version belongs to the change that a message is about."""
    return version is not None and (version.change, version.fingerprint) == (message.change, message.fingerprint)


def _message(step: str, status: Answer, change: int, fingerprint: str, **more: Any) -> ModelMessage:
    """Creates a message as the diagnosis would have sent it."""
    stamp = {**header(), "epoch": status.epoch}
    return ModelMessage(**stamp, step=step, change=change, fingerprint=fingerprint, replaces="", **more)
