"""Adds one effect that the user chooses to a model and fits it, with or without a law, regardless of any ranking."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from safedpa.comparison.rollout_error import change_scale
from safedpa.diagnosis.fit.cross_validation import HeldoutError, error_with
from safedpa.diagnosis.fit.data_checks import data_at_horizon, displayed_windows, prepare_runs
from safedpa.diagnosis.fit.least_squares import relinearized
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial, fit_trial, start_models, trial_of, values_of, with_effect_at
from safedpa.diagnosis.report_schema import FittedValue
from safedpa.diagnosis.search.conditional import conditions_of
from safedpa.diagnosis.search.conditional_screen import initial_law_values
from safedpa.diagnosis.search.final_parameters import with_final_values
from safedpa.diagnosis.search.initial_model import initial_search
from safedpa.dynamics import PhysicsModel
from safedpa.effects import AbstractEffect, Varies, Where, conditioned, effect
from safedpa.errors import InputError, RunError
from safedpa.records.run import Run

__all__ = ["Addition", "add_effect"]

# Refits about the model with the effect: the trial is linearised about the model without it, and a large effect
# lies outside that linearisation.
_REFITS = 2
# Cross-validation needs at least three windows to hold one out and fit the rest.
_MIN_WINDOWS = 3


@dataclass(frozen=True)
class Addition:
    """The fitted model, its parameters by path, and the held-out errors before and after."""

    model: PhysicsModel
    values: dict[str, FittedValue]
    before: HeldoutError
    after: HeldoutError
    sentence: str = ""
    """Where and when the effect acts; empty without a law."""


def add_effect(
    model: PhysicsModel, name: str, runs: Sequence[Run], horizon: float = 1.0, law: Where | Varies | None = None
) -> Addition:
    """Fits one effect on top of a model and returns the errors after ``horizon`` [s] before and with it.

    The parameters of the effects that the model has are fitted again, together with its free ones and the new ones: the
    earlier effects have compensated for the one that was missing. The fit starts both from the given values and from
    those fitted without the effect. The data determine its horizon. With a ``law``, its borders or its rate of change
    are fitted too. Raises InputError for an unknown effect, one that the model has, or a law that does not suit it;
    RunError for unusable runs.
    """
    item = effect(model.system.name, name).at_period(model.period)
    if name in {other.name for other in model.effects}:
        raise InputError(f"effect '{name}': the model has it already; refit fits it again")
    conditioned_item = item if law is None else conditioned(item, law, model.system)
    usable = prepare_runs(model, runs)
    evidence = data_at_horizon(usable.runs, usable.seconds)
    shown = displayed_windows(usable.runs, horizon, evidence)
    if not (change_scale(shown.windows, shown.windows.end) > 0).any():
        raise RunError(
            f"runs: no state changes over {horizon:g} s, so there is nothing to fit '{name}' to; record a drive"
        )
    if len(evidence.shooting.windows) < _MIN_WINDOWS:
        raise RunError(
            f"runs: got {len(evidence.shooting.windows)} windows of {usable.seconds:g} s, wanted at least "
            f"{_MIN_WINDOWS}; record more"
        )
    marked = model.with_settings(
        {path: replace(setting, free=True) for path, setting in model.settings.items() if not path.startswith("base.")}
    )
    search = initial_search(marked, evidence.shooting, evidence.heldout)
    shooting = search.shooting
    trials = [_fit_effect(search.current, item, conditioned_item, law, shooting)]
    if marked.latent_names and law is None:
        trials.append(fit_trial(search.current, [item], shooting, start_models(marked, [item])))
    found = min(trials, key=lambda trial: trial.loss).fit
    for _ in range(_REFITS):
        found, shooting = relinearized(found, shooting)
    # As in a diagnosis: the windows fit the effect, the filter along whole recordings gives the reported values.
    found, _ = with_final_values(found, shooting, evidence.heldout)
    final: EffectTrial = trial_of(found, shooting, (name,), None)
    before = error_with(search.current.fit, search.shooting, shown)
    after = error_with(found, shooting, shown)
    sentences = "".join(one.sentence for one in conditions_of(found.model, [name]))
    fitted = found.model.with_settings(
        {path: replace(found.model.settings[path], free=setting.free) for path, setting in model.settings.items()}
    )
    return Addition(fitted, values_of(final, shooting), before, after, sentences)


def _fit_effect(
    null: EffectTrial,
    item: AbstractEffect,
    conditioned_item: AbstractEffect,
    law: Where | Varies | None,
    shooting: Shooting,
) -> EffectTrial:
    """Fits the effect on windows; with a law, from the initial values of the screen over all laws of its kind."""
    alone = fit_trial(null, [item], shooting)
    if law is None:
        return alone
    start = initial_law_values(null, alone, item, law, shooting)
    return fit_trial(null, [conditioned_item], shooting, [with_effect_at(null.fit.model, conditioned_item, start)])
