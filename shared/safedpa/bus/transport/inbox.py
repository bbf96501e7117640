"""The inbox: received messages that wait for the loop to read them.

``Inbox`` has bounded memory, regardless of the senders, and drops messages of the largest backlog first.
``InboxReceiver`` is the callback of a transport: it filters the messages of one topic, unpacks bundles, and puts the
result into an inbox.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any, NamedTuple, final

from safedpa.bus.messages.codec import decode, unpack_bundle
from safedpa.bus.messages.messages import Message
from safedpa.bus.messages.requests import Answer
from safedpa.bus.messages.topics import BUNDLE, TOPICS, Topic, key_of, topic_of
from safedpa.bus.transport.base import Subscription
from safedpa.errors import InputError, MessageError

# Limits of one inbox. A service that reads its inbox is far below them: 1000 robots at 20 Hz reach 100 000 messages
# only after 5 s without a read. They stop a flood or a stalled reader from exhausting the memory of the machine.
_LONGEST_QUEUE = 100_000
_LARGEST_QUEUE_BYTES = 256 * 1024 * 1024
# Topics with delivery "latest" keep one message per key, and anyone may send under new names.
_MOST_KEYS = 16_384
# Size limit of one message by delivery. A larger message is cut to one byte more than its limit: it is still rejected
# as too large when it is decoded, and does not occupy memory until then.
_LARGEST_LATEST, _LARGEST_QUEUED = (
    max(topic.largest_bytes for topic in TOPICS.values() if topic.delivery == delivery)
    for delivery in ("latest", "all")
)


Decode = Callable[[type[Any], bytes], Any]
"""Signature of ``codec.decode``."""


class ReceivedMessage(NamedTuple):
    """A received and decoded message; ``at`` is the time of arrival [s] by the receiver's clock."""

    topic: Topic
    robot: str
    message: Message
    payload: bytes
    key: str
    at: float
    bundled: bool = False
    """Whether it arrived in a bundle."""


@dataclass(frozen=True, slots=True)
class RejectedMessage:
    """Received bytes that are not a valid message, or whose key does not name a robot and topic."""

    key: str
    robot: str
    """Empty if the key does not name a robot."""
    reason: str


@dataclass(frozen=True, slots=True)
class RequestOutcome:
    """Result of a question about a robot; the answer is None after a timeout."""

    robot: str
    answer: Answer | None


@dataclass(slots=True)
class _Queue:
    """Waiting messages of one key."""

    messages: deque[tuple[bytes, float]] = field(default_factory=deque)
    size: int = 0
    """Bytes of all messages."""


@final
class SharedPayload:
    """A received payload that several inboxes of one process may share; the first reader decodes it for all."""

    __slots__ = ("bundled", "content", "key", "payload")

    def __init__(self, key: str, payload: bytes, *, bundled: bool = False) -> None:
        self.key, self.payload, self.bundled = key, payload, bundled
        self.content: ReceivedMessage | RejectedMessage | None = None
        """The decoded message; None until the first reader decodes it."""


# Key, payload (possibly cut), time of arrival [s], and the cell for the decoded message.
_Waiting = tuple[str, bytes, float, SharedPayload]


