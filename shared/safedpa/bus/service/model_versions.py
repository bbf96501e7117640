"""Which model a service uses for each robot while models change: offered, prepared, taken at a tick, or dropped.

A change has two phases, so that all services of a robot use the new model from the same tick on, or none does. An
offer is prepared next to the model in force in the pause behind a tick; it is used only after a ``take``, from the first
state of the named tick on, and forgotten with a ``drop``. The service answers every step. Once it has answered that it
is ready it does not refuse any more: the others may be using the new model already.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Generic, TypeVar, final

from safedpa.bus.messages.messages import ModelMessage, StateMessage, TakeoverMessage
from safedpa.bus.messages.requests import Answer
from safedpa.bus.service.sandbox import AbstractJobHandle
from safedpa.limits import limit, too_much

__all__ = ["ModelVersions"]

Held = TypeVar("Held")
"""What the service makes of a model; the same is shared by all robots that have it."""

_LONGEST_REASON = 300
"""Characters."""


@dataclass(frozen=True)
class _Version(Generic[Held]):
    held: Held
    fingerprint: str
    margin: str = ""
    change: int = 0
    document: str = ""
    """Empty of the model of the process's own options, of which no one told."""


@dataclass
class _RobotModels(Generic[Held]):
    """One robot's model, and what is about to replace it."""

    version: _Version[Held]
    offer: ModelMessage | None = None
    """Not ready yet."""
    ticket: AbstractJobHandle | None = None
    """While the offer is tried in a process of its own."""
    prepared: _Version[Held] | None = None
    take: ModelMessage | None = None
    """For the prepared version: from when on it is used."""
    answers: deque[tuple[ModelMessage, str, str]] = field(default_factory=deque)
    """(message that is answered, state, why it is refused or what it will do), to be sent one a tick."""


