"""The transport interface: publish and subscribe bytes under keys, queries, and liveliness. Zenoh and memory implement
it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

OnSample = Callable[[str, bytes], None]
"""Called with key and payload on any thread; must return immediately and must not raise."""

OnQuestion = Callable[[str, bytes], bytes | None]
"""Called with key and payload of a question on any thread. Returns the answer, or None to leave it to others; must
return soon and must not raise."""

OnAnswer = Callable[[bytes | None], None]
"""Called once, on any thread, with the first answer, or None without an answer."""


class Subscription:
    """A subscription, which calls its receiver per message, or in batches while it gathers.

    A call into Python for each message costs a wake-up of a thread and contention for the interpreter lock. At high
    rates a transport avoids both by queueing messages outside Python. This base class delivers immediately and has
    nothing to gather.
    """

    def gather(self) -> None:
        """Queues messages from now on until ``collect``; when the queue is full, drops the oldest."""

    def collect(self) -> None:
        """Calls the receiver for every queued message, in order, on the caller's thread; never blocks."""

    def pass_on(self) -> None:
        """Delivers the queued messages and calls the receiver per message from now on."""


class AbstractTransport(ABC):
    """Publishes and subscribes bytes under keys such as ``safedpa/fleet/robot/state``; ``*`` matches one key part."""

    @abstractmethod
    def put(self, key: str, payload: bytes, *, never_drop: bool) -> None:
        """Sends immediately and never blocks for long.

        If the network is congested, a message with ``never_drop`` waits for it and any other message is dropped.
        Raises BusError after ``close``.
        """

    def release(self, prefix: str) -> None:
        """Releases the resources held for sending under keys with this prefix; a later ``put`` allocates them again."""
        del prefix

    @abstractmethod
    def subscribe(self, key_expression: str, on_sample: OnSample) -> Subscription:
        """Calls ``on_sample`` for every message put under matching keys from now on until ``close``."""

    @abstractmethod
    def declare_alive(self, key: str) -> None:
        """Makes ``key`` visible to ``alive`` of all participants until ``close`` or the end of this process."""

    @abstractmethod
    def alive(self, key_expression: str) -> list[str]:
        """Returns the matching keys that are declared alive now, sorted."""

    @abstractmethod
    def answer(self, key_expression: str, on_question: OnQuestion) -> None:
        """Answers questions under matching keys with the result of ``on_question``, until ``close``."""

    @abstractmethod
    def ask(self, key: str, payload: bytes, timeout: float) -> bytes | None:
        """Returns the first answer to a question, or None if no participant answers within ``timeout`` [s].

        Raises BusError after ``close``.
        """

    @abstractmethod
    def ask_soon(self, key: str, payload: bytes, timeout: float, on_answer: OnAnswer) -> None:
        """Asynchronous ``ask``: returns immediately and passes the result to ``on_answer``."""

    @abstractmethod
    def close(self) -> None:
        """Ends all subscriptions and declarations. Calling it again has no effect."""
