"""Interactive diagnosis: the user adds one effect at a time from a ranked list, and may remove any of them.

The steps are those of ``diagnose``, but the user may choose another effect than the best one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from safedpa.comparison.rollout_error import rollout_error
from safedpa.diagnosis import diagnose as diagnosing
from safedpa.diagnosis.diagnose import candidate_of, experiment_for
from safedpa.diagnosis.fit.cross_validation import Heldout, HeldoutError, error_with
from safedpa.diagnosis.fit.data_checks import check_data_sufficiency, data_at_horizon, displayed_windows, prepare_runs
from safedpa.diagnosis.fit.least_squares import fit, relinearized
from safedpa.diagnosis.fit.trial import fit_trials, values_of
from safedpa.diagnosis.report_schema import Candidate, Experiment, FittedValue, Unexplained
from safedpa.diagnosis.residuals.unmodelled import find_unexplained_structure
from safedpa.diagnosis.search.final_parameters import with_final_values
from safedpa.diagnosis.search.forward_selection import add_best_trial
from safedpa.diagnosis.search.initial_model import initial_search
from safedpa.diagnosis.search.search_state import SearchState, accept_trial
from safedpa.dynamics import PhysicsModel
from safedpa.errors import InputError, did_you_mean
from safedpa.records.run import Run

# Refits about the model with the effect: the trial is linearised about the model without it, and a large effect
# lies outside that linearisation.
_REFITS = 2


@dataclass(frozen=True)
class StepwiseModel:
    """The fitted model after some steps, with everything that the next step needs."""

    search: SearchState
    shown: Heldout
    """Windows of the horizon that the user asked for."""
    why_not: str
    """Why the data allow no verdict about physics; empty if they do."""
    improved: str = ""
    """In how many runs the held-out error fell compared with the step before, such as ``4/4``."""

    @property
    def model(self) -> PhysicsModel:
        """The fitted model."""
        return self.search.current.fit.model

    @cached_property
    def error(self) -> HeldoutError:
        """Error on data that the fit did not see, after the displayed horizon."""
        same = self.shown is self.search.heldout
        return self.search.error if same else error_with(self.search.current.fit, self.search.shooting, self.shown)

    @property
    def values(self) -> dict[str, FittedValue]:
        """The fitted parameters by path."""
        return values_of(self.search.current, self.search.shooting)


@dataclass(frozen=True)
class RankedCandidates:
    """Effects that may be missing, best first, and the choice that the search would make."""

    candidates: tuple[Candidate, ...]
    choice: str | None
    """Name of the candidate that unseen blocks confirm; None if they confirm none."""
    unexplained: Unexplained | None
    """Unmodelled structure; looked for only if there is no choice."""
    next_experiment: Experiment | None
    search: SearchState
    """The step's search with everything that was tried."""


def first_step(model: PhysicsModel, runs: Sequence[Run], horizon: float = 1.0) -> StepwiseModel:
    """Refits the free parameters of the given model.

    Raises InputError for an unusable horizon or a model of another robot, RunError for unusable runs.
    """
    usable = prepare_runs(model, runs)
    evidence = data_at_horizon(usable.runs, usable.seconds)
    shown = displayed_windows(usable.runs, horizon, evidence)
    sufficiency = check_data_sufficiency(evidence.shooting, usable.runs, runs)
    return StepwiseModel(initial_search(model, evidence.shooting, evidence.heldout), shown, sufficiency.why_not)


def given_error(model: PhysicsModel, step: StepwiseModel) -> float:
    """Returns the error of the model with the values of its file, on the windows of the held-out error."""
    return rollout_error(model, step.shown.windows).value


def proposal(
    step: StepwiseModel, report_progress: Callable[[int, int], None] = lambda _done, _all: None
) -> RankedCandidates:
    """Tries every effect of the library that the model lacks: alone, and in pairs if none passes."""
    if step.why_not:
        return RankedCandidates((), None, Unexplained((), step.why_not, 0.0), None, _copied(step.search))
    search = _copied(step.search)
    # Trials of the step before are starts for this one: most parameters hardly move.
    before = {t.trial.effects[0]: t.trial for t in search.candidates if len(t.trial.effects) == 1}
    search.candidates = []
    search.library = library = diagnosing.library_for(step.model)
    # Four more units for pairs and the residual, which take about as long as four effects.
    every = len(library) + 4
    trials = fit_trials(search.current, library, search.shooting, before, lambda done: report_progress(done, every))
    report_progress(len(library), every)
    null = search.current
    accepted = bool(library) and add_best_trial(search, len(search.added), trials)
    candidates = tuple(candidate_of(item, search) for item in search.candidates)
    chosen = next((item.effect for item in candidates if item.decision == "accepted"), None)
    # A choice explains part of the residual, so its structure is only looked for if there is none.
    unexplained = None if accepted else find_unexplained_structure(null, step.search.shooting, search.region)
    return RankedCandidates(candidates, chosen, unexplained, experiment_for(search), search)


def with_candidate(step: StepwiseModel, proposed: RankedCandidates, name: str) -> StepwiseModel:
    """Adds one of the candidates, chosen by the user, and fits all parameters again.

    Raises InputError for a name that is none of the candidates.
    """
    tried = {item.trial.name: item.trial for item in proposed.search.candidates}
    if name not in tried:
        raise InputError(f"effect '{name}': not among the candidates; {did_you_mean(name, tried)}")
    search = replace(_copied(step.search), candidates=list(proposed.search.candidates))
    accept_trial(search, tried[name])
    for _ in range(_REFITS):
        search.set_model(*relinearized(search.current.fit, search.shooting))
    found = replace(step, search=search)
    return replace(found, improved=found.error.improved_runs(step.error))


def without_effect(step: StepwiseModel, name: str) -> StepwiseModel:
    """Removes one effect of the model and fits all other fitted parameters again.

    Raises InputError for an effect that the model does not have.
    """
    before = step.search.current.fit
    names = [item.name for item in before.model.effects]
    if name not in names:
        raise InputError(f"effect '{name}': the model does not have it; {did_you_mean(name, names)}")
    kept = [item for item in before.model.effects if item.name != name]
    settings = {path: value for path, value in before.model.settings.items() if path.split(".")[0] != name}
    model = PhysicsModel(before.model.base, kept, settings, before.model.period, before.model.holds)
    search = replace(_copied(step.search), candidates=[])
    search.added = [one for one in search.added if one != name]
    paths = [path for path in before.paths if path in settings]
    search.set_model(fit(model, paths, search.shooting, before.scale), search.shooting)
    for _ in range(_REFITS):
        search.set_model(*relinearized(search.current.fit, search.shooting))
    found = replace(step, search=search)
    return replace(found, improved=found.error.improved_runs(step.error))


def with_final(step: StepwiseModel) -> StepwiseModel:
    """Replaces the parameters by the final ones, which the filter along whole recordings gives."""
    found, error = with_final_values(step.search.current.fit, step.search.shooting, step.search.heldout)
    search = _copied(step.search)
    search.current, search.error = replace(search.current, fit=found), error
    return replace(step, search=search)


def _copied(search: SearchState) -> SearchState:
    """Returns a copy, so that the user can go back to an earlier step."""
    return replace(search.copy(), region=None)
