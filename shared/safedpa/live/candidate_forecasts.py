"""Forecasts of the effect of accepting a candidate, before a user accepts it.

While the worker is idle, it creates the models of the first candidates and calibrates their margins, as it would after
an acceptance. The results are only reported, with the effect of the margin on the robot. Accepting a candidate creates
its model again, on the newest data.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final

from safedpa.bus import VerdictMessage
from safedpa.errors import InputError
from safedpa.live.search_jobs import AbstractWorker, SearchJob, WorkOutcome
from safedpa.safety.defaults import settings_named
from safedpa.safety.margins.calibration import margin_from_text
from safedpa.safety.margins.transition import margin_table
from safedpa.safety.settings import FilterSettings

PredictEffect = Callable[[str, str, VerdictMessage | None], str]
"""(text of the active margin, text of another one, newest verdict) -> description of the effect on the robot."""

MOST: Final = 3
"""Number of candidates with a forecast, best first."""
_WITHOUT_H: Final = ("fallback", "disabled", "stopped")


@dataclass
class CandidateForecasts:
    """Forecasts for the newest candidates of one robot."""

    waiting: list[SearchJob] = field(default_factory=list)
    """Jobs to do, best candidate first."""
    running: SearchJob | None = None
    found: dict[str, WorkOutcome] = field(default_factory=dict)
    """Results by effect."""
    verdict: VerdictMessage | None = None

    def begin(self, works: list[SearchJob]) -> None:
        """Starts forecasts for new candidates; the result of a running job is ignored."""
        self.waiting, self.found = works[:MOST], {}
        self.running = None if self.running is None else replace(self.running, effect="")

    def interrupted(self) -> None:
        """Drops all jobs, because the worker was given another one."""
        self.waiting, self.running = [], None

    def step(self, robot: str, worker: AbstractWorker) -> None:
        """Starts the next job if the worker is idle, and collects results."""
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

    def reported(self, margin: str, predict_effect: PredictEffect) -> dict[str, str]:
        """Describes the effect of accepting each examined candidate; ``margin`` is the text of the active margin."""
        return {
            effect: f"its model cannot be created: {found.failure}"
            if found.failure
            else predict_effect(margin, found.margin, self.verdict)
            for effect, found in dict(self.found).items()
        }


def forecast_with(settings: str) -> PredictEffect:
    """Returns the prediction of effects for the filter's settings (a file or a name).

    A verdict has only the smallest h of all barriers. It is used for every kind of barrier, which is conservative. The
    filter itself reports the effect by kind once the model is offered.
    """
    known = settings_named(settings)

    def predict_effect(present: str, other: str, verdict: VerdictMessage | None) -> str:
        if not other:
            return "no margin could be calibrated for it from this drive: the filter will use the shipped one, or none"
        try:
            old, new = _epsilon(present, known), _epsilon(other, known)
        except InputError as error:
            return f"its margin cannot be read: {error}"
        unknown = verdict is None or (verdict.status in _WITHOUT_H and verdict.h_now == verdict.h_next == 0.0)
        h = {} if verdict is None or unknown else dict.fromkeys(new, verdict.h_now)
        same = ", ".join(f"{kind} {value:.3g}" for kind, value in sorted(new.items()))
        return margin_table(old, new, h, known.eta) or f"the margin stays as it is: {same}"

    return predict_effect


def _epsilon(text: str, settings: FilterSettings) -> dict[str, float]:
    return dict(margin_from_text(text).epsilon if text else settings.epsilon)
