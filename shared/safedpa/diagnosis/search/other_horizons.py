"""The same question at other horizons, where one horizon leaves it open.

A candidate that unseen blocks favour, but not surely enough, is fitted and judged again in windows of half the length,
of a fifth, and of twice as much. To be asked several times asks for more each time (Bonferroni): passing at one of four
horizons with 3.4 standard errors is as rare as passing at one with 3.

Source: Dunn, Journal of the American Statistical Association 56, 1961 (several comparisons).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from safedpa.diagnosis.fit.evidence import Evidence
from safedpa.diagnosis.fit.heldout import error_with
from safedpa.diagnosis.fit.least_squares import fit
from safedpa.diagnosis.fit.trial import Trial, block_gain, trial_of, tried
from safedpa.diagnosis.search.judgement import FALL, Stage, feigned_lateness, inside
from safedpa.diagnosis.search.progress import Search
from safedpa.diagnosis.search.second_opinion import agrees
from safedpa.effects import AbstractEffect

__all__ = ["Passing", "passing_elsewhere"]

_SURE = 3.4
"""Standard errors at another horizon."""
_OPEN = 1.0
"""Standard errors at the search's own horizon without which nothing is asked again."""
_ASKED = 3
"""Candidates."""


@dataclass(frozen=True)
class Passing:
    """A candidate that passes at another horizon."""

    trial: Trial
    seconds: float
    gain: float
    """Standard errors there."""
    fall: float
    """Share of the held-out error there."""

    @property
    def reason(self) -> str:
        """As a candidate's reason says it."""
        return f"over {self.seconds:.3g} s the gain is {self.gain:.1f} standard errors, the error falls {self.fall:.0%}"


def passing_elsewhere(
    search: Search, stage: Stage, library: Sequence[AbstractEffect], beside: Callable[[], Iterable[Evidence]]
) -> Passing | None:
    """The candidate of a stage in which none passed that another horizon confirms most; None where none does."""
    open_ones = _open(search, stage)
    if not open_ones:
        return None
    by_name = {item.name: item for item in library}
    best: Passing | None = None
    for evidence in beside():
        null = _null(search, evidence)
        for trial in open_ones:
            found = _judged(trial, null, evidence, [by_name[name] for name in trial.effects])
            if found.gain > _SURE and found.fall > FALL and (best is None or found.gain > best.gain):
                best = found
    return best if best is not None and agrees(best.trial, search) else None


def _open(search: Search, stage: Stage) -> list[Trial]:
    """Candidates that gain something and take something off the error, those that take most first."""
    before = search.error.value
    found = [
        trial
        for trial in stage.trials
        if trial.effects in stage.errors
        and trial.effects not in stage.doubted
        and stage.gains[trial.effects] > _OPEN
        and stage.errors[trial.effects].value < (1.0 - FALL) * before
        and not feigned_lateness(trial, stage.errors[trial.effects], search.error, stage.row)
        and inside(trial, search)
    ]
    return sorted(found, key=lambda trial: stage.errors[trial.effects].value)[:_ASKED]


def _null(search: Search, evidence: Evidence) -> tuple[Trial, Evidence]:
    """The present model fitted in other windows."""
    now = search.current.fit
    shooting = evidence.shooting.around(now.model)
    again = fit(now.model, now.paths, shooting, now.scale)
    return trial_of(again, shooting, (), None), Evidence(evidence.seconds, shooting, evidence.heldout)


def _judged(trial: Trial, null: tuple[Trial, Evidence], evidence: Evidence, items: Sequence[AbstractEffect]) -> Passing:
    one, there = null
    model = one.fit.model
    for item in items:
        own = {p.name: trial.fit.model.settings[f"{item.name}.{p.name}"] for p in item.parameters}
        model = model.with_effect(item, own)
    other = tried(one, items, there.shooting, [model])
    before = error_with(one.fit, there.shooting, there.heldout).value
    after = error_with(other.fit, there.shooting, there.heldout).value
    fall = 1.0 - after / before if before > 0 else 0.0
    return Passing(trial, evidence.seconds, block_gain(one, other, there.shooting), fall)
