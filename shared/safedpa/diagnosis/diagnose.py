"""The diagnosis, from runs to report: data quality, search, unmodelled structure, closest effects, next experiment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np

from safedpa.comparison.comparison import EVERY, compare_model
from safedpa.comparison.rollout_error import naive_errors
from safedpa.comparison.summary import worst_bins
from safedpa.comparison.where import POSITION
from safedpa.diagnosis.add_effect import Addition, add_effect
from safedpa.diagnosis.coverage import coverage_of
from safedpa.diagnosis.detectable import detectable_sizes, with_manoeuvres
from safedpa.diagnosis.experiment_design import choose_experiment
from safedpa.diagnosis.fit.cross_validation import Heldout, error_with
from safedpa.diagnosis.fit.data_checks import (
    DataSufficiency,
    HorizonData,
    check_data_sufficiency,
    data_at_horizon,
    data_at_other_horizons,
    displayed_windows,
    finding_row,
    prepare_runs,
)
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial, values_of
from safedpa.diagnosis.report_schema import (
    Candidate,
    Detectable,
    Experiment,
    FittedValue,
    PossibleEffect,
    Remainder,
    Report,
    Unexplained,
    Verdict,
)
from safedpa.diagnosis.residuals.adequacy import remainder_of, with_sentence
from safedpa.diagnosis.residuals.dependence import forced_states
from safedpa.diagnosis.residuals.unmodelled import LibraryMatcher, alternative_formula, find_unexplained_structure
from safedpa.diagnosis.search.conditional import conditions_of
from safedpa.diagnosis.search.final_parameters import uncertain_effects
from safedpa.diagnosis.search.forward_selection import ReportProgress, run_search
from safedpa.diagnosis.search.initial_model import base_bound_message
from safedpa.diagnosis.search.nearest_candidates import (
    closest_effects,
    doubtful_effects,
    likely_effects,
    nearest_effects,
)
from safedpa.diagnosis.search.regions import share_one_area
from safedpa.diagnosis.search.search_state import JudgedTrial, SearchState
from safedpa.diagnosis.search.stages import StageReport, stages_of
from safedpa.dynamics import PhysicsModel
from safedpa.effects import AbstractEffect, effects_of
from safedpa.records.run import Finding, Run

__all__ = ["Addition", "add_effect", "candidate_of", "diagnose", "experiment_for", "library_for"]

_Unmodelled = tuple[Unexplained | None, list[JudgedTrial]]

# Share of the library's parameters whose typical size these data would have shown. Below it, "nothing is missing"
# would claim more than the data support, and the verdict is "undecided".
_MIN_DETECTABLE = 0.5


def library_for(model: PhysicsModel) -> list[AbstractEffect]:
    """Returns the robot's effects that the model's actions allow and that the model does not have.

    Without the rare ones. Bounds are those for logs of the model's period.
    """
    return [item for item in _effects_for(model) if not item.rare]


def _effects_for(model: PhysicsModel) -> list[AbstractEffect]:
    """Returns the same with the rare effects."""
    have = {item.name for item in model.effects}
    actions = set(model.system.action_names)
    every = effects_of(model.system.name).values()
    chosen = [item for item in every if item.name not in have and set(item.needs) <= actions]
    return [item.at_period(model.period) for item in chosen]


def diagnose(
    model: PhysicsModel,
    runs: Sequence[Run],
    horizon: float = 1.0,
    report_progress: ReportProgress = lambda _done, _all, _message: None,
) -> Report:
    """Finds the effects of the library that a model lacks, from runs that it should predict.

    The data determine the horizon on which the search decides; ``horizon`` [s] is that of the displayed errors. Raises
    InputError for an unusable horizon or a model of another robot, RunError for unusable runs.
    """
    usable = prepare_runs(model, runs)
    evidence = data_at_horizon(usable.runs, usable.seconds)
    shown = displayed_windows(usable.runs, horizon, evidence)
    # Judged before the search: with too little data, any ranking of effects would look like a finding.
    judge = check_data_sufficiency(evidence.shooting, usable.runs, runs)
    library = [*library_for(model), *(item for item in _effects_for(model) if item.rare)]  # rare ones are tried last
    if not judge.enough:
        usable.quality.append(finding_row("all", Finding("no_verdict", judge.why_not)))
    horizons: list[float] = []

    def other_horizons() -> list[HorizonData]:
        found = list(data_at_other_horizons(usable.runs, usable.seconds))
        horizons.extend(item.seconds for item in found if item.seconds not in horizons)
        return found

    # An empty library skips the additions but still refits the free parameters, whose error the report shows.
    tried, data = library if judge.enough else [], (evidence.shooting, evidence.heldout)
    search = run_search(model, tried, *data, report_progress, other_horizons, _remaining)
    usable.quality.extend(_findings_of_search(search, evidence))  # before effects may be withdrawn
    # Unmodelled structure comes after the search: it is what the accepted effects leave, and may withdraw them.
    unexplained, likely = found = _unmodelled(search, judge, library)
    sizes, remainder = (_sizes(search, library), _remainder(search)) if judge.enough else ((), None)
    doubtful = doubtful_effects(search)
    shown = search.heldout if shown is evidence.heldout else shown.with_commands(between_rows=search.between_rows)
    reported, final = stages_of(search, shown), values_of(search.current, search.shooting)
    return Report(
        robot=model.system.name,
        horizon=horizon,
        verdict=_verdict(search, found, judge, sizes, remainder) if not doubtful else "undecided",
        added=tuple(search.added),
        stages=tuple(reported.stages),
        candidates=_candidates(search, shown, reported, final),
        where=_where(model, usable.runs, horizon),
        unexplained=unexplained,
        next_experiment=experiment_for(search),
        data_quality=(*_base_at_bound(search), *usable.quality),
        parameters=final,
        models=tuple(reported.models),
        closest=_closest([*doubtful, *likely], search, sizes),
        detectable=tuple(sizes),
        naive=naive_errors(shown.windows),
        worse=reported.worse,
        conditions=conditions_of(search.current.fit.model, search.added),
        evidence=(usable.seconds, *horizons),
        coverage=coverage_of(usable.runs),
        tried=_tried(search),
        uncertain=tuple(uncertain_effects(search)),
        remainder=remainder,
    )


def _sizes(search: SearchState, library: Sequence[AbstractEffect]) -> Sequence[Detectable]:
    """Returns the smallest size of each effect that would have been found, with a drive that shows smaller ones."""
    common = [item for item in search.available if not item.rare]
    sizes = detectable_sizes(search.current, common, search.shooting, search.error)
    return with_manoeuvres(sizes, search.current, library)


def _remaining(trial: EffectTrial, shooting: Shooting) -> Remainder | None:
    return remainder_of(trial, shooting, forced_states(trial.fit.model))


def _remainder(search: SearchState) -> Remainder | None:
    """Returns what the last model leaves of unseen data, with a sentence if it is neither noise nor disturbance."""
    found = _remaining(search.current, search.shooting)
    first = search.first_error.value if search.added else None
    return None if found is None else with_sentence(found, search.error, first, _state_names(search))


def _one_explains(likely: Sequence[JudgedTrial], search: SearchState) -> bool:
    """Returns whether one of the likely effects leaves only noise and a disturbance of unseen data."""
    for item in likely:
        found = _remaining(item.trial, search.shooting)
        error = item.error or search.error
        if found is None or not with_sentence(found, error, None, _state_names(search)).sentence:
            return True
    return False


def _state_names(search: SearchState) -> tuple[str, ...]:
    return search.shooting.windows.system.state_names


def _tried(search: SearchState) -> tuple[int, int]:
    """Returns how many different effects and combinations of effects were fitted."""
    tried = {item.trial.effects for item in search.candidates}
    combined = {frozenset(names) for names in tried if len(names) > 1}
    return len({names for names in tried if len(names) == 1}), len(combined)


def _closest(
    possible: Sequence[JudgedTrial], search: SearchState, sizes: Sequence[Detectable]
) -> tuple[PossibleEffect, ...]:
    noise = np.maximum(search.current.fit.scale, 1e-9)
    return closest_effects(
        possible, search, [values_of(item.trial, search.shooting) for item in possible], sizes, noise
    )


def _unmodelled(search: SearchState, judge: DataSufficiency, library: Sequence[AbstractEffect]) -> _Unmodelled:
    """Returns what the accepted effects leave, a formula or a dependence, and effects that may be missing."""
    if not judge.enough:
        # If columns or units are wrong, even a list of the closest effects would mislead.
        near = [] if judge.wrong else nearest_effects(search, library)
        return Unexplained((), judge.why_not, 0.0), near
    names = LibraryMatcher(search)
    structure = alternative_formula(search, names) or find_unexplained_structure(
        search.current, search.shooting, search.region, names
    )
    named = {item.trial.effects for item in names.found}
    others = [item for item in likely_effects(search) if item.trial.effects not in named]
    return structure, [*names.found, *others]


def _separate_areas(evidence: HorizonData) -> list[dict[str, Any]]:
    """Returns a finding if the runs do not overlap in position: whether they share a room is then unknown."""
    names = evidence.shooting.windows.system.state_names
    if not set(POSITION) <= set(names) or share_one_area(evidence.shooting):
        return []
    message = (
        "the runs do not overlap in position, so no region of the floor was looked for; if they are of one room, "
        "record them in one coordinate frame"
    )
    return [finding_row("all", Finding("different_places", message))]


def _findings_of_search(search: SearchState, evidence: HorizonData) -> list[dict[str, Any]]:
    return [*_implausible_error(search), *_separate_areas(evidence), *_timing(search)]


def _base_at_bound(search: SearchState) -> list[dict[str, Any]]:
    message = base_bound_message(search)
    return [finding_row("all", Finding("base_at_bound", message))] if message else []


def _timing(search: SearchState) -> list[dict[str, Any]]:
    """Returns a finding if unseen data show that commands change between the rows of the recordings."""
    if not search.between_rows:
        return []
    message = (
        "commands change between the rows that show them, half a period before on average; diagnosis used their means "
        "between rows, so its errors differ from those of a comparison"
    )
    return [finding_row("all", Finding("timing", message))]


def _implausible_error(search: SearchState) -> list[dict[str, Any]]:
    """Returns a finding if the final model predicts worse than no change: wrong units or columns, not an effect."""
    # 1.0 is the error of predicting no change; 1.5 leaves room for a poor but sensible model.
    if not search.error.value > 1.5:
        return []
    message = (
        f"even with all effects found the error is {search.error.value:.2f}, more than that of predicting no change: "
        "check for wrong units (degrees), swapped columns or another robot's model before trusting any effect"
    )
    return [finding_row("all", Finding("implausible", message))]


def _verdict(
    search: SearchState,
    found: _Unmodelled,
    judge: DataSufficiency,
    sizes: Sequence[Detectable],
    remainder: Remainder | None,
) -> Verdict:
    if not judge.enough:
        return "unexplained" if judge.wrong else "undecided"
    unexplained, likely = found
    # Checked before the effects: an effect that was added to a model with wrong units is not a finding.
    implausible = search.error.value > 1.5 or not np.isfinite(search.error.value)
    # An effect of the library that is likely, and leaves nothing, explains the rest better than "none explains it".
    rest = remainder is not None and remainder.sentence and (search.added or not _one_explains(likely, search))
    if implausible or rest or (unexplained is not None and not search.added):
        return "unexplained"
    if search.added:
        return "effect_missing"
    if likely or sum(size.shown for size in sizes) < _MIN_DETECTABLE * len(sizes):
        return "undecided"
    return "nothing_missing"


def _candidates(
    search: SearchState, shown: Heldout, reported: StageReport, final: Mapping[str, FittedValue]
) -> tuple[Candidate, ...]:
    """Returns the candidates as judged, accepted ones with their final parameters and the error of their stage.

    So no quantity appears in a report with two values.
    """
    found = []
    for item in search.candidates:
        candidate = candidate_of(item, search)
        if item.decision == "accepted" and set(item.trial.effects) <= set(search.added):
            stage = next(entry for entry in reported.stages if set(item.trial.effects) <= set(entry.effects))
            values = {key: final[key if "." in key else f"{candidate.effect}.{key}"] for key in candidate.parameters}
            candidate = replace(candidate, heldout_error=stage.heldout_error, parameters=values)
        elif item.error is not None and shown is not search.heldout:
            error = error_with(item.trial.fit, search.shooting, shown).value
            candidate = replace(candidate, heldout_error=error)
        found.append(candidate)
    return tuple(found)


def candidate_of(item: JudgedTrial, search: SearchState) -> Candidate:
    """Returns a trial with its verdict in the form of the report."""
    names = set(item.trial.effects)
    paths = [path for path in item.trial.fit.paths if path.split(".")[0] in names]
    every = values_of(item.trial, search.shooting)
    return Candidate(
        stage=item.stage,
        effect=item.trial.name,
        parameters={path if len(names) > 1 else path.split(".")[1]: every[path] for path in paths},
        heldout_error=None if item.error is None else item.error.value,
        score=item.gain,
        indistinguishable_from=item.equals,
        decision=item.decision,  # type: ignore[arg-type]
        reason=item.reason,
    )


def _where(model: PhysicsModel, runs: Sequence[Run], horizon: float) -> tuple[dict[str, Any], ...]:
    """Returns the bins in which the given model's error is largest."""

    seconds = sum(run.duration for run in runs)
    # At most 1500 windows: the bins need no more, and long recordings would take as long as the search.
    comparison = compare_model(model, runs, horizon, every=max(EVERY, seconds / 1500))
    keys = ("variable", "unit", "low", "high", "error", "ratio", "share", "samples", "run")
    return tuple({key: getattr(item, key) for key in keys} for item in worst_bins(comparison))


def experiment_for(search: SearchState) -> Experiment | None:
    """Returns the experiment that separates the first open candidate from its equivalents; None if none is open."""
    # The residual's scale stands for the measurement noise; it is 0 for simulated recordings without noise.
    noise = np.maximum(search.current.fit.scale, 1e-9)
    for item in search.candidates:
        if item.decision != "rejected" and item.equals:
            same = [one for one in search.candidates if one.stage == item.stage and one.trial.name in item.equals]
            # At most four models: the experiment has to separate all pairs, and more hardly have one in common.
            models = {one.trial.name: one.trial.fit.model for one in (item, *same)}
            if len(models) > 1:
                return choose_experiment(dict(islice(models.items(), 4)), noise)
    return None
