"""Finds messages that did not reach the recorder, from gaps in ticks and step counts."""

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
    """A range of ticks in which messages of one kind are missing."""

    what: str
    """``state``, or the service whose outputs are missing."""
    epoch: int
    after_tick: int
    before_tick: int
    missing: int

    @property
    def sentence(self) -> str:
        """A sentence that describes the gap."""
        kind = "states" if self.what == "state" else f"outputs of {self.what}"
        return f"{self.missing} {kind} between tick {self.after_tick} and tick {self.before_tick}"


def gaps_of(tape: RobotTape) -> list[TickGap]:
    """Returns every gap, states first.

    A robot counts its periods, so a missing tick is a lost state (or a period in which its process was delayed). A
    service counts its steps, so a missing number is a lost output. A lost last output is found if another service
    reports that it used it.
    """
    outputs = [gap for service in tape.computed for gap in _output_gaps(tape, service)]
    used = (("adaptation", LATENT), ("policy", NOMINAL))
    at_end = [gap for service, topic in used for gap in _lost_at_end(tape, service, topic)]
    return [*_state_gaps(tape), *outputs, *at_end]


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


def _lost_at_end(tape: RobotTape, service: str, topic: Topic) -> Iterator[TickGap]:
    """Outputs after the last recorded one that other services report as used."""
    last = {entry.message.epoch: entry.message.tick for entry in tape.computed[service]}
    lost: dict[int, list[int]] = defaultdict(list)
    for epoch, tick in tape.absent(topic):
        if tick > last.get(epoch, -1):
            lost[epoch].append(tick)
    for epoch, ticks in sorted(lost.items()):
        yield TickGap(service, epoch, last.get(epoch, -1), max(ticks) + 1, len(ticks))
