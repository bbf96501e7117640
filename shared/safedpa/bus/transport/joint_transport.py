"""Several services in one process over one session: what they say to each other does not leave the process to reach
them, and all of it goes out as well, for whoever looks on."""

from __future__ import annotations

from typing import final

from safedpa.bus.transport.accepting import Accepting
from safedpa.bus.transport.inbox import Parcel
from safedpa.bus.transport.transport import AbstractTransport, OnAnswer, OnQuestion, OnSample, Subscription

__all__ = ["JointTransport"]


@final
class JointTransport(AbstractTransport):
    """One participant that stands for several.

    Topics named in ``inside`` are heard from this process alone, at once and in order: who else sends them, speaks for
    a service that lives here. The others come over ``outer``, once for all who subscribe.
    """

    def __init__(self, outer: AbstractTransport, inside: frozenset[str]) -> None:
        self._outer, self._inside = outer, inside
        self._local: dict[str, list[tuple[str, OnSample]]] = {topic: [] for topic in inside}
        self._shared: dict[str, tuple[list[OnSample], Subscription]] = {}

    def put(self, key: str, payload: bytes, *, never_drop: bool) -> None:  # noqa: D102
        self._outer.put(key, payload, never_drop=never_drop)
        _, _, robot, topic, *_ = key.split("/")
        local = self._local.get(topic)
        if local:
            _spread([on_sample for wanted, on_sample in local if wanted in ("*", robot)], key, payload)

    def release(self, beginning: str) -> None:  # noqa: D102
        self._outer.release(beginning)

    def subscribe(self, key_expression: str, on_sample: OnSample) -> Subscription:  # noqa: D102
        _, _, robot, topic, *_ = key_expression.split("/")
        if topic in self._inside:
            self._local[topic].append((robot, on_sample))
            return Subscription()
        if key_expression not in self._shared:
            hearers: list[OnSample] = []
            self._shared[key_expression] = hearers, self._outer.subscribe(key_expression, self._to_all(hearers))
        hearers, subscription = self._shared[key_expression]
        hearers.append(on_sample)
        return subscription

    def _to_all(self, hearers: list[OnSample]) -> OnSample:
        def heard(key: str, payload: bytes) -> None:
            _spread(hearers[::-1], key, payload)  # whoever computes first hears it last: then all have it

        return heard

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


def _spread(hearers: list[OnSample], key: str, payload: bytes) -> None:
    """To all of them, in order, before any of them acts on it.

    A bundle is opened once, and each message in it is read once, for all who ask alike.
    """
    first: Accepting | None = None
    shared: list[Parcel] = []
    told: list[Accepting] = []
    for on_sample in hearers:
        if not isinstance(on_sample, Accepting):
            on_sample(key, payload)
            continue
        if first is None:
            first, shared = on_sample, on_sample.opened(key, payload)
        parcels = shared if on_sample is first or on_sample.asks_as(first) else on_sample.opened(key, payload)
        if parcels:
            on_sample.put(parcels)
            told.append(on_sample)
    for accepting in told:
        accepting.announce()
