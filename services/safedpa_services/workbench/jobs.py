"""What the workbench computes in its background process: functions of plain arguments with picklable results."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from safedpa.comparison.comparison import EVERY, Comparison, compare_model
from safedpa.comparison.rollout_error import RolloutError, rollout_error
from safedpa.diagnosis.interactive import RankedCandidates, StepwiseModel, first_step, proposal, with_candidate
from safedpa.diagnosis.report_schema import Candidate, Experiment, FittedValue, Unexplained
from safedpa.dynamics import PhysicsModel
from safedpa.records.run import Run

__all__ = ["SearchResult", "SessionVersion", "add_candidate", "compare_for_page", "opened", "search"]

ReportProgress = Callable[[float], None]
"""Told how much is done, from 0 to 1."""

_MOST_WINDOWS = 2500
"""That are compared and drawn; of longer recordings the starts lie farther apart."""
_SETTLED = 4
"""Candidates that are fitted to the end, so that their numbers stand and adding them takes no time."""


@dataclass(frozen=True)
class SessionVersion:
    """A model on the way, with everything that the page shows of it."""

    label: str
    model: PhysicsModel
    error: float
    """On held-out data."""
    per_state: dict[str, float]
    improved: str
    """In how many runs the error fell against the version before, ``4/4``; empty for the first ones."""
    values: dict[str, FittedValue]
    comparison: Comparison = field(repr=False)
    step: bytes = field(repr=False)
    """The step from which a search goes on, pickled; empty for a version that none goes on from."""


@dataclass(frozen=True)
class SearchResult:
    """What a search proposes after a version."""

    candidates: tuple[Candidate, ...]
    """The choice first, then by how well they predict."""
    choice: str | None
    unexplained: Unexplained | None
    next_experiment: Experiment | None
    settled: dict[str, SessionVersion]
    """The versions with the best candidates, by effect."""
    proposal: bytes = field(repr=False)


def opened(
    model: PhysicsModel, runs: Sequence[Run], horizon: float, report_progress: ReportProgress
) -> list[SessionVersion]:
    """The given model, and with free parameters the refitted one.

    Raises InputError for an unusable horizon or a model of another robot, RunError for unusable runs.
    """
    step = first_step(model, runs, horizon)
    report_progress(0.4)
    windows = step.shown.windows
    given = compare_for_page(model, runs, horizon)
    report_progress(0.8)
    error = rollout_error(model, windows)
    retained = pickle.dumps(step)
    free = bool(model.latent_names)
    first = SessionVersion(
        "given model", model, error.value, _named(error, step), "", {}, given, b"" if free else retained
    )
    if not free:
        return [first]
    return [first, _version("free numbers refitted", step, runs, horizon)]


def search(step: bytes, runs: Sequence[Run], horizon: float, report_progress: ReportProgress) -> SearchResult:
    """What may be missing after a version, the best candidates fitted to the end."""
    before: StepwiseModel = pickle.loads(step)
    found = proposal(before, lambda done, every: report_progress(0.7 * done / every))
    report_progress(0.75)
    candidates = _ordered(found)
    best = candidates[:_SETTLED]
    settled = {}
    for number, item in enumerate(best):
        settled[item.effect] = _added(before, found, item.effect, runs, horizon)
        report_progress(0.75 + 0.25 * (number + 1) / len(best))
    return SearchResult(
        candidates, found.choice, found.unexplained, found.next_experiment, settled, pickle.dumps(found)
    )


def add_candidate(
    step: bytes, proposed: bytes, name: str, runs: Sequence[Run], horizon: float, report_progress: ReportProgress
) -> SessionVersion:
    """The version with one candidate; raises InputError for a name that is none."""
    report_progress(0.1)
    return _added(pickle.loads(step), pickle.loads(proposed), name, runs, horizon)


def compare_for_page(model: PhysicsModel, runs: Sequence[Run], horizon: float) -> Comparison:
    """The comparison with as many windows as a page can draw."""
    seconds = sum(run.duration for run in runs)
    return compare_model(model, runs, horizon, every=max(EVERY, seconds / _MOST_WINDOWS))


def _added(
    before: StepwiseModel, found: RankedCandidates, name: str, runs: Sequence[Run], horizon: float
) -> SessionVersion:
    return _version(f"+ {name}", with_candidate(before, found, name), runs, horizon)


def _version(label: str, step: StepwiseModel, runs: Sequence[Run], horizon: float) -> SessionVersion:
    comparison = compare_for_page(step.model, runs, horizon)
    per_state = _named(step.error, step)
    retained = pickle.dumps(step)
    return SessionVersion(
        label, step.model, step.error.value, per_state, step.improved, step.values, comparison, retained
    )


def _named(error: RolloutError | Any, step: StepwiseModel) -> dict[str, float]:
    names = step.heldout.windows.system.state_names
    return {name: float(value) for name, value in zip(names, error.per_state, strict=True)}


def _ordered(found: RankedCandidates) -> tuple[Candidate, ...]:
    """The choice first, suspects next, each in the order of the search."""
    rank = {"accepted": 0, "suspected": 1, "rejected": 2}
    return tuple(sorted(found.candidates, key=lambda item: rank[item.decision]))
