"""A bus inside one process, for tests and for experiments faster than real time. Delivery is immediate."""

from __future__ import annotations

from typing import final

from safedpa.bus.transport.transport import AbstractTransport, OnAnswer, OnQuestion, OnSample, Subscription
from safedpa.errors import BusError

__all__ = ["MemoryBroker", "MemoryTransport"]


class MemoryBroker:
    """The common ground of all ``MemoryTransport`` that shall hear each other."""

    def __init__(self) -> None:
        self.subscribers: list[tuple[MemoryTransport, str, OnSample]] = []
        self.tokens: list[tuple[MemoryTransport, str]] = []
        self.answerers: list[tuple[MemoryTransport, str, OnQuestion]] = []


@final
class MemoryTransport(AbstractTransport):
    """One participant. ``put`` calls the subscribers before it returns, in the order in which they subscribed."""

    def __init__(self, broker: MemoryBroker) -> None:
        self._broker = broker
        self._closed = False

    def put(self, key: str, payload: bytes, *, never_drop: bool) -> None:  # noqa: D102
        del never_drop
        if self._closed:
            raise BusError(f"{key}: the bus was closed; open another one to send")
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
        del timeout
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
