"""The diagnosis from runs to report: quality, search, what remains, what comes closest, the next experiment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from safedpa.comparison.naive import naive_errors
from safedpa.comparison.summary import worst_bins
from safedpa.comparison.where import PLACE
from safedpa.diagnosis.add_effect import Addition, add_effect
from safedpa.diagnosis.coverage import coverage_of
from safedpa.diagnosis.detectable import detectable_sizes, with_manoeuvres
from safedpa.diagnosis.experiment_design.choice import choose_experiment
from safedpa.diagnosis.fit.cross_validation import Heldout, error_with
from safedpa.diagnosis.fit.data_checks import (
    MOST_ROWS,
    DataSufficiency,
    check_data_sufficiency,
    finding_row,
    prepare_runs,
)
from safedpa.diagnosis.fit.horizon import HorizonData, data_at_horizon, data_at_other_horizons, displayed_windows
from safedpa.diagnosis.fit.trial import values_of
from safedpa.diagnosis.report_schema import Candidate, Detectable, Experiment, FittedValue, Report, Unexplained, Verdict
from safedpa.diagnosis.residuals.match_effects import LibraryMatcher
from safedpa.diagnosis.residuals.unmodelled import alternative_formula, find_unexplained_structure
from safedpa.diagnosis.search.conditional import conditions_of
from safedpa.diagnosis.search.forward_selection import JudgedTrial, ReportProgress, SearchState, run_search
from safedpa.diagnosis.search.nearest_candidates import (
    closest_effects,
    doubtful_effects,
    likely_effects,
    nearest_effects,
)
from safedpa.diagnosis.search.regions import share_one_area
from safedpa.diagnosis.search.stages import StageReport, stages_of
from safedpa.dynamics import PhysicsModel
from safedpa.effects import AbstractEffect, effects_of
from safedpa.records.run import Finding, Run

__all__ = ["Addition", "add_effect", "candidate_of", "diagnose", "experiment_for", "library_for"]

_MOST_ROWS = MOST_ROWS
_MOST_SHOWN = 0.5
"""Share of the library's numbers of which an ordinary size would have been found, without which "nothing is missing"
would say more than the data do."""


def library_for(model: PhysicsModel) -> list[AbstractEffect]:
    """Every effect of the robot that the model's actions allow and the model does not have."""
    have = {item.name for item in model.effects}
    actions = set(model.system.action_names)
    every = effects_of(model.system.name).values()
    return [item for item in every if item.name not in have and set(item.needs) <= actions]


def diagnose(
    model: PhysicsModel,
    runs: Sequence[Run],
    horizon: float = 1.0,
    report_progress: ReportProgress = lambda _done, _all, _message: None,
) -> Report:
    """Which effects of the library the model lacks, by runs that it should predict.

    The data choose the horizons at which is decided; ``horizon`` [s] is that of the errors that are shown. Raises
    InputError for an unusable horizon or a model of another robot, RunError for unusable runs.
    """
    usable = prepare_runs(model, runs, _MOST_ROWS)
    evidence = data_at_horizon(usable.runs, usable.seconds)
    shown = displayed_windows(usable.runs, horizon, evidence)
    judge = check_data_sufficiency(evidence.shooting, usable.runs, runs)
    library = library_for(model)
    if not judge.enough:
        usable.quality.append(finding_row("all", Finding("no_verdict", judge.why_not)))
    asked: list[float] = []

    def alongside() -> list[HorizonData]:
        found = list(data_at_other_horizons(usable.runs, usable.seconds))
        asked.extend(item.seconds for item in found if item.seconds not in asked)
        return found

    search = run_search(
        model, library if judge.enough else [], evidence.shooting, evidence.heldout, report_progress, alongside
    )
    usable.quality.extend([*_too_bad(search), *_rooms(evidence)])
    found = _rest_of(search, judge, LibraryMatcher(search, library, evidence.heldout))
    sizes = with_manoeuvres(_sizes(search, library), search.current, library) if judge.enough else ()
    doubtful = doubtful_effects(search)
    reported, final = stages_of(search, evidence.heldout, shown), values_of(search.current, search.shooting)
    return Report(
        robot=model.system.name,
        horizon=horizon,
        verdict=_verdict(search, found, judge, sizes) if not doubtful else "undecided",
        added=tuple(search.added),
        stages=tuple(reported.stages),
        candidates=_candidates(search, evidence.heldout, shown, reported, final),
        where=_where(model, usable.runs, horizon),
        unexplained=found.unexplained,
        next_experiment=experiment_for(search),
        data_quality=tuple(usable.quality),
        parameters=final,
        models=tuple(reported.models),
        closest=closest_effects(
            [*doubtful, *found.likely],
            search,
            [values_of(item.trial, search.shooting) for item in [*doubtful, *found.likely]],
            sizes,
            np.maximum(search.current.fit.scale, 1e-9),
        ),
        detectable=tuple(sizes),
        naive=naive_errors(shown.windows),
        worse=reported.worse,
        conditions=conditions_of(search.current.fit.model, search.added),
        evidence=(usable.seconds, *asked),
        coverage=coverage_of(usable.runs),
    )


@dataclass(frozen=True)
class _Rest:
    """What no effect explains, and effects that may be missing."""

    unexplained: Unexplained | None
    likely: list[JudgedTrial]


