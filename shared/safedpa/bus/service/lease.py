"""A lease: of several instances of a service only the holder may send, so that a standby can take over.

The router grants the lease (``LeaseTable``), because a service that it cannot reach reaches no robot either. The holder
counts from the moment at which it *asked*, and for less time than the router does, so its lease ends first: whatever
fails, hangs or is cut off, two instances never hold it at once. A holder that cannot renew in time sends nothing more
and ends its process. A message that was in flight then is of an earlier tick, which the robot refuses.

This assumes that the monotonic clocks of router and holder run at the same rate, within a quarter.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from typing import Final, final

from safedpa.bus.logging import log_event
from safedpa.bus.messages.requests import LeaseAnswer, LeaseRequest
from safedpa.bus.service.process import EXIT_NOT_LET_IN
from safedpa.bus.transport.base import AbstractTransport, OnAnswer, OnQuestion, OnSample, Subscription
from safedpa.errors import BusError

__all__ = ["ASK_SECONDS", "LEASE_SECONDS", "Lease", "LeaseKeeper", "LeaseTable", "LeasedTransport", "wait_for_lease"]

LEASE_SECONDS: Final = 0.8
"""How long the router grants the lease: with the time that a hang takes to be noticed, a takeover lasts below 2 s."""
_HELD = 0.75
"""Share of the lease after which the holder stops by itself."""
_RENEW_SECONDS = 0.15
ASK_SECONDS: Final = 0.3
"""Longest wait for the router's answer: two attempts fit into a lease."""
_LOOP_SECONDS = 0.5
"""A loop that reports nothing for so long hangs, and its lease is not renewed; it reports every 0.25 s."""

Ask = Callable[[LeaseRequest], LeaseAnswer | None]
"""Asks the router; None without an answer in time."""


@final
class LeaseTable:
    """The router's side: who holds the lease of one service, until when [s], and what the holder wants carried on.

    After a start nothing is granted for one lease: the holder of before may still be active.

    Example:

        >>> now = [0.0]
        >>> table = LeaseTable(0.8, lambda: now[0])
        >>> table.ask(LeaseRequest(holder="a")).granted, now.__setitem__(0, 0.9)
        (False, None)
        >>> table.ask(LeaseRequest(holder="a")).granted, table.ask(LeaseRequest(holder="b")).granted
        (True, False)
    """

    def __init__(self, seconds: float = LEASE_SECONDS, clock: Callable[[], float] = time.monotonic) -> None:
        self._seconds, self._clock = seconds, clock
        self._lock = threading.Lock()
        self._holder, self._carried, self._term = "", "", 0
        self._until = clock() + seconds

    def ask(self, request: LeaseRequest) -> LeaseAnswer:
        """Grants, renews or refuses; a request that ``releases`` ends the holder's lease. On any thread."""
        with self._lock:
            now, own = self._clock(), request.holder == self._holder
            if now < self._until and not own:
                return LeaseAnswer(granted=False, term=self._term, wait=self._until - now, carried=self._carried)
            if own:
                self._carried = request.carried
            if request.releases:
                self._until = now if own else self._until
                return LeaseAnswer(granted=False, term=self._term, carried=self._carried)
            inherited = self._carried
            self._term += 0 if own and now < self._until else 1
            self._holder, self._until = request.holder, now + self._seconds
            return LeaseAnswer(granted=True, term=self._term, carried=inherited)


