"""Jobs of the workbench's background process: functions with picklable arguments and results."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from safedpa.comparison.comparison import EVERY, Comparison, compare_model
from safedpa.comparison.rollout_error import RolloutError, rollout_error
from safedpa.diagnosis.interactive import (
    RankedCandidates,
    StepwiseModel,
    first_step,
    proposal,
    with_candidate,
    without_effect,
)
from safedpa.diagnosis.report_schema import Candidate, Experiment, FittedValue, Unexplained
from safedpa.dynamics import PhysicsModel
from safedpa.records.run import Run

ReportProgress = Callable[[float], None]
"""Called with the share that is done, from 0 to 1."""

_MAX_WINDOWS = 2500
"""Windows that are compared and drawn; for longer recordings the starts are spaced farther apart."""
_FITTED_CANDIDATES = 4
"""Best candidates that the search also fits fully: their values are final and adding them takes no time."""


REMOVED = "\N{MINUS SIGN} "
"""Begins the label of a version from which an effect was removed."""


@dataclass(frozen=True)
class SessionVersion:
    """A version of the model, with everything that the page shows of it."""

    label: str
    model: PhysicsModel
    error: float
    """Rollout error on held-out data."""
    per_state: dict[str, float]
    improved: str
    """Runs in which the error fell compared with the version before, such as ``4/4``; empty for the first versions."""
    values: dict[str, FittedValue]
    comparison: Comparison = field(repr=False)
    step: bytes = field(repr=False)
    """The pickled step that a search continues from; empty for a version that no search continues from."""


@dataclass(frozen=True)
class SearchResult:
    """Candidates that a search proposes after a version."""

    candidates: tuple[Candidate, ...]
    """The choice first, then by predictive score."""
    choice: str | None
    unexplained: Unexplained | None
    next_experiment: Experiment | None
    fitted: dict[str, SessionVersion]
    """Fully fitted versions with the best candidates, by effect."""
    proposal: bytes = field(repr=False)


def first_versions(
    model: PhysicsModel, runs: Sequence[Run], horizon: float, report_progress: ReportProgress
) -> list[SessionVersion]:
    """Returns the given model and, if it has free parameters, the refitted one.

    Raises InputError for an unusable horizon or a model of another robot, and RunError for unusable runs.
    """
    step = first_step(model, runs, horizon)
    report_progress(0.4)
    windows = step.shown.windows
    given = compare_for_page(model, runs, horizon)
    report_progress(0.8)
    error = rollout_error(model, windows)
    pickled = pickle.dumps(step)
    free = bool(model.latent_names)
    first = SessionVersion(
        "given model", model, error.value, _by_state(error, step), "", {}, given, b"" if free else pickled
    )
    if not free:
        return [first]
    return [first, _version("free parameters refitted", step, runs, horizon)]


def search(step: bytes, runs: Sequence[Run], horizon: float, report_progress: ReportProgress) -> SearchResult:
    """Searches for effects that a version lacks, and fits the best candidates fully."""
    before: StepwiseModel = pickle.loads(step)
    found = proposal(before, lambda done, every: report_progress(0.7 * done / every))
    report_progress(0.75)
    candidates = _sorted_candidates(found)
    best = candidates[:_FITTED_CANDIDATES]
    fitted = {}
    for number, item in enumerate(best):
        fitted[item.effect] = _version_with(before, found, item.effect, runs, horizon)
        report_progress(0.75 + 0.25 * (number + 1) / len(best))
    return SearchResult(candidates, found.choice, found.unexplained, found.next_experiment, fitted, pickle.dumps(found))


def add_candidate(
    step: bytes, proposed: bytes, name: str, runs: Sequence[Run], horizon: float, report_progress: ReportProgress
) -> SessionVersion:
    """Returns the version with one candidate added; raises InputError for an unknown name."""
    report_progress(0.1)
    return _version_with(pickle.loads(step), pickle.loads(proposed), name, runs, horizon)


def remove_effect(
    step: bytes, name: str, runs: Sequence[Run], horizon: float, report_progress: ReportProgress
) -> SessionVersion:
    """Returns the version without one effect, fitted again; raises InputError for one that it does not have."""
    report_progress(0.1)
    return _version(f"{REMOVED}{name}", without_effect(pickle.loads(step), name), runs, horizon)


def compare_for_page(model: PhysicsModel, runs: Sequence[Run], horizon: float) -> Comparison:
    """Compares the model with the runs, in no more windows than a page can draw."""
    seconds = sum(run.duration for run in runs)
    return compare_model(model, runs, horizon, every=max(EVERY, seconds / _MAX_WINDOWS))


def _version_with(
    before: StepwiseModel, found: RankedCandidates, name: str, runs: Sequence[Run], horizon: float
) -> SessionVersion:
    return _version(f"+ {name}", with_candidate(before, found, name), runs, horizon)


def _version(label: str, step: StepwiseModel, runs: Sequence[Run], horizon: float) -> SessionVersion:
    comparison = compare_for_page(step.model, runs, horizon)
    per_state = _by_state(step.error, step)
    pickled = pickle.dumps(step)
    return SessionVersion(
        label, step.model, step.error.value, per_state, step.improved, step.values, comparison, pickled
    )


def _by_state(error: RolloutError | Any, step: StepwiseModel) -> dict[str, float]:
    names = step.search.heldout.windows.system.state_names
    return {name: float(value) for name, value in zip(names, error.per_state, strict=True)}


def _sorted_candidates(found: RankedCandidates) -> tuple[Candidate, ...]:
    """Accepted first, then suspected, then rejected; each in the order of the search."""
    rank = {"accepted": 0, "suspected": 1, "rejected": 2}
    return tuple(sorted(found.candidates, key=lambda item: rank[item.decision]))
