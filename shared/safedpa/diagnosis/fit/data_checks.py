"""Checks whether recordings allow a verdict about physics, and prepares the runs that the diagnosis uses."""

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

MOST_ROWS = 40_000
"""Rows used at most; longer recordings are thinned to evenly spread pieces."""
# A wrong column, sign or unit looks like a missing effect and is larger than any real one, so no verdict is given.
_SEVERE = (
    "swapped_columns", "opposite_sign", "unit_mistake", "yaw_inconsistent", "steer_inconsistent", "time_offset",
)  # fmt: skip


@dataclass(frozen=True)
class PreparedRuns:
    """The runs that are used, the findings about them, and the horizon [s] on which the search decides."""

    runs: list[Run]
    quality: list[dict[str, Any]]
    seconds: float


def prepare_runs(model: PhysicsModel, runs: Sequence[Run], most_rows: int = MOST_ROWS) -> PreparedRuns:
    """Returns the usable runs, each recording once, thinned to ``most_rows`` in evenly spread pieces.

    Raises InputError for a model of another robot, RunError for unusable runs.
    """
    quality = [finding_row(run.name, finding) for run in runs for finding in run.findings]
    # The same recording given twice would put copies on both sides of the cross-validation.
    once, repeated = without_duplicates(runs)
    quality += [finding_row(name, finding) for name, finding in repeated]
    # The horizon comes before thinning: pieces have to be at least one window long.
    seconds = select_horizon(model, once)
    rows = sum(len(part) for run in once for part in run.stretches)
    used = subsample_runs(once, most_rows, seconds)
    if rows > most_rows:
        retained = sum(len(part) for run in used for part in run.stretches)
        message = f"of {rows} rows, {retained} in evenly spread pieces were used for fitting and judging"
        quality.append(finding_row("all", Finding("thinned", message, rows - retained)))
    for run in used:
        quality += [finding_row(run.name, item) for item in _constant_inputs(run)]
    return PreparedRuns(used, quality, seconds)


def _constant_inputs(run: Run) -> list[Finding]:
    """Reports inputs that never change: effects on them cannot be identified."""
    actions = np.concatenate([part for _, _, part in run.parts()])
    known = {finding.kind for finding in run.findings}
    if "constant_input" in known or not len(actions):
        return []
    # 1e-9 allows for rounding of a stored constant, in any unit.
    constant = [v.name for v, size in zip(run.system.action, np.ptp(actions, axis=0), strict=True) if size < 1e-9]
    message = f"{', '.join(constant)} never changes: effects on it cannot be distinguished from constants"
    return [Finding("constant_input", message, len(actions))] if constant else []


def finding_row(run: str, finding: Finding) -> dict[str, Any]:
    """Returns a finding as a row of the report."""
    return {"run": run, **vars(finding)}


@dataclass(frozen=True)
class DataSufficiency:
    """Whether the data allow a verdict about physics."""

    why_not: str
    """Empty if they do."""
    wrong: bool
    """Whether the data contradict their own description (columns, signs, units), rather than being too few."""

    @property
    def enough(self) -> bool:
        """Whether a verdict is possible."""
        return not self.why_not


def check_data_sufficiency(shooting: Shooting, used: Sequence[Run], runs: Sequence[Run]) -> DataSufficiency:
    """Decides whether the data allow a verdict about physics; ``used`` are the prepared ones of ``runs``."""
    # Wrong columns are reported first: more data of the same kind would not help.
    wrong = _severe_finding(runs)
    return DataSufficiency(wrong, True) if wrong else DataSufficiency(_insufficient_data(shooting, used), False)


def _insufficient_data(shooting: Shooting, runs: Sequence[Run]) -> str:
    """Returns why the data are too few to judge any effect; empty if they suffice."""
    seconds, each = sum(run.duration for run in runs), shooting.windows.horizon
    if len(shooting.windows) < FEWEST_WINDOWS or seconds < FEWEST_SECONDS:
        return (
            f"{seconds:.1f} s in {len(shooting.windows)} independent windows of {each:.3g} s are too little to judge "
            f"an effect; record at least {recommended_recording(each)}"
        )
    actions = np.concatenate([part for run in runs for _, _, part in run.parts()])
    if actions.shape[1] and (np.ptp(actions, axis=0) < 1e-9).all():
        return "no input ever changes: no effect can be identified from a constant; record a drive with steps in it"
    return ""


def _severe_finding(runs: Sequence[Run]) -> str:
    """Returns the first severe finding as text; empty if there is none."""
    found = [f"{run.name}: {item.message}" for run in runs for item in run.findings if item.kind in _SEVERE]
    return found[0] if found else ""