@final
class Lease:
    """The holder's side: asks for the lease and knows until when [s] it is held."""

    def __init__(self, ask: Ask, holder: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._ask, self.holder, self._clock = ask, holder, clock
        self._until = float("-inf")
        self.term = 0
        """Counts the holders since the router's start."""

    @property
    def held(self) -> bool:
        """Whether this process may send now."""
        return self._clock() < self._until

    def attempt(self, carried: str = "") -> LeaseAnswer | None:
        """Asks for the lease, or to renew it; returns the answer, None without one."""
        asked = self._clock()
        answer = self._ask(LeaseRequest(holder=self.holder, carried=carried))
        if answer is not None and answer.granted:
            self._until, self.term = asked + _HELD * LEASE_SECONDS, answer.term
        return answer

    def release(self, carried: str = "") -> None:
        """Gives the lease back; nothing may be sent from now on."""
        self._until = float("-inf")
        self._ask(LeaseRequest(holder=self.holder, carried=carried, releases=True))


def wait_for_lease(
    lease: Lease, stopped: Callable[[], bool], pause: Callable[[float], None] = time.sleep
) -> str | None:
    """Asks until the lease is granted; returns what the former holder carried on, or None once ``stopped``."""
    while not stopped():
        answer = lease.attempt()
        if answer is not None and answer.granted:
            return answer.carried
        pause(_RENEW_SECONDS if answer is None else min(_RENEW_SECONDS, max(0.01, answer.wait)))
    return None


@final
class LeaseKeeper:
    """Renews a lease on a thread of its own while the loop of the service makes progress.

    Without the lease it calls ``on_loss``, which ends the process: what it remembers of its robots is no longer true.
    """

    def __init__(self, lease: Lease, carried: Callable[[], str], on_loss: Callable[[], None] | None = None) -> None:
        self._lease, self._carried = lease, carried
        self._on_loss = on_loss or _end_process
        self._wake, self._ended = threading.Event(), threading.Event()
        self._progress = time.monotonic()
        self._thread = threading.Thread(target=self._keep, name="lease", daemon=True)
        self._thread.start()

    def progress(self, ahead: float = 0.0) -> None:
        """Called by the loop at least every 0.25 s, or once for a time ``ahead`` [s] in which it will not call."""
        self._progress = time.monotonic() + ahead

    def renew_soon(self) -> None:
        """Renews at once, with what is to be carried on now."""
        self._wake.set()

    def end(self) -> None:
        """Stops renewing and gives the lease back."""
        self._ended.set()
        self._wake.set()
        self._thread.join()
        self._lease.release(self._carried())

    def _keep(self) -> None:
        while not self._ended.is_set():
            if time.monotonic() - self._progress < _LOOP_SECONDS:
                try:
                    self._lease.attempt(self._carried())
                except BusError:
                    return  # the bus was closed: the process ends
            if not self._lease.held:
                self._on_loss()
                return
            self._wake.wait(_RENEW_SECONDS)
            self._wake.clear()


def _end_process() -> None:
    log_event("lease.lost", "the lease could not be renewed in time: this process ends", level="error")
    os._exit(EXIT_NOT_LET_IN)


@final
class LeasedTransport(AbstractTransport):
    """A transport that sends only while a lease is held; what is put without it is dropped."""

    def __init__(self, inner: AbstractTransport) -> None:
        self._inner = inner
        self.lease: Lease | None = None

    def put(self, key: str, payload: bytes, *, never_drop: bool) -> None:  # noqa: D102
        if self.lease is not None and self.lease.held:
            self._inner.put(key, payload, never_drop=never_drop)

    def release(self, prefix: str) -> None:  # noqa: D102
        self._inner.release(prefix)

    def subscribe(self, key_expression: str, on_sample: OnSample) -> Subscription:  # noqa: D102
        return self._inner.subscribe(key_expression, on_sample)

    def declare_alive(self, key: str) -> None:  # noqa: D102
        self._inner.declare_alive(key)

    def alive(self, key_expression: str) -> list[str]:  # noqa: D102
        return self._inner.alive(key_expression)

    def answer(self, key_expression: str, on_question: OnQuestion) -> None:  # noqa: D102
        self._inner.answer(key_expression, on_question)

    def ask(self, key: str, payload: bytes, timeout: float) -> bytes | None:  # noqa: D102
        return self._inner.ask(key, payload, timeout)

    def ask_soon(self, key: str, payload: bytes, timeout: float, on_answer: OnAnswer) -> None:  # noqa: D102
        self._inner.ask_soon(key, payload, timeout, on_answer)

    def close(self) -> None:  # noqa: D102
        self._inner.close()
