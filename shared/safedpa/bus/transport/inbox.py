"""What arrived and waits to be read: bounded, anyone who sends, and fair to those who send little.

From the transport into an inbox: what is asked for of one topic, alone or out of a bundle.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any, NamedTuple, final

from safedpa.bus.messages.codec import decode
from safedpa.bus.messages.messages import Message
from safedpa.bus.messages.requests import Answer
from safedpa.bus.messages.topics import BUNDLE, TOPICS, Topic, key_of, topic_of
from safedpa.bus.transport.base import Subscription
from safedpa.bus.transport.batching import unpack_bundle
from safedpa.errors import InputError, MessageError

__all__ = [
    "Inbox",
    "InboxReceiver",
    "ReceivedMessage",
    "RejectedMessage",
    "RequestOutcome",
    "SharedPayload",
]

_LONGEST_QUEUE = 100_000
"""Messages of topics that must not be dropped, waiting in one inbox."""
_LARGEST_QUEUE_BYTES = 256 * 1024 * 1024
_MOST_KEYS = 16_384
"""Different keys of topics with delivery ``latest`` that wait in one inbox: names may come from anybody."""
_LARGEST_LATEST, _LARGEST_QUEUED = (
    max(topic.largest_bytes for topic in TOPICS.values() if topic.delivery == delivery)
    for delivery in ("latest", "all")
)
"""Bytes of one message; what is larger is refused when it is read, and not kept until then."""


Decode = Callable[[type[Any], bytes], Any]
"""As ``codec.decode``."""


class ReceivedMessage(NamedTuple):
    """A message that arrived; ``at`` [s] by the receiver's clock."""

    topic: Topic
    robot: str
    message: Message
    payload: bytes
    key: str
    at: float
    bundled: bool = False
    """Whether it came among others."""


@dataclass(frozen=True, slots=True)
class RejectedMessage:
    """Bytes that arrived and are no message, or whose key names no robot and topic: see the reason."""

    key: str
    robot: str
    """Empty when the key names none."""
    reason: str


@dataclass(frozen=True, slots=True)
class RequestOutcome:
    """What came of a question about a robot; None when no one answered in time."""

    robot: str
    answer: Answer | None


@dataclass(slots=True)
class _Queue:
    """What waits under one key."""

    messages: deque[tuple[bytes, float]] = field(default_factory=deque)
    size: int = 0
    """Bytes."""


@final
class SharedPayload:
    """A message that several inboxes of one process may hold: it is read for the first who takes it, once for all."""

    __slots__ = ("bundled", "content", "key", "payload")

    def __init__(self, key: str, payload: bytes, *, bundled: bool = False) -> None:
        self.key, self.payload, self.bundled = key, payload, bundled
        self.content: ReceivedMessage | RejectedMessage | None = None
        """What was read; None until someone did."""


_Waiting = tuple[str, bytes, float, SharedPayload]
"""Key, so much of the payload as is kept, when it came, and what holds what is read of it."""


