"""One effect by choice: fitted on top of a model, whatever the ranking says; everywhere, or under a law."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from safedpa.comparison.rollout_error import change_scale
from safedpa.diagnosis.fit.cross_validation import HeldoutError, error_with
from safedpa.diagnosis.fit.data_checks import prepare_runs
from safedpa.diagnosis.fit.horizon import data_at_horizon, displayed_windows
from safedpa.diagnosis.fit.least_squares import fit
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial, fit_trial, trial_of, values_of, with_effect_at
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

_ADDITION_ROUNDS = 2
"""Fits about the model with the effect: the trial was one about the model without it."""
_FEWEST = 3
"""Windows."""


@dataclass(frozen=True)
class Addition:
    """The fitted model, its numbers by path, and the held-out errors before and after."""

    model: PhysicsModel
    values: dict[str, FittedValue]
    before: HeldoutError
    after: HeldoutError
    sentence: str = ""
    """Where and when it acts, of an effect with a law."""


def add_effect(
    model: PhysicsModel, name: str, runs: Sequence[Run], horizon: float = 1.0, law: Where | Varies | None = None
) -> Addition:
    """Fits one effect on top of a model at the horizon that the data choose; the errors are those after ``horizon``.

    Under a ``law`` its borders, or its change, are fitted with it. Raises InputError for an unknown effect, one that
    the model has, or a law that does not fit it; RunError for unusable runs.
    """
    item = effect(model.system.name, name)
    if name in {own.name for own in model.effects}:
        raise InputError(f"effect '{name}': the model has it already; mark its parameters free to refit them")
    made = item if law is None else conditioned(item, law, model.system)
    usable = prepare_runs(model, runs)
    evidence = data_at_horizon(usable.runs, usable.seconds)
    shown = displayed_windows(usable.runs, horizon, evidence)
    if not (change_scale(shown.windows, shown.windows.end) > 0).any():
        raise RunError(
            f"runs: no state changes over {horizon:g} s, so there is nothing to fit '{name}' to; record a drive"
        )
    if len(evidence.shooting.windows) < _FEWEST:
        raise RunError(
            f"runs: got {len(evidence.shooting.windows)} windows of {usable.seconds:g} s, wanted at least {_FEWEST}; "
            "record more"
        )
    search = initial_search(model, evidence.shooting, evidence.heldout)
    shooting, found = search.shooting, _tried(search.current, item, made, law, search.shooting).fit
    for _ in range(_ADDITION_ROUNDS):
        shooting = shooting.around(found.model)
        found = fit(found.model, found.paths, shooting, found.scale)
    found, _ = with_final_values(found, shooting, evidence.heldout)
    final: EffectTrial = trial_of(found, shooting, (name,), None)
    before = error_with(search.current.fit, search.shooting, shown)
    after = error_with(found, shooting, shown)
    reported = "".join(one.sentence for one in conditions_of(found.model, [name]))
    return Addition(found.model, values_of(final, shooting), before, after, reported)


def _tried(
    null: EffectTrial, item: AbstractEffect, made: AbstractEffect, law: Where | Varies | None, shooting: Shooting
) -> EffectTrial:
    """The fit on windows; under a law from where a screen over all regions begins."""
    alone = fit_trial(null, [item], shooting)
    if law is None:
        return alone
    start = initial_law_values(null, alone, item, law, shooting)
    return fit_trial(null, [made], shooting, [with_effect_at(null.fit.model, made, start)])