@final
class ModelVersions(Generic[Held]):
    """Keeps the model of every robot, and the one that was offered, through the steps of a change.

    ``load(robot, offer)`` makes of an offered model what the service needs, and raises whatever it likes when it
    cannot: the offer is refused with that reason then. ``foretell(robot, made)`` says what the change will do, before
    it is decided. ``first`` is what every robot begins with.
    """

    def __init__(
        self,
        service: str,
        first: Held,
        fingerprint: str,
        load: Callable[[str, ModelMessage], Held],
        foretell: Callable[[str, Held], str] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._service, self._load, self._foretell, self._clock = service, load, foretell, clock
        self._next_load = clock()
        """s; trials of several robots' offers may end at once, and each load takes up to 14 ms of the loop: after one
        the loop has as long for others."""
        self._first = _Version(first, fingerprint)
        self._robots: dict[str, _RobotModels[Held]] = {}
        self.hand_in: Callable[[str, ModelMessage], AbstractJobHandle] | None = None
        """Tries an offer in a process of its own; None: offers are loaded at once, as between trusted nodes."""

    def of(self, robot: str) -> Held:
        """What is in force for the robot."""
        known = self._robots.get(robot)
        return self._first.held if known is None else known.version.held

    def fingerprint(self, robot: str) -> str:
        """Of the model in force for the robot."""
        known = self._robots.get(robot)
        return self._first.fingerprint if known is None else known.version.fingerprint

    def prepared(self, robot: str) -> Held | None:
        """What was offered and is ready, while it is not in force yet."""
        known = self._robots.get(robot)
        return None if known is None or known.prepared is None else known.prepared.held

    def agreed(self, robot: str) -> Answer | None:
        """For a service that was restarted while no diagnosis answers: the model in force, if others agreed on it."""
        known = self._robots.get(robot)
        version = None if known is None else known.version
        if version is None or not version.document:
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
        """Takes one step of a change; the answer comes from ``answer``."""
        known = self._robot(robot)
        if message.step == "offer":
            self._hear_offer(known, message)
        elif message.step == "take":
            self._hear_take(known, message)
        elif message.step == "drop":
            self._hear_drop(known, message)

    def welcome(self, robot: str, status: Answer | None) -> None:
        """Begins with what the diagnosis says is in force, and with a change that is under way.

        A model that cannot be used is refused like an offer, and the robot is served with the first one.
        """
        if status is None or not status.ok or not status.fingerprint:
            return
        known = self._robot(robot)
        settled = status.pending != "take" or status.fingerprint == status.pending_fingerprint
        if status.document:
            number = status.change if settled and status.pending != "offer" else 0
            agreed = _offer(status, status.fingerprint, status.document, status.margin, number)
            known.version = self._made(robot, known, agreed) or known.version
        if status.pending in ("offer", "take") and known.offer is None and known.prepared is None:
            self._take_up(robot, known, status)

    def _take_up(self, robot: str, known: _RobotModels[Held], status: Answer) -> None:
        """A change that is under way."""
        pending = _offer(
            status, status.pending_fingerprint, status.pending_document, status.pending_margin, status.change
        )
        self._hear_offer(known, pending)
        if status.pending == "take":
            self._load_offer(robot, known, pending)  # all services said that they can use it
            known.offer = None
            self._hear_take(known, _take(status, pending))

    def begin(self, robot: str, state: StateMessage) -> bool:
        """To be called once at the start of a tick: True when another model is in force from this tick on."""
        known = self._robots.get(robot)
        if known is None or known.take is None or known.prepared is None:
            return False
        take = known.take
        if state.epoch == take.epoch and state.tick < take.from_tick:
            return False  # a robot that restarted begins with the new model
        before, known.version, known.prepared, known.take = known.version, known.prepared, None, None
        known.answers.append((take, "taken", ""))
        return before.held is not known.version.held

    def answer(self, robot: str, state: StateMessage) -> TakeoverMessage | None:
        """To be called in the pause behind a tick: prepares what was offered, and returns the next answer to send."""
        known = self._robots.get(robot)
        if known is None:
            return None
        self._prepare(robot, known, wait=state.lockstep)
        if not known.answers:
            return None
        message, outcome, notice = known.answers.popleft()
        return TakeoverMessage(
            epoch=state.epoch,
            tick=state.tick,
            robot_time=state.robot_time,
            publish_time=time.time(),
            service=self._service,
            change=message.change,
            fingerprint=message.fingerprint,
            state=outcome,
            reason=notice if outcome == "refused" else "",
            expected_effect=notice if outcome == "ready" else "",
        )

    def forget(self, robot: str) -> None:
        """The robot left; when it returns it begins with the first model again, unless the others know better."""
        self._robots.pop(robot, None)

    def _robot(self, robot: str) -> _RobotModels[Held]:
        return self._robots.setdefault(robot, _RobotModels(self._first))

    def _hear_offer(self, known: _RobotModels[Held], message: ModelMessage) -> None:
        if _is(known.prepared, message):
            known.answers.append((message, "ready", ""))  # asked twice
        elif _is(known.version, message):
            known.answers.append((message, "taken", ""))
        else:
            known.offer, known.ticket, known.prepared, known.take = message, None, None, None

    def _hear_take(self, known: _RobotModels[Held], message: ModelMessage) -> None:
        if _is(known.prepared, message):
            known.take = message
        elif _is(known.version, message):
            known.answers.append((message, "taken", ""))  # asked twice
        else:
            known.answers.append((message, "refused", "it was not offered before, or not to this process"))

    def _hear_drop(self, known: _RobotModels[Held], message: ModelMessage) -> None:
        if known.offer is not None and known.offer.change == message.change:
            known.offer = known.ticket = None
        if known.prepared is not None and known.prepared.change == message.change and known.take is None:
            known.prepared = None

    def _prepare(self, robot: str, known: _RobotModels[Held], *, wait: bool) -> None:
        offer = known.offer
        if offer is None:
            return
        if self.hand_in is not None and not self._has(known, offer):
            if known.ticket is None:
                problem = _too_large(offer)
                if problem:
                    known.offer = None
                    known.answers.append((offer, "refused", problem))
                    return
                known.ticket = self.hand_in(robot, offer)
            outcome = known.ticket.outcome(wait=wait) if wait or self._clock() >= self._next_load else None
            if outcome is None:
                return
            known.offer = known.ticket = None
            problem = str(outcome.get("problem", ""))
            if problem:
                known.answers.append((offer, "refused", problem[:_LONGEST_REASON]))
                return
            offer = replace(offer, document=str(outcome.get("document", offer.document)))
        known.offer, began = None, self._clock()
        self._load_offer(robot, known, offer)
        self._next_load = 2.0 * self._clock() - began

    def _load_offer(self, robot: str, known: _RobotModels[Held], offer: ModelMessage) -> None:
        known.prepared = self._made(robot, known, offer)
        if known.prepared is not None:
            reported = "" if self._foretell is None else self._foretell(robot, known.prepared.held)
            known.answers.append((offer, "ready", reported[:_LONGEST_REASON]))

    def _has(self, known: _RobotModels[Held], offer: ModelMessage) -> bool:
        return any(_same(version, offer.fingerprint, offer.margin) for version in (known.version, self._first))

    def _made(self, robot: str, known: _RobotModels[Held], offer: ModelMessage) -> _Version[Held] | None:
        for version in (known.version, self._first):
            if _same(version, offer.fingerprint, offer.margin):  # nothing to load: only the change gets its number
                return _Version(version.held, offer.fingerprint, offer.margin, offer.change, offer.document)
        try:
            held = self._load(robot, offer)
            return _Version(held, offer.fingerprint, offer.margin, offer.change, offer.document)
        except Exception as error:  # noqa: BLE001  whatever a foreign document brings about, the robot drives on
            reason = " ".join(str(error).split()) or type(error).__name__
            known.answers.append((offer, "refused", reason[:_LONGEST_REASON]))
            return None


def _too_large(offer: ModelMessage) -> str:
    """Why an offer is not even handed on; empty where it is."""
    longest = max(len(offer.document), len(offer.margin))
    return str(too_much("offer_bytes", f"{longest} letters")) if longest > limit("offer_bytes") else ""


def _same(version: _Version[Held], fingerprint: str, margin: str) -> bool:
    return (version.fingerprint, version.margin) == (fingerprint, margin)


def _is(version: _Version[Held] | None, message: ModelMessage) -> bool:
    """Whether a version came with the change that a message is about."""
    return version is not None and (version.change, version.fingerprint) == (message.change, message.fingerprint)


def _offer(status: Answer, fingerprint: str, document: str, margin: str, change: int) -> ModelMessage:
    return _message("offer", status.epoch, change, fingerprint, document=document, margin=margin)


def _take(status: Answer, offer: ModelMessage) -> ModelMessage:
    return _message("take", status.epoch, offer.change, offer.fingerprint, from_tick=status.from_tick)


def _message(
    step: str, epoch: int, change: int, fingerprint: str, document: str = "", margin: str = "", from_tick: int = 0
) -> ModelMessage:
    """As the diagnosis would have sent it."""
    return ModelMessage(
        epoch=epoch,
        tick=0,
        robot_time=0.0,
        publish_time=time.time(),
        step=step,
        change=change,
        fingerprint=fingerprint,
        replaces="",
        document=document,
        margin=margin,
        from_tick=from_tick,
    )
