"""The diagnosis from runs to report: quality, search, what remains, the next experiment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from safedpa.diagnosis.experiment_choice import chosen_experiment
from safedpa.diagnosis.fitting import fit
from safedpa.diagnosis.heldout import HeldoutError, error_with, heldout_of
from safedpa.diagnosis.remaining import formula_instead, remaining
from safedpa.diagnosis.report import Candidate, Experiment, Report, Unexplained, Value, Verdict
from safedpa.diagnosis.report_excerpt import excerpt
from safedpa.diagnosis.search import Judged, Search, searched
from safedpa.diagnosis.shooting import Shooting, shooting_of
from safedpa.diagnosis.stages import stages_of
from safedpa.diagnosis.summary import worst_bins
from safedpa.diagnosis.trial import Trial, trial_of
from safedpa.dynamics import PhysicsModel
from safedpa.effects import AbstractEffect, effect, effects_of
from safedpa.errors import InputError, RunError
from safedpa.records.run import Finding, Run

__all__ = [
    "Addition",
    "add_effect",
    "candidate_of",
    "diagnose",
    "experiment_for",
    "judgeable",
    "library_for",
    "prepared",
    "values_of",
]

_MOST_ROWS = 40_000
"""Of longer logs evenly spread pieces are used."""
_FEWEST_WINDOWS = 10
_FEWEST_SECONDS = 5.0
_SEVERE = ("swapped_columns", "opposite_sign", "unit_mistake", "yaw_inconsistent", "steer_inconsistent")
"""Findings with which no verdict about physics is possible."""
_LONGEST_WINDOW = 2.0
"""s; disturbances add up over longer ones."""

Tell = Callable[[int, int], None]


def library_for(model: PhysicsModel) -> list[AbstractEffect]:
    """Every effect of the robot that the model's actions allow and the model does not have."""
    have = {item.name for item in model.effects}
    actions = set(model.system.action_names)
    every = effects_of(model.system.name).values()
    return [item for item in every if item.name not in have and set(item.needs) <= actions]


def diagnose(
    model: PhysicsModel, runs: Sequence[Run], horizon: float = 1.0, tell: Tell = lambda _done, _all: None
) -> Report:
    """Which effects of the library the model lacks, by runs that it should predict.

    Raises InputError for an unusable horizon or a model of another robot, RunError for unusable runs.
    """
    used, quality = prepared(model, runs, horizon)
    heldout = heldout_of(used, horizon)
    shooting = shooting_of(used, min(horizon, _LONGEST_WINDOW))
    enough, why = judgeable(shooting, used, runs)
    library = library_for(model) if enough else []
    if not enough:
        quality.append(_row("all", Finding("no_verdict", why)))
    search = searched(model, library, shooting, heldout, tell)
    quality += _too_bad(search)
    rest = (formula_instead(search) or remaining(search.current, search.shooting, search.patch)) if enough else None
    stages, models = stages_of(search, heldout)
    return Report(
        robot=model.system.name,
        horizon=horizon,
        verdict=_verdict(search, rest, enough),
        added=tuple(search.added),
        stages=tuple(stages),
        candidates=tuple(candidate_of(item, search) for item in search.candidates),
        where=_where(model, used, horizon),
        unexplained=rest if enough else Unexplained((), why, 0.0),
        next_experiment=experiment_for(search),
        data_quality=tuple(quality),
        parameters=values_of(search.current, search.shooting),
        models=tuple(models),
    )


def prepared(model: PhysicsModel, runs: Sequence[Run], horizon: float = 1.0) -> tuple[list[Run], list[dict[str, Any]]]:
    """Runs that can be used, thinned to what fits in memory, and what is to be said about them."""
    quality = [_row(run.name, finding) for run in runs for finding in run.findings]
    rows = sum(len(part) for run in runs for part in run.stretches)
    used = excerpt(runs, _MOST_ROWS, horizon)
    if rows > _MOST_ROWS:
        kept = sum(len(part) for run in used for part in run.stretches)
        message = f"of {rows} rows, {kept} in evenly spread pieces were used for fitting and judging"
        quality.append(_row("all", Finding("thinned", message, rows - kept)))
    for run in used:
        quality += [_row(run.name, item) for item in _inputs(run)]
    return used, quality


def _inputs(run: Run) -> list[Finding]:
    """Inputs that never change say nothing about what they do."""
    actions = np.concatenate([part for _, _, part in run.parts()])
    known = {finding.kind for finding in run.findings}
    if "constant_input" in known or not len(actions):
        return []
    still = [v.name for v, size in zip(run.system.action, np.ptp(actions, axis=0), strict=True) if size < 1e-9]
    message = f"{', '.join(still)} never changes: effects on it cannot be told from constants"
    return [Finding("constant_input", message, len(actions))] if still else []


def _row(run: str, finding: Finding) -> dict[str, Any]:
    return {"run": run, **vars(finding)}


def judgeable(shooting: Shooting, used: Sequence[Run], runs: Sequence[Run]) -> tuple[bool, str]:
    """Whether the data allow a verdict about physics, and why not: ``used`` is what was taken of ``runs``."""
    wrong = _wrong(runs)
    return (False, wrong) if wrong else _enough(shooting, used)