class Inbox:
    """What arrived and was not read yet; filled by network threads, emptied by one loop.

    Of topics with delivery ``latest`` only the newest message per key waits; of the others everything, in order. Memory
    is bounded anyone who sends: ``longest_queue`` messages and 256 MiB wait at most, and beyond either the key that has
    most waiting loses its oldest, so that a sender of floods loses its own; so many different keys, and of each message
    so many bytes, that a larger one is seen to be too large.
    """

    def __init__(
        self,
        clock: Callable[[], float] = time.monotonic,
        longest_queue: int = _LONGEST_QUEUE,
        decode: Decode = decode,
    ) -> None:
        self._clock, self._decode = clock, decode
        self._longest_queue = longest_queue
        self._filled = threading.Condition()
        self._latest: dict[str, _Waiting] = {}
        self._queues: dict[str, _Queue] = {}
        self._queued = self._queued_bytes = 0
        self._answers: list[RequestOutcome] = []
        self._subscriptions: list[Subscription] = []
        self._quantum, self._collected = 0.0, 0.0
        self._came: Callable[[], None] | None = None
        self.dropped = 0
        """Messages lost because too many were waiting."""

    @property
    def waiting(self) -> bool:
        """Whether something can be taken now."""
        self._collect()
        return bool(self._latest or self._queues or self._answers)

    def fill_from(self, subscription: Subscription) -> None:
        """Names a subscription that fills this inbox and may gather while there are many messages."""
        self._subscriptions.append(subscription)

    def coalesce(self, quantum: float) -> None:
        """From now on ``take`` waits until ``quantum`` [s] after it last collected, and takes all as one batch.

        With 0 it takes each message as it comes. Meant for the one thread that takes.
        """
        if (quantum > 0.0) is not (self._quantum > 0.0):
            for subscription in self._subscriptions:
                if quantum > 0.0:
                    subscription.gather()
                else:
                    subscription.pass_on()
        self._quantum = quantum

    def lead(self, came: Callable[[], None] | None) -> None:
        """From now on calls ``came`` after each message, on the thread that brought it; None: no more."""
        self._came = came

    def _collect(self) -> None:
        if self._quantum > 0.0:
            for subscription in self._subscriptions:
                subscription.collect()

    def keep_latest(self, key: str, payload: bytes) -> None:
        """Accepts one payload; replaces an unread one of the same key."""
        self.keep_parcels([SharedPayload(key, payload)], all_of_them=False)

    def keep_all(self, key: str, payload: bytes) -> None:
        """Accepts one payload behind all unread ones."""
        self.keep_parcels([SharedPayload(key, payload)], all_of_them=True)

    def keep_parcels(self, parcels: Sequence[SharedPayload], *, all_of_them: bool) -> None:
        """Accepts what came at one moment, each as ``keep_latest`` or ``keep_all`` does."""
        self.add_parcels(parcels, all_of_them=all_of_them)
        self.announce()

    def add_parcels(self, parcels: Sequence[SharedPayload], *, all_of_them: bool) -> None:
        """The same, but anyone who leads is not told yet; ``announce`` follows once others have it, too."""
        with self._filled:
            now = self._clock()
            if all_of_them:
                for parcel in parcels:
                    self._put_last(parcel, now)
            else:
                for parcel in parcels:
                    self._put_latest(parcel, now)
            self._filled.notify()

    def announce(self) -> None:
        """Tells anyone who leads that something came."""
        if self._came is not None:
            self._came()

    def _put_latest(self, parcel: SharedPayload, at: float) -> None:
        key, payload, latest = parcel.key, parcel.payload, self._latest
        if len(latest) >= _MOST_KEYS and key not in latest:
            self.dropped += 1
        elif len(payload) <= _LARGEST_LATEST:
            latest[key] = (key, payload, at, parcel)
        else:
            latest[key] = (key, _cut(payload, _LARGEST_LATEST), at, SharedPayload(key, b"", bundled=parcel.bundled))

    def _put_last(self, parcel: SharedPayload, at: float) -> None:
        retained, key = _cut(parcel.payload, _LARGEST_QUEUED), parcel.key
        queue = self._queues.setdefault(key, _Queue())
        queue.messages.append((retained, at))
        queue.size += len(retained)
        self._queued += 1
        self._queued_bytes += len(retained)
        while self._queued > self._longest_queue or self._queued_bytes > _LARGEST_QUEUE_BYTES:
            self._drop_one()

    def _drop_one(self) -> None:
        """The oldest message of the key that has most bytes waiting."""
        self._pop(max(self._queues, key=lambda name: self._queues[name].size))
        self.dropped += 1

    def _pop(self, key: str) -> tuple[bytes, float]:
        queue = self._queues[key]
        payload, at = queue.messages.popleft()
        queue.size -= len(payload)
        self._queued -= 1
        self._queued_bytes -= len(payload)
        if not queue.messages:
            del self._queues[key]
        return payload, at

    def keep_answer(self, answered: RequestOutcome) -> None:
        """Accepts what came of a question."""
        with self._filled:
            self._answers.append(answered)
            self._filled.notify()
        if self._came is not None:
            self._came()

    def take_answers(self) -> list[RequestOutcome]:
        """What came of questions asked since the last call; never waits."""
        with self._filled:
            answers, self._answers = self._answers, []
        return answers

    def take(self, timeout: float, most: int | None = None) -> list[ReceivedMessage | RejectedMessage]:
        """What is unread, oldest first; waits up to ``timeout`` [s] for the first message or answer.

        Of each key at most ``most`` messages: who has sent a thousand does not keep the others waiting.
        """
        if self._quantum > 0.0:
            self._sleep(timeout)
            timeout = 0.0
        with self._filled:
            if timeout > 0.0 and not self.waiting:
                self._filled.wait(timeout)
            waiting = list(self._latest.values())
            self._latest = {}
            for key, queue in list(self._queues.items()):
                count = len(queue.messages) if most is None else min(most, len(queue.messages))
                waiting += [(key, *self._pop(key), SharedPayload(key, b"")) for _ in range(count)]
        waiting.sort(key=itemgetter(2))
        taken = []
        for key, payload, at, parcel in waiting:
            content = parcel.content
            if content is None:
                content = parcel.content = self._opened(key, payload, at, parcel.bundled)
            taken.append(content)
        return taken

    def _opened(self, key: str, payload: bytes, at: float, bundled: bool) -> ReceivedMessage | RejectedMessage:
        robot = ""
        try:
            _, robot, topic = topic_of(key)
            message = self._decode(topic.message, payload)
            if topic.per_service:
                _check_speaker(key, message)
            return ReceivedMessage(topic, robot, message, payload, key, at, bundled)
        except InputError as error:
            return RejectedMessage(key, robot, str(error))

    def _sleep(self, timeout: float) -> None:
        """Until the quantum is over, unless it shall not wait at all; then collects."""
        rest = self._collected + self._quantum - time.monotonic()
        if timeout > 0.0 and rest > 0.0:
            time.sleep(min(rest, self._quantum))
        self._collected = time.monotonic()
        self._collect()


