"""Nearest candidates: if the data decide nothing, the effects that come closest and the drive that would decide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from safedpa.arrays import FloatArray
from safedpa.diagnosis.experiment_design import discriminating_manoeuvres
from safedpa.diagnosis.fit.trial import block_gain, fit_trials
from safedpa.diagnosis.report_schema import Detectable, FittedValue, PossibleEffect
from safedpa.diagnosis.search.acceptance import MOST_MISSING
from safedpa.diagnosis.search.final_parameters import uncertain_effects
from safedpa.diagnosis.search.search_state import JudgedTrial, SearchState
from safedpa.effects import AbstractEffect

# Reduction of the held-out error that leaves a question open: feedback by a driver imitates 0.01 to 0.09.
_MIN_FALL = 0.1
# Standard errors of gain below which blocks do not favour an effect at all.
_FAVOURED = 1.0
# With fewer windows even a ranking of the effects would be arbitrary.
_MIN_WINDOWS = 3
# Effects that are reported: a longer list of doubtful ones helps no reader.
_MAX_REPORTED = 3


def likely_effects(search: SearchState) -> list[JudgedTrial]:
    """Returns candidates of the last stage that would reduce the error much, though blocks are not sure; best first."""
    last = max((item.stage for item in search.candidates), default=0)
    found = [
        item
        for item in search.candidates
        if item.stage == last
        and item.decision != "accepted"
        and item.gain > _FAVOURED
        and (item.fall or 0.0) > _MIN_FALL
        and not set(item.trial.effects) & set(search.added)
        and (search.error.value > MOST_MISSING or bool(item.trial.fit.free.all()))
    ]
    return sorted(found, key=lambda item: -(item.fall or 0.0))


def doubtful_effects(search: SearchState) -> list[JudgedTrial]:
    """Returns accepted effects with no parameter further than one deviation from its neutral value.

    Together such effects predict what was driven. The data do not determine their sizes, so predictions of other drives
    may be wrong.
    """
    found = []
    for name in uncertain_effects(search, 1.0):
        accepted = [item for item in search.candidates if item.decision == "accepted" and name in item.trial.effects]
        trial = replace(search.current, effects=(name,))
        why = "its size is within one deviation of zero effect: these data do not separate it from the other effects"
        found += [replace(item, trial=trial, decision="suspected", reason=why) for item in accepted[-1:]]
    return found


def nearest_effects(search: SearchState, library: Sequence[AbstractEffect]) -> list[JudgedTrial]:
    """Returns the effects that would reduce the error most, for data too few to judge any effect."""
    if len(search.shooting.windows) < _MIN_WINDOWS or not search.error.value > 0:
        return []
    # Twice as many as are reported, because the order by windows and by held-out error differ.
    trials = fit_trials(search.current, library, search.shooting, {})[: 2 * _MAX_REPORTED]
    found = [(trial, search.error_of(trial.fit)) for trial in trials]
    before, why = search.error.value, "too little data"
    return [
        JudgedTrial(0, trial, block_gain(search.current, trial, search.shooting), error, "suspected", why, (), before)
        for trial, error in sorted(found, key=lambda item: item[1].value)
        if error.value < (1.0 - _MIN_FALL) * before
    ]


def closest_effects(
    items: Sequence[JudgedTrial],
    search: SearchState,
    values: Sequence[dict[str, FittedValue]],
    sizes: Sequence[Detectable],
    noise: FloatArray,
) -> tuple[PossibleEffect, ...]:
    """Returns the best few for the report: parameters, reduction of the error, detectable sizes, and what to drive.

    ``values`` are the fitted parameters of each item by path; ``noise`` (states,) is that of the measurement.
    """
    shown = list(zip(items, values, strict=True))[:_MAX_REPORTED]
    models = [item.trial.fit.model for item, _ in shown]
    drives = discriminating_manoeuvres(search.current.fit.model, models, noise)
    found = []
    for (item, fitted_values), drive in zip(shown, drives, strict=True):
        names = set(item.trial.effects)
        smallest = {
            f"{size.effect}.{size.parameter}": FittedValue(size.smallest, None, size.unit)
            for size in sizes
            if size.effect in names and size.smallest is not None
        }
        parameters = {path: value for path, value in fitted_values.items() if path.split(".")[0] in names}
        # All falls are relative to the error of the final model; an effect that is in it already has none.
        further = item.error is not None and not names & set(search.added) and search.error.value > 0
        fall = 1.0 - item.error.value / search.error.value if further and item.error is not None else None
        found.append(PossibleEffect(item.trial.name, parameters, fall, item.gain, smallest, drive, item.reason))
    return tuple(found)
