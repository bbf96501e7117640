"""What the recorder kept of what was reported."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from safedpa.bus import STATE, VERDICT
from safedpa.records import read_messages

__all__ = ["Recorded", "read_recorded"]

Stamp = tuple[int, int]


@dataclass(frozen=True)
class Recorded:
    """(epoch, tick) of states and verdicts in the recordings of one robot."""

    states: frozenset[Stamp]
    verdicts: frozenset[Stamp]
    messages: int
    """Of every topic and robot."""

    def lost(self, states: Iterable[Stamp], verdicts: Iterable[Stamp]) -> tuple[int, int]:
        """How many of these states and verdicts are in no recording."""
        return len(set(states) - self.states), len(set(verdicts) - self.verdicts)


def read_recorded(files: Sequence[Path], robot: str) -> Recorded:
    """Reads every file up to where it is damaged."""
    found: dict[str, set[Stamp]] = {STATE.name: set(), VERDICT.name: set()}
    count = 0
    for file in files:
        for key, _, message in read_messages(file, []):
            count += 1
            _, _, name, topic, *_ = key.split("/")
            if name == robot and topic in found:
                found[topic].add((message.epoch, message.tick))
    return Recorded(frozenset(found[STATE.name]), frozenset(found[VERDICT.name]), count)