class Inbox:
    """Unread messages, filled by network threads and emptied by one loop.

    For topics with delivery ``latest`` only the newest message per key waits; for the others all messages wait, in
    order. Memory is bounded: at most ``longest_queue`` messages and 256 MiB wait. Beyond either limit the key with the
    most bytes waiting loses its oldest message, so that a flood displaces its own messages and not those of others.
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
        self._on_arrival: Callable[[], None] | None = None
        self.dropped = 0
        """Number of messages lost because too many were waiting."""

    @property
    def waiting(self) -> bool:
        """Whether ``take`` would return something now."""
        self._collect()
        return bool(self._latest or self._queues or self._answers)

    def fill_from(self, subscription: Subscription) -> None:
        """Registers a subscription that fills this inbox and may gather messages at high rates."""
        self._subscriptions.append(subscription)

    def coalesce(self, quantum: float) -> None:
        """Batches messages: ``take`` returns no earlier than ``quantum`` [s] after the last collection.

        With 0, ``take`` returns messages as they arrive. To be called on the thread that calls ``take``.
        """
        if (quantum > 0.0) is not (self._quantum > 0.0):
            for subscription in self._subscriptions:
                if quantum > 0.0:
                    subscription.gather()
                else:
                    subscription.pass_on()
        self._quantum = quantum

    def set_listener(self, on_arrival: Callable[[], None] | None) -> None:
        """Calls ``on_arrival`` after each message from now on, on the thread that delivered it; None: no callback."""
        self._on_arrival = on_arrival

    def _collect(self) -> None:
        if self._quantum > 0.0:
            for subscription in self._subscriptions:
                subscription.collect()

    def keep_latest(self, key: str, payload: bytes) -> None:
        """Adds one payload; replaces an unread one of the same key."""
        self.add_payloads([SharedPayload(key, payload)], all_of_them=False)
        self.announce()

    def keep_all(self, key: str, payload: bytes) -> None:
        """Appends one payload to the unread ones."""
        self.add_payloads([SharedPayload(key, payload)], all_of_them=True)
        self.announce()

    def add_payloads(self, payloads: Sequence[SharedPayload], *, all_of_them: bool) -> None:
        """Adds payloads without calling the listener; call ``announce`` once all inboxes have them."""
        with self._filled:
            now = self._clock()
            if all_of_them:
                for shared in payloads:
                    self._put_last(shared, now)
            else:
                for shared in payloads:
                    self._put_latest(shared, now)
            self._filled.notify()

    def announce(self) -> None:
        """Calls the listener."""
        # Outside the lock: the listener runs a service's loop, which takes from this inbox.
        if self._on_arrival is not None:
            self._on_arrival()

    def _put_latest(self, shared: SharedPayload, at: float) -> None:
        key, payload, latest = shared.key, shared.payload, self._latest
        # A full table rejects new keys instead of evicting old ones, so that invented names displace no real robot.
        if len(latest) >= _MOST_KEYS and key not in latest:
            self.dropped += 1
        elif len(payload) <= _LARGEST_LATEST:
            latest[key] = (key, payload, at, shared)
        else:
            # A new SharedPayload: the cut copy must not be decoded in place of the complete one in other inboxes.
            latest[key] = (key, _cut(payload, _LARGEST_LATEST), at, SharedPayload(key, b"", bundled=shared.bundled))

    def _put_last(self, shared: SharedPayload, at: float) -> None:
        retained, key = _cut(shared.payload, _LARGEST_QUEUED), shared.key
        queue = self._queues.setdefault(key, _Queue())
        queue.messages.append((retained, at))
        queue.size += len(retained)
        self._queued += 1
        self._queued_bytes += len(retained)
        while self._queued > self._longest_queue or self._queued_bytes > _LARGEST_QUEUE_BYTES:
            # From the key with the most bytes waiting, so that a flood under one key loses only its own messages.
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
        """Adds the result of a question and calls the listener."""
        with self._filled:
            self._answers.append(answered)
            self._filled.notify()
        self.announce()

    def take_answers(self) -> list[RequestOutcome]:
        """Returns the results of questions since the last call; never waits."""
        with self._filled:
            answers, self._answers = self._answers, []
        return answers

    def take(self, timeout: float, most: int | None = None) -> list[ReceivedMessage | RejectedMessage]:
        """Returns the unread messages, oldest first; waits up to ``timeout`` [s] for the first message or answer.

        Returns at most ``most`` messages per key, so that one sender's backlog does not delay the others.
        """
        # While coalescing, messages wait in Zenoh's ring and notify no one: sleep, then collect them.
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
        # Decoding happens outside the lock, so that network threads can continue to add messages.
        taken = []
        for key, payload, at, shared in waiting:
            content = shared.content
            if content is None:
                content = shared.content = self._opened(key, payload, at, shared.bundled)
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
        """Sleeps until the batch interval is over (not at all for a ``timeout`` of 0), then collects."""
        rest = self._collected + self._quantum - time.monotonic()
        if timeout > 0.0 and rest > 0.0:
            time.sleep(min(rest, self._quantum))
        self._collected = time.monotonic()
        self._collect()


def _cut(payload: bytes, largest: int) -> bytes:
    """Returns the payload, cut to one byte more than ``largest`` if it is longer."""
    return payload if len(payload) <= largest else payload[: largest + 1]


def _check_speaker(key: str, message: Message) -> None:
    """Raises MessageError if the service named in the message is not the one in its key."""
    # The router guarantees only that the sender may write under this key. Readers use the name in the message.
    service = key.rsplit("/", 1)[1]
    sender = getattr(message, "service", service)
    if sender != service:
        raise MessageError(f"key '{key}': got a message of service '{sender[:40]}', wanted one of '{service}'")


@final
class InboxReceiver:
    """Callback of a transport that puts the messages of one topic into ``inbox``.

    ``wanted`` is the robot subscribed to, or ``*``. Messages about robots for whose name ``serves(name)`` is false are
    ignored. ``all_of_them`` keeps every message instead of the newest per key.
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
        """Handles one received payload."""
        payloads = self.opened(key, payload)
        if payloads:
            self.put(payloads)
            self.announce()

    def opened(self, key: str, payload: bytes) -> list[SharedPayload]:
        """Returns the wanted messages of a payload: the payload itself, or the entries of a bundle."""
        if key.startswith(self._bundles) and "*" not in key:
            try:
                return self._payloads(key, payload)
            except InputError:
                # Put the malformed bundle into the inbox: the loop rejects it there, with a reason that is counted.
                return [SharedPayload(key, payload)]
        served = self._serves is None or self._serves(key[self._begins :].partition("/")[0])
        return [SharedPayload(key, payload)] if served else []

    def put(self, payloads: list[SharedPayload]) -> None:
        """Puts payloads into the inbox; call ``announce`` afterwards.

        Receivers for which ``asks_as`` is true may share payloads.
        """
        self._inbox.add_payloads(payloads, all_of_them=self._all_of_them)

    def announce(self) -> None:
        """Calls the inbox's listener."""
        self._inbox.announce()

    def asks_as(self, other: InboxReceiver) -> bool:
        """Whether both receivers have the same subscription, so that an unpacked payload is valid for both."""
        return (self._topic, self._fleet, self._wanted, self._serves) == (
            other._topic,
            other._fleet,
            other._wanted,
            other._serves,
        )

    def _payloads(self, key: str, payload: bytes) -> list[SharedPayload]:
        """Returns the wanted entries of a bundle. Raises InputError if it is malformed."""
        topic, fleet, wanted, serves = self._topic, self._fleet, self._wanted, self._serves
        service = key.rsplit("/", 1)[1] if topic.per_service else ""
        # Check the size before unpacking, and the exact key: a longer one would add parts that no one checks.
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