def _cut(payload: bytes, largest: int) -> bytes:
    """The payload, or so much of it that it is still seen to be too large."""
    return payload if len(payload) <= largest else payload[: largest + 1]


def _check_speaker(key: str, message: Message) -> None:
    """The router vouches for the key's last part, so no one speaks as another service in the message either."""
    service = key.rsplit("/", 1)[1]
    notice = getattr(message, "service", service)
    if notice != service:
        raise MessageError(f"key '{key}': got a message of service '{notice[:40]}', wanted one of '{service}'")


@final
class InboxReceiver:
    """Called by a transport with key and payload; puts what is asked for into ``inbox``.

    Of robots for whose name ``serves`` is false nothing gets in; ``wanted`` is the robot asked for, or ``*``;
    ``all_of_them``: nothing is dropped.
    """

    def __init__(
        self,
        inbox: Inbox,
        topic: Topic,
        fleet: str,
        wanted: str,
        serves: Callable[[str], bool] | None,
        *,
        all_of_them: bool,
    ) -> None:
        self._inbox, self._topic, self._fleet, self._all_of_them = inbox, topic, fleet, all_of_them
        self._wanted, self._serves = wanted, serves
        self._begins = len(f"safedpa/{fleet}/")
        self._bundles = f"safedpa/{fleet}/{BUNDLE}/{topic.name}"

    def __call__(self, key: str, payload: bytes) -> None:
        """Accepts what came under ``key``."""
        parcels = self.opened(key, payload)
        if parcels:
            self.put(parcels)
            self.announce()

    def opened(self, key: str, payload: bytes) -> list[SharedPayload]:
        """What came under ``key``, as far as it is asked for: alone, or each message of a bundle by itself."""
        if key.startswith(self._bundles) and "*" not in key:
            try:
                return self._parcels(key, payload)
            except InputError:
                return [SharedPayload(key, payload)]  # is refused where it is read, since its key names no robot
        served = self._serves is None or self._serves(key[self._begins :].partition("/")[0])
        return [SharedPayload(key, payload)] if served else []

    def put(self, parcels: list[SharedPayload]) -> None:
        """Into the inbox; parcels may be shared with others where ``asks_as`` is true, and ``announce`` follows."""
        self._inbox.add_parcels(parcels, all_of_them=self._all_of_them)

    def announce(self) -> None:
        """What was put there may be acted upon."""
        self._inbox.announce()

    def asks_as(self, other: InboxReceiver) -> bool:
        """Whether it asks for the same as ``other``, so that what one of them opened is right for both."""
        return (self._topic, self._fleet, self._wanted, self._serves) == (
            other._topic,
            other._fleet,
            other._wanted,
            other._serves,
        )

    def _parcels(self, key: str, payload: bytes) -> list[SharedPayload]:
        """Each message of a bundle that is asked for. Raises InputError where it is no bundle."""
        topic, fleet, wanted, serves = self._topic, self._fleet, self._wanted, self._serves
        service = key.rsplit("/", 1)[1] if topic.per_service else ""
        if len(payload) > topic.largest_bytes or key != key_of(fleet, BUNDLE, topic, service):
            raise MessageError(f"key '{key}': got {len(payload)} bytes, wanted a bundle of {topic.name}")
        entries = unpack_bundle(payload)
        if wanted != "*":
            entries = [entry for entry in entries if entry[0] == wanted]
        if serves is not None:
            entries = [entry for entry in entries if serves(entry[0])]
        return [
            SharedPayload(key_of(fleet, robot, topic, service), message, bundled=True) for robot, message in entries
        ]