def _enough(shooting: Shooting, runs: Sequence[Run]) -> tuple[bool, str]:
    """Whether there is enough to judge anything, and why not."""
    seconds = sum(run.duration for run in runs)
    if len(shooting.windows) < _FEWEST_WINDOWS or seconds < _FEWEST_SECONDS:
        return False, (
            f"{seconds:.1f} s in {len(shooting.windows)} independent windows are too little to judge an effect; "
            f"record at least {_FEWEST_SECONDS:g} s and {_FEWEST_WINDOWS} times the horizon, better a minute"
        )
    actions = np.concatenate([part for run in runs for _, _, part in run.parts()])
    if actions.shape[1] and (np.ptp(actions, axis=0) < 1e-9).all():
        return False, "no input ever changes: nothing can be told from a constant; record a drive with steps in it"
    return True, ""


def _wrong(runs: Sequence[Run]) -> str:
    """What makes recordings something else than they say, empty where nothing does."""
    found = [f"{run.name}: {item.message}" for run in runs for item in run.findings if item.kind in _SEVERE]
    return found[0] if found else ""


def _too_bad(search: Search) -> list[dict[str, Any]]:
    """A model that predicts worse than no change after all: wrong units or columns, rather than an effect."""
    if not search.error.value > 1.5:
        return []
    message = (
        f"even with all that was found the error is {search.error.value:.2f}, more than assuming no change would have: "
        "look for wrong units (degrees), swapped columns or another robot's model before believing any effect"
    )
    return [_row("all", Finding("implausible", message))]


def _verdict(search: Search, rest: Unexplained | None, enough: bool) -> Verdict:
    if not enough or search.error.value > 1.5 or not np.isfinite(search.error.value):
        return "unexplained"
    if search.added:
        return "effect_missing"
    return "nothing_missing" if rest is None else "unexplained"


def candidate_of(item: Judged, search: Search) -> Candidate:
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


def values_of(trial: Trial, shooting: Shooting) -> dict[str, Value]:
    """The fitted numbers of a trial by path."""
    model, deviations = trial.fit.model, trial.fit.deviations(shooting)
    found = {}
    for path, value, std in zip(trial.fit.paths, trial.fit.values, deviations, strict=True):
        spread = float(std) if np.isfinite(std) else None
        found[path] = Value(float(value), spread, model.parameters[path].unit)
    return found


def _where(model: PhysicsModel, runs: Sequence[Run], horizon: float) -> tuple[dict[str, Any], ...]:
    from safedpa.diagnosis.comparison import EVERY, compare_model

    seconds = sum(run.duration for run in runs)
    comparison = compare_model(model, runs, horizon, every=max(EVERY, seconds / 1500))
    keys = ("variable", "unit", "low", "high", "error", "ratio", "share", "samples", "run")
    return tuple({key: getattr(item, key) for key in keys} for item in worst_bins(comparison))


def experiment_for(search: Search) -> Experiment | None:
    """Between an accepted effect and what this data cannot tell from it; else between the best two candidates."""
    noise = np.maximum(search.current.fit.scale, 1e-9)
    for item in search.candidates:
        if item.decision != "rejected" and item.equals:
            models = _survivors(item, search)
            if len(models) > 1:
                return chosen_experiment(models, noise)
    return None


def _survivors(item: Judged, search: Search) -> dict[str, PhysicsModel]:
    same = [other for other in search.candidates if other.stage == item.stage]
    models = {item.trial.name: item.trial.fit.model}
    for other in same:
        if other.trial.name in item.equals and len(models) < 4:
            models[other.trial.name] = other.trial.fit.model
    return models


class Addition:
    """One effect by choice: the fitted model, its numbers, and the held-out errors before and after."""

    def __init__(
        self, model: PhysicsModel, values: dict[str, Value], before: HeldoutError, after: HeldoutError
    ) -> None:
        self.model, self.values, self.before, self.after = model, values, before, after


def add_effect(model: PhysicsModel, name: str, runs: Sequence[Run], horizon: float = 1.0) -> Addition:
    """Fits one effect on top of a model, whatever the ranking says.

    Raises InputError for an unknown effect or one that the model has, RunError for unusable runs.
    """
    from safedpa.diagnosis.trial import tried

    item = effect(model.system.name, name)
    if name in {own.name for own in model.effects}:
        raise InputError(f"effect '{name}': the model has it already; mark its parameters free to refit them")
    used, _ = prepared(model, runs, horizon)
    heldout = heldout_of(used, horizon)
    shooting = shooting_of(used, min(horizon, _LONGEST_WINDOW))
    if len(shooting.windows) < 3:
        raise RunError(f"runs: got {len(shooting.windows)} windows of {horizon:g} s, wanted at least 3; record more")
    search = searched(model, [], shooting, heldout)
    trial = tried(search.current, [item], search.shooting)
    again = search.shooting.around(trial.fit.model)
    final = trial_of(fit(trial.fit.model, trial.fit.paths, again, trial.fit.scale), again, (name,), None)
    return Addition(final.fit.model, values_of(final, again), search.error, error_with(final.fit, again, heldout))
