"""Where the data decide nothing: the effects that come closest, with their numbers, and what would decide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.diagnosis.experiment_design.choice import discriminating_manoeuvres
from safedpa.diagnosis.fit.cross_validation import Heldout, error_with
from safedpa.diagnosis.fit.trial import block_gain, fit_trials
from safedpa.diagnosis.report_schema import Detectable, FittedValue, PossibleEffect
from safedpa.diagnosis.search.acceptance import MOST_MISSING
from safedpa.diagnosis.search.search_state import JudgedTrial, SearchState
from safedpa.effects import AbstractEffect

__all__ = ["closest_effects", "doubtful_effects", "likely_effects", "nearest_effects"]

_WORTH = 0.1
"""Share off the held-out error that leaves a question open; a driver's feedback feigns 0.01 to 0.09."""
_FAVOURED = 1.0
"""Standard errors of gain, below which blocks do not favour an effect at all."""
_FEWEST = 3
"""Windows."""
_MOST = 3
"""Effects that are told."""


def likely_effects(search: SearchState) -> list[JudgedTrial]:
    """Candidates of the last stage that would take much off the error, though blocks are not sure; the best first."""
    last = max((item.stage for item in search.candidates), default=0)
    found = [
        item
        for item in search.candidates
        if item.stage == last
        and item.decision != "accepted"
        and item.gain > _FAVOURED
        and (item.fall or 0.0) > _WORTH
        and not set(item.trial.effects) & set(search.added)
        and (search.error.value > MOST_MISSING or bool(item.trial.fit.free.all()))
    ]
    return sorted(found, key=lambda item: -(item.fall or 0.0))


def doubtful_effects(search: SearchState) -> list[JudgedTrial]:
    """Accepted effects of which no number that can do nothing is one deviation away from it.

    Together they predict what was driven; of their sizes these data say nothing, so nor do they of other driving.
    """
    fitted, ratios = search.current.fit, dict[str, list[float]]()
    deviations = fitted.deviations(search.shooting).tolist()
    for path, value, deviation in zip(fitted.paths, fitted.values.tolist(), deviations, strict=True):
        neutral = fitted.model.parameters[path].neutral
        if neutral is not None:
            ratios.setdefault(path.split(".")[0], []).append(abs(value - neutral) / deviation if deviation > 0 else 0.0)
    unsure = [name for name in search.added if max(ratios.get(name, [np.inf])) < 1.0]
    found = []
    for name in unsure:
        own = [item for item in search.candidates if item.decision == "accepted" and name in item.trial.effects]
        trial = replace(search.current, effects=(name,))
        why = "its size is within one deviation of nothing: next to the others these data do not tell it"
        found += [replace(item, trial=trial, decision="suspected", reason=why) for item in own[-1:]]
    return found


def nearest_effects(search: SearchState, library: Sequence[AbstractEffect], heldout: Heldout) -> list[JudgedTrial]:
    """Of data that are too few to judge anything: the effects that would take most off the error."""
    if len(search.shooting.windows) < _FEWEST or not search.error.value > 0:
        return []
    trials = fit_trials(search.current, library, search.shooting, {})[: 2 * _MOST]
    found = [(trial, error_with(trial.fit, search.shooting, heldout)) for trial in trials]
    before, why = search.error.value, "too little data"
    return [
        JudgedTrial(0, trial, block_gain(search.current, trial, search.shooting), error, "suspected", why, (), before)
        for trial, error in sorted(found, key=lambda item: item[1].value)
        if error.value < (1.0 - _WORTH) * before
    ]


def closest_effects(
    items: Sequence[JudgedTrial],
    search: SearchState,
    values: Sequence[dict[str, FittedValue]],
    sizes: Sequence[Detectable],
    noise: FloatArray,
) -> tuple[PossibleEffect, ...]:
    """The best few as the report tells them: numbers, what they would take off, smallest sizes, what to drive.

    ``values`` are the fitted numbers of each item by path; ``noise`` (states,) is that of the measurement.
    """
    shown = list(zip(items, values, strict=True))[:_MOST]
    models = [item.trial.fit.model for item, _ in shown]
    drives = discriminating_manoeuvres(search.current.fit.model, models, noise)
    found = []
    for (item, own), drive in zip(shown, drives, strict=True):
        names = set(item.trial.effects)
        smallest = {
            f"{size.effect}.{size.parameter}": FittedValue(size.smallest, None, size.unit)
            for size in sizes
            if size.effect in names and size.smallest is not None
        }
        parameters = {path: value for path, value in own.items() if path.split(".")[0] in names}
        found.append(PossibleEffect(item.trial.name, parameters, item.fall, item.gain, smallest, drive, item.reason))
    return tuple(found)
