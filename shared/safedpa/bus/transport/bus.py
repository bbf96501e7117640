"""The bus as services use it: topics instead of keys, messages instead of bytes, inboxes instead of callbacks."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

from safedpa.bus.messages.codec import Entry, decode, encode, pack_bundle, split_into_bundles
from safedpa.bus.messages.messages import HealthMessage, Message, header
from safedpa.bus.messages.requests import (
    AGREED,
    CONFIRM,
    LEASE,
    REQUEST,
    STATUS,
    Answer,
    LeaseAnswer,
    LeaseRequest,
    Request,
    request_key,
    robot_of_request,
)
from safedpa.bus.messages.service_info import is_supervised, software_version
from safedpa.bus.messages.topics import BUNDLE, HEALTH, NO_ROBOT, Topic, key_of
from safedpa.bus.transport.base import AbstractTransport
from safedpa.bus.transport.inbox import Decode, Inbox, InboxReceiver, RequestOutcome
from safedpa.errors import BusError, InputError, MessageError

_CLAIM_POLL_SECONDS = 0.05
# Time for a competing instance to notice that it lost the claim and to leave. It needs up to a second to list the
# instances and, on a busy machine, some more to close its session.
_CLAIM_SETTLE_SECONDS = 5.0


def _usable(payload: bytes | None) -> Answer | None:
    """Decodes an answer; None if it is missing, malformed or a refusal."""
    try:
        answer = None if payload is None else decode(Answer, payload)
    except InputError:
        return None
    return answer if answer is not None and answer.ok else None


class Bus:
    """A participant of one fleet.

    Participants in one process may share a ``decode``. Inboxes ignore messages about robots for whose name
    ``serves(name)`` is false; None accepts all robots.
    """

    def __init__(
        self,
        transport: AbstractTransport,
        fleet: str,
        decode: Decode = decode,
        serves: Callable[[str], bool] | None = None,
    ) -> None:
        self.fleet, self._decode, self._serves = fleet, decode, serves
        self._transport = transport
        self._holds = False
        self._held: dict[tuple[Topic, str], list[Entry]] = {}

    def publish(self, topic: Topic, robot: str, message: Message, service: str = "", *, alone: bool = False) -> None:
        """Sends one message; ``service`` is the sender's name on topics that every service writes.

        ``alone`` sends it immediately and outside any bundle, even while messages are held.
        """
        if type(message) is not topic.message:
            raise MessageError(f"{topic.name}: got {type(message).__name__}, wanted {topic.message.__name__}")
        payload = encode(message)
        if self._holds and topic.bundles and not alone:
            held = self._held.get((topic, service))
            if held is None:
                held = self._held[topic, service] = []
            held.append((robot, payload))
        else:
            key = key_of(self.fleet, robot, topic, service)
            self._transport.put(key, payload, never_drop=topic.delivery == "all")

    def report_health(self, service: str, **fields: Any) -> None:
        """Publishes a heartbeat of this process that is about no robot, with further fields of ``HealthMessage``."""
        process: dict[str, Any] = {"pid": os.getpid(), "software": software_version(), "supervised": is_supervised()}
        message = HealthMessage(**header(), service=service, **process, **fields)
        self.publish(HEALTH, NO_ROBOT, message, service)

    def hold(self) -> None:
        """Collects published messages until ``flush``, which sends those of one topic as a bundle."""
        self._holds = True

    def flush(self) -> None:
        """Sends the held messages and ends holding."""
        self._holds = False
        if not self._held:
            return
        held, self._held = self._held, {}
        for (topic, service), entries in held.items():
            for part in split_into_bundles(entries):
                # A single message goes under the robot's own key, which the robot itself may read.
                robot, payload = part[0] if len(part) == 1 else (BUNDLE, pack_bundle(part))
                key = key_of(self.fleet, robot, topic, service)
                self._transport.put(key, payload, never_drop=topic.delivery == "all")

    def forget(self, robot: str) -> None:
        """Releases the resources held for publishing about a robot that left."""
        self._transport.release(f"safedpa/{self.fleet}/{robot}/")

    def inbox(
        self,
        topics: tuple[Topic, ...],
        robot: str = "*",
        *,
        keep_all: bool = False,
        alone: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> Inbox:
        """Subscribes to topics of one robot or, with ``*``, of every robot.

        ``keep_all`` keeps every message of all topics, also of those with delivery ``latest``. ``alone`` leaves out the
        bundles: a robot has no right to read them.
        """
        inbox = Inbox(clock, decode=self._decode)
        for topic in topics:
            wait_all = keep_all or topic.delivery == "all"
            accept = InboxReceiver(inbox, topic, self.fleet, robot, self._serves, all_of_them=wait_all)
            bundle = (BUNDLE,) if topic.bundles and robot != "*" and not alone else ()
            for wanted in (robot, *bundle):
                subscription = self._transport.subscribe(key_of(self.fleet, wanted, topic, "*"), accept)
                # Gathering uses a ring buffer, which drops the oldest messages; only "latest" topics tolerate that.
                if not wait_all:
                    inbox.fill_from(subscription)
        return inbox

    def request(self, robot: str, request: Request, timeout: float = 1.0, kind: str = REQUEST) -> Answer | None:
        """Sends a request about one robot and returns the answer; None if none arrives within ``timeout`` [s].

        ``kind`` selects the service: the diagnosis by default, the safety filter for ``ORDER``. Raises MessageError if
        the answer is malformed.
        """
        payload = self._transport.ask(request_key(self.fleet, robot, kind), encode(request), timeout)
        return None if payload is None else decode(Answer, payload)

    def ask_model(self, inbox: Inbox, robot: str, who: str, timeout: float) -> None:
        """Asks asynchronously which model a robot's services agreed on; puts the answer into ``inbox``.

        Asks the diagnosis first and, if it does not answer within ``timeout`` [s], the other services.
        """
        # The diagnosis decides on changes and knows the pending one; the services only know what they use.
        question = encode(Request(do="status", who=who))

        def from_services(payload: bytes | None) -> None:
            inbox.keep_answer(RequestOutcome(robot, _usable(payload)))

        def from_diagnosis(payload: bytes | None) -> None:
            answer = _usable(payload)
            if answer is not None:
                inbox.keep_answer(RequestOutcome(robot, answer))
            else:
                key = request_key(self.fleet, robot, AGREED)
                self._transport.ask_soon(key, question, timeout, from_services)

        self._transport.ask_soon(request_key(self.fleet, robot, STATUS), question, timeout, from_diagnosis)

    def answer_agreed(self, agreed: Callable[[str], Answer | None]) -> None:
        """Answers other services with ``agreed(robot)``, called on any thread; None: this service does not know."""

        def on_question(key: str, payload: bytes) -> bytes | None:
            try:
                answer = agreed(robot_of_request(key))
            except InputError:
                return None
            return None if answer is None else encode(answer)

        self._transport.answer(request_key(self.fleet, "*", AGREED), on_question)

    def answer_requests(
        self,
        answer: Callable[[str, Request], Answer],
        robot: str = "*",
        report_progress: Callable[[str, Request | None, Answer], None] | None = None,
        kinds: tuple[str, ...] = (REQUEST, STATUS),
    ) -> None:
        """Answers requests about one robot or every robot by ``answer(robot, request)``, called on any thread.

        A malformed request, one that ``answer`` refuses by InputError, and any request but ``status`` or ``confirm``
        under its key is answered with the reason. ``report_progress(robot, request, answer)`` is called before the
        answer is sent; the request is None if it was malformed.
        """

        def on_question(key: str, payload: bytes) -> bytes:
            about, request = "", None
            try:
                about, request = robot_of_request(key), decode(Request, payload)
                # The router grants services the status key only; without this check it would open every request.
                if key.endswith((f"/{STATUS}", f"/{CONFIRM}")) and request.do != key.rpartition("/")[2]:
                    raise MessageError(f"'{request.do}': got it under '{key}', wanted it under another key")
                given = answer(about, request)
            except InputError as error:
                given = Answer(ok=False, sentence=f"refused: {error}")
            if report_progress is not None:
                report_progress(about, request, given)
            return encode(given)

        for kind in kinds:
            self._transport.answer(request_key(self.fleet, robot, kind), on_question)

    def ask_lease(self, request: LeaseRequest, timeout: float) -> LeaseAnswer | None:
        """Asks the router for the lease of a service; None without a valid answer within ``timeout`` [s]."""
        payload = self._transport.ask(request_key(self.fleet, NO_ROBOT, LEASE), encode(request), timeout)
        try:
            return None if payload is None else decode(LeaseAnswer, payload)
        except MessageError:
            return None

    def answer_leases(self, answer: Callable[[LeaseRequest], LeaseAnswer]) -> None:
        """Answers the instances that ask for a lease, on any thread; malformed questions get no answer."""

        def on_question(_key: str, payload: bytes) -> bytes | None:
            try:
                return encode(answer(decode(LeaseRequest, payload)))
            except MessageError:
                return None

        self._transport.answer(request_key(self.fleet, NO_ROBOT, LEASE), on_question)

    def announce(self, robot: str, service: str, instance: str) -> None:
        """Declares that an instance of ``service`` is alive; for services of the whole fleet the robot is ``-``."""
        self._transport.declare_alive(f"safedpa/{self.fleet}/{robot}/alive/{service}/{instance}")

    def instances(self, robot: str, service: str) -> list[str]:
        """Returns the live instances of a service."""
        keys = self._transport.alive(f"safedpa/{self.fleet}/{robot}/alive/{service}/*")
        return [key.rsplit("/", 1)[1] for key in keys]

    def claim(self, robot: str, service: str, instance: str, settle_seconds: float = _CLAIM_SETTLE_SECONDS) -> None:
        """Announces this process as the only instance of a service.

        Of two instances that start at the same time the one with the lower identifier stays. It waits up to
        ``settle_seconds`` for the other one to leave. Raises BusError if another instance is alive; the caller then
        closes the bus.
        """
        others = self._others(robot, service, instance)
        if not others:
            # Announce before looking again: of two that start together at least one then sees the other. With the
            # opposite order both could look, see no instance, and stay.
            self.announce(robot, service, instance)
            others = self._others(robot, service, instance)
            give_up = time.monotonic() + settle_seconds
            while others and instance < min(others) and time.monotonic() < give_up:
                time.sleep(_CLAIM_POLL_SECONDS)
                others = self._others(robot, service, instance)
        if others:
            raise BusError(
                f"{service} '{robot}' of fleet '{self.fleet}' is already running (instance {others[0]}); "
                "choose another name, or stop the other instance first"
            )

    def _others(self, robot: str, service: str, instance: str) -> list[str]:
        return [other for other in self.instances(robot, service) if other != instance]

    def close(self) -> None:
        """Leaves the bus."""
        self._transport.close()

    def __enter__(self) -> Bus:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()
