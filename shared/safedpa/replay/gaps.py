"""What a recording lacks: messages that were sent and did not reach the recorder, found from ticks and step counts."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

from safedpa.bus import LATENT, NOMINAL, Topic
from safedpa.replay.tape import RobotTape

__all__ = ["TickGap", "gaps_of"]


@dataclass(frozen=True)
class TickGap:
    """A stretch in which messages of one kind are missing."""

    what: str
    """``state`` or the service whose outputs are missing."""
    epoch: int
    after_tick: int
    before_tick: int
    missing: int

    @property
    def sentence(self) -> str:
        """The gap in words."""
        kind = "states" if self.what == "state" else f"outputs of {self.what}"
        return f"{self.missing} {kind} between tick {self.after_tick} and tick {self.before_tick}"


def gaps_of(tape: RobotTape) -> list[TickGap]:
    """Every gap, states first.

    A robot counts its periods, so a tick that is left out is a state that was lost (or a period in which the robot's
    process was held up). A service counts its steps, so a number that is left out is a lost output; what was lost at
    its very end shows where another service says that it used it.
    """
    found = [gap for service in tape.computed for gap in _output_gaps(tape, service)]
    behind = [
        gap for service, topic in (("adaptation", LATENT), ("policy", NOMINAL)) for gap in _behind(tape, service, topic)
    ]
    return [*_state_gaps(tape), *found, *behind]


def _state_gaps(tape: RobotTape) -> Iterator[TickGap]:
    stamps = sorted(tape.states)
    for (epoch, tick), (following_epoch, following) in pairwise(stamps):
        if epoch == following_epoch and following > tick + 1:
            yield TickGap("state", epoch, tick, following, following - tick - 1)


def _output_gaps(tape: RobotTape, service: str) -> Iterator[TickGap]:
    messages = [entry.message for entry in tape.computed[service]]
    for before, after in pairwise(messages):
        missing = after.step - before.step - 1
        if before.epoch == after.epoch and before.step and missing > 0:
            yield TickGap(service, after.epoch, before.tick, after.tick, missing)


def _behind(tape: RobotTape, service: str, topic: Topic) -> Iterator[TickGap]:
    """Outputs behind the last recorded one that other services used."""
    last = {entry.message.epoch: entry.message.tick for entry in tape.computed[service]}
    behind: dict[int, list[int]] = defaultdict(list)
    for epoch, tick in tape.absent(topic):
        if tick > last.get(epoch, -1):
            behind[epoch].append(tick)
    for epoch, ticks in sorted(behind.items()):
        yield TickGap(service, epoch, last.get(epoch, -1), max(ticks) + 1, len(ticks))
