"""What accepting a candidate would do, told before anybody accepts it.

While nobody asks anything of the worker, it makes the models of the first candidates and calibrates their margins, as
it would for an accepted one. What comes of it is only told: who accepts has the model made anew, on the newest data.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final

from safedpa.bus import VerdictMessage
from safedpa.live.work import AbstractWorker, Outcome, Work

__all__ = ["Foresight", "Foretell"]

Foretell = Callable[[str, str, VerdictMessage | None], str]
"""(text of the margin in force, text of another one, newest verdict) -> what the change does to the robot, in words."""

MOST: Final = 3
"""Candidates that are looked at, best first."""


@dataclass
class Foresight:
    """Of one robot and its newest candidates."""

    waiting: list[Work] = field(default_factory=list)
    """To be done, best first."""
    running: Work | None = None
    found: dict[str, Outcome] = field(default_factory=dict)
    """By effect."""
    verdict: VerdictMessage | None = None

    def begin(self, works: list[Work]) -> None:
        """Forgets the candidates before; one that is being looked at is left to end, and not told."""
        self.waiting, self.found = works[:MOST], {}
        self.running = None if self.running is None else replace(self.running, effect="")

    def interrupted(self) -> None:
        """The worker was given something else to do."""
        self.waiting, self.running = [], None

    def step(self, robot: str, worker: AbstractWorker) -> None:
        """Goes on: one work at a time, when the worker does nothing else."""
        if self.running is not None:
            outcome = worker.outcome(robot)
            if outcome is None:
                return
            if self.running.effect:
                self.found[self.running.effect] = outcome
            self.running = None
        if self.waiting and not worker.busy(robot):
            self.running = self.waiting.pop(0)
            worker.begin(robot, self.running)

    def told(self, margin: str, foretell: Foretell) -> dict[str, str]:
        """What accepting each effect does that was looked at, in words; ``margin`` is the text of the one in force."""
        return {
            effect: f"it cannot be made: {found.failure}"
            if found.failure
            else foretell(margin, found.margin, self.verdict)
            for effect, found in dict(self.found).items()
        }
