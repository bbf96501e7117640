"""Transports inside one process: ``MemoryTransport`` and ``JointTransport``.

``MemoryTransport`` is for tests and for experiments faster than real time; it delivers messages immediately.
``JointTransport`` lets several services of one process share one session. It passes messages between them directly, and
also sends them out for the recorder and other listeners.
"""

from __future__ import annotations

from typing import final

from safedpa.bus.transport.base import AbstractTransport, OnAnswer, OnQuestion, OnSample, Subscription
from safedpa.bus.transport.inbox import InboxReceiver, SharedPayload
from safedpa.errors import BusError


class MemoryBroker:
    """Connects all ``MemoryTransport`` that are created with it."""

    def __init__(self) -> None:
        self.subscribers: list[tuple[MemoryTransport, str, OnSample]] = []
        self.tokens: list[tuple[MemoryTransport, str]] = []
        self.answerers: list[tuple[MemoryTransport, str, OnQuestion]] = []


@final
class MemoryTransport(AbstractTransport):
    """A participant in memory. ``put`` calls the subscribers before it returns, in the order of subscription."""

    def __init__(self, broker: MemoryBroker) -> None:
        self._broker = broker
        self._closed = False

    def put(self, key: str, payload: bytes, *, never_drop: bool) -> None:  # noqa: D102
        if self._closed:
            raise BusError(f"{key}: the bus was closed; open another one to send")
        # A copy: a subscriber may subscribe or close in its callback.
        for _, expression, on_sample in tuple(self._broker.subscribers):
            if _matches(expression, key):
                on_sample(key, payload)

    def subscribe(self, key_expression: str, on_sample: OnSample) -> Subscription:  # noqa: D102
        self._broker.subscribers.append((self, key_expression, on_sample))
        return Subscription()

    def declare_alive(self, key: str) -> None:  # noqa: D102
        self._broker.tokens.append((self, key))

    def alive(self, key_expression: str) -> list[str]:  # noqa: D102
        return sorted(key for _, key in self._broker.tokens if _matches(key_expression, key))

    def answer(self, key_expression: str, on_question: OnQuestion) -> None:  # noqa: D102
        self._broker.answerers.append((self, key_expression, on_question))

    def ask(self, key: str, payload: bytes, timeout: float) -> bytes | None:  # noqa: D102
        if self._closed:
            raise BusError(f"{key}: the bus was closed; open another one to ask")
        asked = [on_question for _, expression, on_question in self._broker.answerers if _matches(expression, key)]
        answers = (on_question(key, payload) for on_question in asked)
        return next((answer for answer in answers if answer is not None), None)

    def ask_soon(self, key: str, payload: bytes, timeout: float, on_answer: OnAnswer) -> None:  # noqa: D102
        on_answer(self.ask(key, payload, timeout))

    def close(self) -> None:  # noqa: D102
        self._closed = True
        self._broker.answerers = [entry for entry in self._broker.answerers if entry[0] is not self]
        self._broker.subscribers = [entry for entry in self._broker.subscribers if entry[0] is not self]
        self._broker.tokens = [entry for entry in self._broker.tokens if entry[0] is not self]


def _matches(expression: str, key: str) -> bool:
    wanted, got = expression.split("/"), key.split("/")
    return len(wanted) == len(got) and all(part in ("*", other) for part, other in zip(wanted, got, strict=True))


@final
class JointTransport(AbstractTransport):
    """One participant of ``outer``, shared by several services of this process.

    Topics in ``inside`` are delivered from this process only, immediately and in order. The others are received over
    ``outer``, with one subscription for all services.
    """

    # Messages of ``inside`` topics from other processes are ignored: their sender pretends to be a service that runs
    # here.

    def __init__(self, outer: AbstractTransport, inside: frozenset[str]) -> None:
        self._outer, self._inside = outer, inside
        self._local: dict[str, list[tuple[str, OnSample]]] = {topic: [] for topic in inside}
        self._shared: dict[str, tuple[list[OnSample], Subscription]] = {}

    def put(self, key: str, payload: bytes, *, never_drop: bool) -> None:  # noqa: D102
        self._outer.put(key, payload, never_drop=never_drop)
        _, _, robot, topic, *_ = key.split("/")
        local = self._local.get(topic)
        if local:
            _deliver([on_sample for wanted, on_sample in local if wanted in ("*", robot)], key, payload)

    def release(self, prefix: str) -> None:  # noqa: D102
        self._outer.release(prefix)

    def subscribe(self, key_expression: str, on_sample: OnSample) -> Subscription:  # noqa: D102
        _, _, robot, topic, *_ = key_expression.split("/")
        if topic in self._inside:
            self._local[topic].append((robot, on_sample))
            return Subscription()
        if key_expression not in self._shared:
            receivers: list[OnSample] = []
            self._shared[key_expression] = receivers, self._outer.subscribe(key_expression, self._to_all(receivers))
        receivers, subscription = self._shared[key_expression]
        receivers.append(on_sample)
        return subscription

    def _to_all(self, receivers: list[OnSample]) -> OnSample:
        def on_sample(key: str, payload: bytes) -> None:
            # Services are created in the order in which they compute. The first of them receives a state last, so that
            # the others already have it when its result arrives.
            _deliver(receivers[::-1], key, payload)

        return on_sample

    def declare_alive(self, key: str) -> None:  # noqa: D102
        self._outer.declare_alive(key)

    def alive(self, key_expression: str) -> list[str]:  # noqa: D102
        return self._outer.alive(key_expression)

    def answer(self, key_expression: str, on_question: OnQuestion) -> None:  # noqa: D102
        self._outer.answer(key_expression, on_question)

    def ask(self, key: str, payload: bytes, timeout: float) -> bytes | None:  # noqa: D102
        return self._outer.ask(key, payload, timeout)

    def ask_soon(self, key: str, payload: bytes, timeout: float, on_answer: OnAnswer) -> None:  # noqa: D102
        self._outer.ask_soon(key, payload, timeout, on_answer)

    def close(self) -> None:  # noqa: D102
        self._outer.close()


def _deliver(receivers: list[OnSample], key: str, payload: bytes) -> None:
    """Delivers a message to all receivers, in order, before any of them acts on it.

    Receivers with equal subscriptions share the unpacked bundle and its decoded messages.
    """
    first: InboxReceiver | None = None
    shared: list[SharedPayload] = []
    reported: list[InboxReceiver] = []
    for on_sample in receivers:
        if not isinstance(on_sample, InboxReceiver):
            on_sample(key, payload)
            continue
        if first is None:
            first, shared = on_sample, on_sample.opened(key, payload)
        payloads = shared if on_sample is first or on_sample.asks_as(first) else on_sample.opened(key, payload)
        if payloads:
            on_sample.put(payloads)
            reported.append(on_sample)
    # Announcing runs a service's loop on this thread. It must not start before every inbox has the message.
    for receiver in reported:
        receiver.announce()
