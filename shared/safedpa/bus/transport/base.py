"""The seam under the bus: bytes under keys, and who is alive. One implementation is Zenoh, one is memory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

__all__ = ["AbstractTransport", "OnAnswer", "OnQuestion", "OnSample", "Subscription"]

OnSample = Callable[[str, bytes], None]
"""Called with key and payload, on any thread; must return at once and raise nothing."""

OnQuestion = Callable[[str, bytes], bytes | None]
"""Called with key and payload of a question, on any thread; returns the answer, or None to leave it to others, soon and
raises nothing."""

OnAnswer = Callable[[bytes | None], None]
"""Called once with the first answer, or None when there was none; on any thread."""


class Subscription:
    """What ``subscribe`` returns: its receiver is called for each message as it comes, or, while it gathers, for all of
    them when the owner says so.

    A call into Python for each message costs a wake-up and a struggle with whatever runs there; a transport that can
    keep messages elsewhere spares both while there are many. One that delivers at once has nothing to gather.
    """

    def gather(self) -> None:
        """From now on keeps what comes until ``collect``; of very many messages the oldest are lost."""

    def collect(self) -> None:
        """Calls the receiver for everything gathered, in order, on the caller's thread; never waits."""

    def pass_on(self) -> None:
        """From now on calls the receiver as messages come; what was gathered first."""


class AbstractTransport(ABC):
    """Publishes and subscribes bytes under keys like ``safedpa/fleet/robot/state``; ``*`` matches one part of a key."""

    @abstractmethod
    def put(self, key: str, payload: bytes, *, never_drop: bool) -> None:
        """Sends at once and never blocks for long; ``never_drop`` prefers completeness over age.

        Raises BusError after ``close``.
        """

    def release(self, beginning: str) -> None:
        """Gives back what sending under keys that begin so holds; sending again takes it again."""
        del beginning

    @abstractmethod
    def subscribe(self, key_expression: str, on_sample: OnSample) -> Subscription:
        """Calls ``on_sample`` for everything that is put under matching keys from now on, until ``close``."""

    @abstractmethod
    def declare_alive(self, key: str) -> None:
        """Shows ``key`` to everyone who asks ``alive``, until ``close`` or the end of this process."""

    @abstractmethod
    def alive(self, key_expression: str) -> list[str]:
        """Keys now declared alive that match, sorted."""

    @abstractmethod
    def answer(self, key_expression: str, on_question: OnQuestion) -> None:
        """Answers every question under matching keys with what ``on_question`` returns, until ``close``."""

    @abstractmethod
    def ask(self, key: str, payload: bytes, timeout: float) -> bytes | None:
        """The first answer to a question, or None: no one answers such keys, or not within ``timeout`` [s].

        Raises BusError after ``close``.
        """

    @abstractmethod
    def ask_soon(self, key: str, payload: bytes, timeout: float, on_answer: OnAnswer) -> None:
        """The same without waiting for it: ``on_answer`` is called with what ``ask`` would have returned."""

    @abstractmethod
    def close(self) -> None:
        """Ends every subscription and declaration. Calling it again does nothing."""