def _rest_of(search: SearchState, judge: DataSufficiency, names: LibraryMatcher) -> _Rest:
    if not judge.enough:
        near = [] if judge.wrong else nearest_effects(search, names.library, names.heldout)
        return _Rest(Unexplained((), judge.why_not, 0.0), near)
    rest = alternative_formula(search, names) or find_unexplained_structure(
        search.current, search.shooting, search.patch, names
    )
    named = {item.trial.effects for item in names.found}
    others = [item for item in likely_effects(search) if item.trial.effects not in named]
    return _Rest(rest, [*names.found, *others])


def _sizes(search: SearchState, library: Sequence[AbstractEffect]) -> list[Detectable]:
    have = {item.name for item in search.current.fit.model.effects}
    rest = [item for item in library if item.name not in have]
    return detectable_sizes(search.current, rest, search.shooting, search.error)


def _rooms(evidence: HorizonData) -> list[dict[str, Any]]:
    """Runs that were in different places: whether they are of one room is not assumed."""
    names = evidence.shooting.windows.system.state_names
    if not set(PLACE) <= set(names) or share_one_area(evidence.shooting):
        return []
    message = (
        "the runs lie in different places, so no place on the floor was looked for; if they are of one room, give them "
        "in one frame"
    )
    return [finding_row("all", Finding("different_places", message))]


def _too_bad(search: SearchState) -> list[dict[str, Any]]:
    """A model that predicts worse than no change after all: wrong units or columns, rather than an effect."""
    if not search.error.value > 1.5:
        return []
    message = (
        f"even with all that was found the error is {search.error.value:.2f}, more than assuming no change would have: "
        "look for wrong units (degrees), swapped columns or another robot's model before believing any effect"
    )
    return [finding_row("all", Finding("implausible", message))]


def _verdict(search: SearchState, found: _Rest, judge: DataSufficiency, sizes: Sequence[Detectable]) -> Verdict:
    if not judge.enough:
        return "unexplained" if judge.wrong else "undecided"
    if search.error.value > 1.5 or not np.isfinite(search.error.value):
        return "unexplained"
    if search.added:
        return "effect_missing"
    if found.unexplained is not None:
        return "unexplained"
    if found.likely or sum(size.shown for size in sizes) < _MOST_SHOWN * len(sizes):
        return "undecided"
    return "nothing_missing"


def _candidates(
    search: SearchState, heldout: Heldout, shown: Heldout, reported: StageReport, final: Mapping[str, FittedValue]
) -> tuple[Candidate, ...]:
    """As they were judged; what was accepted with the final numbers and the error of its stage, so that no number
    stands in a report twice with another value."""
    found = []
    for item in search.candidates:
        made = candidate_of(item, search)
        if item.decision == "accepted" and set(item.trial.effects) <= set(search.added):
            stage = next(own for own in reported.stages if set(item.trial.effects) <= set(own.effects))
            numbers = {key: final[key if "." in key else f"{made.effect}.{key}"] for key in made.parameters}
            made = replace(made, heldout_error=stage.heldout_error, parameters=numbers)
        elif item.error is not None and shown is not heldout:
            made = replace(made, heldout_error=error_with(item.trial.fit, search.shooting, shown).value)
        found.append(made)
    return tuple(found)


def candidate_of(item: JudgedTrial, search: SearchState) -> Candidate:
    """A trial with its verdict as the report states it."""
    own = set(item.trial.effects)
    paths = [path for path in item.trial.fit.paths if path.split(".")[0] in own]
    every = values_of(item.trial, search.shooting)
    return Candidate(
        stage=item.stage,
        effect=item.trial.name,
        parameters={path if len(own) > 1 else path.split(".")[1]: every[path] for path in paths},
        heldout_error=None if item.error is None else item.error.value,
        score=item.gain,
        indistinguishable_from=item.equals,
        decision=item.decision,  # type: ignore[arg-type]
        reason=item.reason,
    )


def _where(model: PhysicsModel, runs: Sequence[Run], horizon: float) -> tuple[dict[str, Any], ...]:
    from safedpa.comparison.comparison import EVERY, compare_model

    seconds = sum(run.duration for run in runs)
    comparison = compare_model(model, runs, horizon, every=max(EVERY, seconds / 1500))
    keys = ("variable", "unit", "low", "high", "error", "ratio", "share", "samples", "run")
    return tuple({key: getattr(item, key) for key in keys} for item in worst_bins(comparison))


def experiment_for(search: SearchState) -> Experiment | None:
    """Between an accepted effect and what this data cannot tell from it; else between the best two candidates."""
    noise = np.maximum(search.current.fit.scale, 1e-9)
    for item in search.candidates:
        if item.decision != "rejected" and item.equals:
            models = _survivors(item, search)
            if len(models) > 1:
                return choose_experiment(models, noise)
    return None


def _survivors(item: JudgedTrial, search: SearchState) -> dict[str, PhysicsModel]:
    same = [other for other in search.candidates if other.stage == item.stage]
    models = {item.trial.name: item.trial.fit.model}
    for other in same:
        if other.trial.name in item.equals and len(models) < 4:
            models[other.trial.name] = other.trial.fit.model
    return models
