"""What accepting a candidate would do, told before anybody accepts it.

While no one asks anything of the worker, it makes the models of the first candidates and calibrates their margins, as
it would for an accepted one. What comes of it is only told, and in words what another margin would do to the robot: who
accepts has the model made again, on the newest data.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final

from safedpa.bus import VerdictMessage
from safedpa.errors import InputError
from safedpa.live.work import AbstractWorker, SearchJob, WorkOutcome
from safedpa.safety.defaults import settings_named
from safedpa.safety.margins.calibration import margin_from_text
from safedpa.safety.margins.transition import margin_change
from safedpa.safety.settings import FilterSettings

__all__ = ["CandidateForecasts", "Foretell", "forecast_with"]

Foretell = Callable[[str, str, VerdictMessage | None], str]
"""(text of the margin in force, text of another one, newest verdict) -> what the change does to the robot, in words."""

MOST: Final = 3
"""Candidates that are looked at, best first."""
_WITHOUT_H: Final = ("fallback", "disabled", "stopped")


@dataclass
class CandidateForecasts:
    """Of one robot and its newest candidates."""

    waiting: list[SearchJob] = field(default_factory=list)
    """To be done, best first."""
    running: SearchJob | None = None
    found: dict[str, WorkOutcome] = field(default_factory=dict)
    """By effect."""
    verdict: VerdictMessage | None = None

    def begin(self, works: list[SearchJob]) -> None:
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

    def reported(self, margin: str, foretell: Foretell) -> dict[str, str]:
        """What accepting each effect does that was looked at, in words; ``margin`` is the text of the one in force."""
        return {
            effect: f"it cannot be made: {found.failure}"
            if found.failure
            else foretell(margin, found.margin, self.verdict)
            for effect, found in dict(self.found).items()
        }


def forecast_with(settings: str) -> Foretell:
    """For the filter's settings (a file or a name).

    Of h the verdict tells the least of all barriers alone; it stands for every kind, which is on the safe side. The
    filter tells of each kind by itself once the model is offered.
    """
    known = settings_named(settings)

    def foretell(present: str, other: str, verdict: VerdictMessage | None) -> str:
        if not other:
            return "no margin could be calibrated for it from this drive: the filter will use the shipped one, or none"
        try:
            old, new = _epsilon(present, known), _epsilon(other, known)
        except InputError as error:
            return f"its margin cannot be read: {error}"
        unknown = verdict is None or (verdict.status in _WITHOUT_H and verdict.h_now == verdict.h_next == 0.0)
        h = {} if verdict is None or unknown else dict.fromkeys(new, verdict.h_now)
        return margin_change(old, new, h, known.eta) or f"the margin stays as it is: {_listed(new)}"

    return foretell


def _epsilon(text: str, settings: FilterSettings) -> dict[str, float]:
    return dict(margin_from_text(text).epsilon if text else settings.epsilon)


def _listed(margins: dict[str, float]) -> str:
    return ", ".join(f"{kind} {value:.3g}" for kind, value in sorted(margins.items()))
