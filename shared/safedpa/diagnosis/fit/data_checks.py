"""Whether recordings allow a verdict about physics: what is used of them, what is said, and what is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from safedpa.comparison.excerpt import subsample_runs, without_duplicates
from safedpa.diagnosis.fit.horizon import FEWEST_SECONDS, FEWEST_WINDOWS, recommended_recording, select_horizon
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.dynamics import PhysicsModel
from safedpa.records.run import Finding, Run

__all__ = ["MOST_ROWS", "DataSufficiency", "PreparedRuns", "check_data_sufficiency", "finding_row", "prepare_runs"]

MOST_ROWS = 40_000
"""Of longer logs evenly spread pieces are used."""
_SEVERE = (
    "swapped_columns", "opposite_sign", "unit_mistake", "yaw_inconsistent", "steer_inconsistent", "time_offset",
)  # fmt: skip
"""Findings with which no verdict about physics is possible."""


@dataclass(frozen=True)
class PreparedRuns:
    """What is used of recordings, what is said about them, and the horizon [s] at which they decide."""

    runs: list[Run]
    quality: list[dict[str, Any]]
    seconds: float


def prepare_runs(model: PhysicsModel, runs: Sequence[Run], most_rows: int = MOST_ROWS) -> PreparedRuns:
    """Runs that can be used, each recording once, thinned to ``most_rows`` in evenly spread pieces.

    Raises InputError for a model of another robot, RunError for unusable runs.
    """
    quality = [finding_row(run.name, finding) for run in runs for finding in run.findings]
    once, repeated = without_duplicates(runs)
    quality += [finding_row(name, finding) for name, finding in repeated]
    seconds = select_horizon(model, once)
    rows = sum(len(part) for run in once for part in run.stretches)
    used = subsample_runs(once, most_rows, seconds)
    if rows > most_rows:
        retained = sum(len(part) for run in used for part in run.stretches)
        message = f"of {rows} rows, {retained} in evenly spread pieces were used for fitting and judging"
        quality.append(finding_row("all", Finding("thinned", message, rows - retained)))
    for run in used:
        quality += [finding_row(run.name, item) for item in _inputs(run)]
    return PreparedRuns(used, quality, seconds)


def _inputs(run: Run) -> list[Finding]:
    """Inputs that never change say nothing about what they do."""
    actions = np.concatenate([part for _, _, part in run.parts()])
    known = {finding.kind for finding in run.findings}
    if "constant_input" in known or not len(actions):
        return []
    still = [v.name for v, size in zip(run.system.action, np.ptp(actions, axis=0), strict=True) if size < 1e-9]
    message = f"{', '.join(still)} never changes: effects on it cannot be told from constants"
    return [Finding("constant_input", message, len(actions))] if still else []


def finding_row(run: str, finding: Finding) -> dict[str, Any]:
    """A finding as the report lists it."""
    return {"run": run, **vars(finding)}


@dataclass(frozen=True)
class DataSufficiency:
    """Whether the data allow a verdict about physics."""

    why_not: str
    """Empty where they do."""
    wrong: bool
    """They are something else than they say, rather than too few or too uniform."""

    @property
    def enough(self) -> bool:
        """They do."""
        return not self.why_not


def check_data_sufficiency(shooting: Shooting, used: Sequence[Run], runs: Sequence[Run]) -> DataSufficiency:
    """Whether the data allow a verdict about physics, and why not: ``used`` is what was taken of ``runs``."""
    wrong = _wrong(runs)
    return DataSufficiency(wrong, True) if wrong else DataSufficiency(_too_few(shooting, used), False)


def _too_few(shooting: Shooting, runs: Sequence[Run]) -> str:
    """Why there is too little to judge anything; empty where there is enough."""
    seconds, each = sum(run.duration for run in runs), shooting.windows.horizon
    if len(shooting.windows) < FEWEST_WINDOWS or seconds < FEWEST_SECONDS:
        return (
            f"{seconds:.1f} s in {len(shooting.windows)} independent windows of {each:.3g} s are too little to judge "
            f"an effect; record at least {recommended_recording(each)}"
        )
    actions = np.concatenate([part for run in runs for _, _, part in run.parts()])
    if actions.shape[1] and (np.ptp(actions, axis=0) < 1e-9).all():
        return "no input ever changes: nothing can be told from a constant; record a drive with steps in it"
    return ""


def _wrong(runs: Sequence[Run]) -> str:
    """What makes recordings something else than they say, empty where nothing does."""
    found = [f"{run.name}: {item.message}" for run in runs for item in run.findings if item.kind in _SEVERE]
    return found[0] if found else ""
