"""Which robots' moments have come, and what the thread that brings a message does with it; no threads."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.bus.loop.turning import Agenda, Turning


def test_moments_are_taken_when_they_have_come_earliest_first_and_later_ones_stay() -> None:
    agenda = Agenda()
    for when, robot in ((3.0, "c"), (1.0, "a"), (2.0, "b"), (1.5, "a"), (3.0, "d")):
        agenda.at(when, robot)
    assert agenda.due(0.9) == []
    assert agenda.due(2.0) == ["a", "b"]
    assert (agenda.next(), len(agenda)) == (3.0, 2)
    assert agenda.due(2.9) == []
    assert agenda.due(3.1) == ["c", "d"]
    assert (agenda.due(9.0), len(agenda)) == ([], 0)


class Loop:
    """A loop in whose inbox ``waiting`` messages are; each time it serves it takes one."""

    def __init__(self, waiting: int, quantum: float) -> None:
        self.left, self.quantum, self.served = waiting, quantum, 0
        self.inbox = SimpleNamespace()

    def serve(self, wait: float) -> None:
        assert wait == 0.0, "whoever brings a message waits for nothing"
        self.served += 1
        assert self.served < 20, "it serves for ever"
        self.left -= 1
        self.inbox.waiting = self.left > 0


@pytest.mark.parametrize(
    ("waiting", "quantum", "turned", "served", "changed"),
    [
        (1, 0.0, False, 1, True),
        (3, 0.0, False, 3, True),  # more came meanwhile
        (0, 0.0, False, 0, True),  # somebody else took it
        (1, 0.0, True, 0, True),  # the main thread turns, and looks again
        (1, 0.002, False, 0, False),  # in batches, by the main thread alone
    ],
)
def test_who_brings_a_message_serves_it_unless_another_thread_turns_or_batches_are_made(
    waiting: int, quantum: float, turned: bool, served: int, changed: bool
) -> None:
    loop: Any = Loop(waiting, quantum)
    loop.inbox.waiting = waiting > 0
    turning = Turning([loop])
    if turned:
        turning._turns.acquire()
    turning._came()
    assert loop.served == served
    assert turning._turns.locked() is turned
    assert turning._changed.is_set() is changed
