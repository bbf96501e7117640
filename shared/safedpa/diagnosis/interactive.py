"""The diagnosis one effect at a time, by a person's choice: what is proposed, what is taken, the final numbers.

The very steps of ``diagnose``, with a person between them, who may take another effect than the best. Second thoughts
(exchanges and removals) are left to that person.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from safedpa.comparison.rollout_error import rollout_error
from safedpa.diagnosis.diagnose import candidate_of, experiment_for, library_for
from safedpa.diagnosis.fit.cross_validation import Heldout, HeldoutError, error_with
from safedpa.diagnosis.fit.data_checks import check_data_sufficiency, prepare_runs
from safedpa.diagnosis.fit.horizon import data_at_horizon, displayed_windows
from safedpa.diagnosis.fit.least_squares import fit
from safedpa.diagnosis.fit.trial import fit_trials, trial_of, values_of
from safedpa.diagnosis.report_schema import Candidate, Experiment, FittedValue, Unexplained
from safedpa.diagnosis.residuals.unmodelled import find_unexplained_structure
from safedpa.diagnosis.search.final_parameters import with_final_values
from safedpa.diagnosis.search.forward_selection import SearchState, accept_trial, add_best_trial
from safedpa.diagnosis.search.initial_model import initial_search
from safedpa.dynamics import PhysicsModel
from safedpa.errors import InputError, did_you_mean
from safedpa.records.run import Run

__all__ = [
    "RankedCandidates",
    "StepwiseModel",
    "first_step",
    "given_error",
    "proposal",
    "with_candidate",
    "with_final",
]

_ROUNDS = 2
"""Fits about the model with an effect: the trial was one about the model without it, to first order, and a large effect
lies beyond that."""


@dataclass(frozen=True)
class StepwiseModel:
    """A model on the way, fitted, with all that the next step needs."""

    search: SearchState
    heldout: Heldout
    """Of the horizon that the data choose: it decides."""
    shown: Heldout
    """Of the horizon that is asked for."""
    why_not: str
    """Why the data allow no verdict about physics; empty where they do."""
    improved: str = ""
    """In how many runs the held-out error fell against the step before: ``4/4``."""

    @property
    def model(self) -> PhysicsModel:
        """The fitted model."""
        return self.search.current.fit.model

    @cached_property
    def error(self) -> HeldoutError:
        """On data that the fit did not see, after the horizon that is shown."""
        same = self.shown is self.heldout
        return self.search.error if same else error_with(self.search.current.fit, self.search.shooting, self.shown)

    @property
    def values(self) -> dict[str, FittedValue]:
        """The fitted numbers by path."""
        return values_of(self.search.current, self.search.shooting)


@dataclass(frozen=True)
class RankedCandidates:
    """What may be missing, best first, and what would be the search's own choice."""

    candidates: tuple[Candidate, ...]
    choice: str | None
    """Name of the candidate that unseen blocks confirm; None where they confirm none."""
    unexplained: Unexplained | None
    """What no effect explains; looked for where there is no choice."""
    next_experiment: Experiment | None
    search: SearchState
    """The step's search with all that was tried."""


def first_step(model: PhysicsModel, runs: Sequence[Run], horizon: float = 1.0) -> StepwiseModel:
    """The given model with its free parameters refitted.

    Raises InputError for an unusable horizon or a model of another robot, RunError for unusable runs.
    """
    usable = prepare_runs(model, runs)
    evidence = data_at_horizon(usable.runs, usable.seconds)
    shown = displayed_windows(usable.runs, horizon, evidence)
    judge = check_data_sufficiency(evidence.shooting, usable.runs, runs)
    return StepwiseModel(
        initial_search(model, evidence.shooting, evidence.heldout), evidence.heldout, shown, judge.why_not
    )


def given_error(model: PhysicsModel, step: StepwiseModel) -> float:
    """The error of the model as its file stands, on the windows of the held-out error."""
    return rollout_error(model, step.shown.windows).value


def proposal(
    step: StepwiseModel, report_progress: Callable[[int, int], None] = lambda _done, _all: None
) -> RankedCandidates:
    """Every effect of the library that the model lacks on trial, alone and where none passes in pairs."""
    if step.why_not:
        return RankedCandidates((), None, Unexplained((), step.why_not, 0.0), None, _copied(step.search))
    search = _copied(step.search)
    before = {t.trial.effects[0]: t.trial for t in search.candidates if len(t.trial.effects) == 1}
    search.candidates = []
    library = library_for(step.model)
    trials = fit_trials(
        search.current, library, search.shooting, before, lambda done: report_progress(done, len(library) + 4)
    )
    report_progress(len(library), len(library) + 4)
    null = search.current
    passed = bool(library) and add_best_trial(search, len(search.added), trials, library, step.heldout)
    candidates = tuple(candidate_of(item, search) for item in search.candidates)
    chosen = next((item.effect for item in candidates if item.decision == "accepted"), None)
    rest = None if passed else find_unexplained_structure(null, step.search.shooting, search.patch)
    return RankedCandidates(candidates, chosen, rest, experiment_for(search), search)


def with_candidate(step: StepwiseModel, proposed: RankedCandidates, name: str) -> StepwiseModel:
    """The model with one of the candidates, all fitted again; the choice is the person's, whatever the ranking says.

    Raises InputError for a name that is none of the candidates.
    """
    tried = {item.trial.name: item.trial for item in proposed.search.candidates}
    if name not in tried:
        raise InputError(f"effect '{name}': not among the candidates; {did_you_mean(name, tried)}")
    search = replace(_copied(step.search), candidates=list(proposed.search.candidates))
    accept_trial(search, tried[name], step.heldout)
    for _ in range(_ROUNDS):
        _settle(search, step.heldout)
    found = replace(step, search=search)
    return replace(found, improved=_improved(step.error, found.error))


def with_final(step: StepwiseModel) -> StepwiseModel:
    """The same model with its final numbers, which a filter along whole recordings gives."""
    found, error = with_final_values(step.search.current.fit, step.search.shooting, step.heldout)
    search = _copied(step.search)
    search.current, search.error = replace(search.current, fit=found), error
    return replace(step, search=search)


def _copied(search: SearchState) -> SearchState:
    return replace(
        search, candidates=list(search.candidates), added=list(search.added), rivals=dict(search.rivals), patch=None
    )


def _settle(search: SearchState, heldout: Heldout) -> None:
    """Fits again about the present model."""
    now = search.current.fit
    search.shooting = search.shooting.around(now.model)
    again = fit(now.model, now.paths, search.shooting, now.scale)
    search.current, search.error = (
        trial_of(again, search.shooting, (), None),
        error_with(again, search.shooting, heldout),
    )


def _improved(before: HeldoutError, after: HeldoutError) -> str:
    there = np.isfinite(before.by_run) & np.isfinite(after.by_run)
    return f"{int((after.by_run[there] < before.by_run[there]).sum())}/{int(there.sum())}"
