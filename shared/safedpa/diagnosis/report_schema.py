"""What a diagnosis found, as plain data: the contents of report.json.

What no effect of the library explains, as plain data: on what it depends, a map of it, a formula that fits.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from safedpa.dynamics import PhysicsModel

__all__ = [
    "Candidate",
    "Condition",
    "CoverageGap",
    "CoveredRange",
    "Decision",
    "Dependence",
    "Detectable",
    "DiagnosisStage",
    "Experiment",
    "FittedValue",
    "FormulaTerm",
    "PossibleEffect",
    "Profile",
    "RateMap",
    "Report",
    "Unexplained",
    "Verdict",
    "WorsenedState",
    "as_document",
]


@dataclass(frozen=True)
class FormulaTerm:
    """d(state)/dt += coefficient term."""

    state: str
    term: str
    coefficient: float
    std: float | None
    """One standard deviation."""
    unit: str


@dataclass(frozen=True)
class Dependence:
    """How much of what remains any function of one variable tells, fitted without the blocks that it predicts."""

    variable: str
    state: str
    """Whose rate remains."""
    share: float
    """Of the squares of the residual, noise included."""
    standard_errors: float
    """Of that gain, over independent blocks of time."""


@dataclass(frozen=True)
class Profile:
    """The function of one variable that the rate of a state lacks, by its values at some knots, straight between."""

    variable: str
    unit: str
    state: str
    rate_unit: str
    knots: tuple[float, ...]
    values: tuple[float, ...]
    errors: tuple[float, ...]
    """One standard deviation of each value."""
    formula: tuple[float, ...] | None
    """What the formula gives at the knots, where it depends on this variable alone."""
    rows: tuple[int, ...] = ()
    """Measured rows between the neighbours of each knot."""


@dataclass(frozen=True)
class RateMap:
    """Mean remaining rate in cells of two variables; rows go up, None where a cell has too few windows."""

    across: str
    across_unit: str
    up: str
    up_unit: str
    state: str
    rate_unit: str
    across_edges: tuple[float, ...]
    up_edges: tuple[float, ...]
    means: tuple[tuple[float | None, ...], ...]
    windows: tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class Unexplained:
    """Structure of what remains that no effect of the library has."""

    depends_on: tuple[str, ...]
    expression: str
    """A formula that fits, not an effect; where nothing could be judged, why not."""
    share: float
    """Of the remaining squared error."""
    kind: Literal["place", "formula", "dependence", "no_verdict"] = "no_verdict"
    terms: tuple[FormulaTerm, ...] = ()
    alternatives: tuple[str, ...] = ()
    """Terms that unseen blocks cannot tell from the formula's first."""
    dependence: tuple[Dependence, ...] = ()
    """Every variable that was looked at, the one that tells most first."""
    profile: Profile | None = None
    map: RateMap | None = None


Verdict = Literal["nothing_missing", "effect_missing", "unexplained", "undecided"]
Decision = Literal["accepted", "suspected", "rejected"]


@dataclass(frozen=True)
class FittedValue:
    """A fitted number, one standard deviation (None where it could not be told) and its unit."""

    value: float
    std: float | None
    unit: str


@dataclass(frozen=True)
class DiagnosisStage:
    """The model after an addition: its effects and its error on data that was not used for fitting."""

    effects: tuple[str, ...]
    heldout_error: float
    per_state: dict[str, float]
    runs_improved: str
    """In how many runs the error fell against the stage before: ``9/9``; empty for the first."""


@dataclass(frozen=True)
class WorsenedState:
    """A state that a stage predicts worse in one run than the given model does, whatever the mean says."""

    stage: int
    run: str
    state: str
    before: float
    after: float


@dataclass(frozen=True)
class Candidate:
    """One effect on trial at one stage."""

    stage: int
    effect: str
    """Pairs are named with a plus sign between them."""
    parameters: dict[str, FittedValue]
    heldout_error: float | None
    score: float | None
    """Held-out gain in standard errors of independent time blocks; larger is better."""
    indistinguishable_from: tuple[str, ...]
    decision: Decision
    reason: str


@dataclass(frozen=True)
class Experiment:
    """The manoeuvre that would tell apart what this data cannot."""

    manoeuvre: str
    separates: tuple[str, ...]
    why: str


@dataclass(frozen=True)
class PossibleEffect:
    """An effect that may be missing, but of which the data are not sure."""

    effect: str
    parameters: dict[str, FittedValue]
    """By path."""
    heldout_fall: float | None
    """Share that it would take off the held-out error at the search's own horizon."""
    score: float
    """Held-out gain in standard errors of independent time blocks."""
    smallest_detectable: dict[str, FittedValue]
    """By path: the change from doing nothing that these logs would have shown."""
    drive: str
    """What to drive to know; empty where no manoeuvre of the list tells."""
    reason: str


@dataclass(frozen=True)
class Detectable:
    """What these logs could show of one parameter of an effect that the model lacks."""

    effect: str
    parameter: str
    unit: str
    smallest: float | None
    """Change from doing nothing that would have been found with 95 % power cases; None: none within bounds."""
    ordinary: float
    """The change that is ordinary."""
    only_with: tuple[str, ...]
    """Effects or free numbers that displace the predictions in the same way: only their sum can be told."""
    drive: str = ""
    """The manoeuvre that shows it most, where these logs do not show an ordinary size."""

    @property
    def shown(self) -> bool:
        """Whether an ordinary size would have been found."""
        return self.smallest is not None and self.smallest <= self.ordinary


@dataclass(frozen=True)
class Condition:
    """Where or when an added effect acts, or how a number of it varies."""

    effect: str
    kind: str
    """``where`` or ``varies``."""
    phrase: str
    """As model files and ``safedpa add`` have it: ``x above``, ``gain with time``."""
    edge: float | None
    """Width over which a condition sets in, in the unit of its variable; None of what varies."""
    sentence: str


@dataclass(frozen=True)
class CoverageGap:
    """A part of a variable's range in which the recordings hold less than a block of time."""

    low: float
    high: float
    seconds: float
    """That were driven there."""


@dataclass(frozen=True)
class CoveredRange:
    """The range of a state or action that the recordings hold, and what of it they hardly hold."""

    variable: str
    unit: str
    low: float
    high: float
    seconds: float
    """Of all recordings."""
    gaps: tuple[CoverageGap, ...]


@dataclass(frozen=True)
class Report:
    """Everything that a diagnosis found; ``models`` are those of the stages, the given one (refitted) first."""

    robot: str
    horizon: float
    """s"""
    verdict: Verdict
    added: tuple[str, ...]
    stages: tuple[DiagnosisStage, ...]
    candidates: tuple[Candidate, ...]
    where: tuple[dict[str, Any], ...]
    unexplained: Unexplained | None
    next_experiment: Experiment | None
    data_quality: tuple[dict[str, Any], ...]
    parameters: dict[str, FittedValue]
    """Fitted numbers of the last model, by path, the base's free ones as well."""
    models: tuple[PhysicsModel, ...] = field(repr=False)
    closest: tuple[PossibleEffect, ...] = ()
    """Where the data are not sure: the effects that come closest, the best first; "likely, not proven"."""
    detectable: tuple[Detectable, ...] = ()
    """For each number of each effect that the model lacks the smallest change that these logs would have shown."""
    naive: dict[str, float] = field(default_factory=dict)
    """Errors of what knows no physics, after the horizon: "no_change" and "constant_velocity"."""
    worse: tuple[WorsenedState, ...] = ()
    """States that the last stage predicts worse in a run than the given model, the worst first."""
    conditions: tuple[Condition, ...] = ()
    """Of added effects that do not act everywhere and always alike."""
    evidence: tuple[float, ...] = ()
    """s; the horizons at which was decided, the search's own first: they follow from the data."""
    coverage: tuple[CoveredRange, ...] = ()
    """What was driven of each state and action: elsewhere the last model is extrapolated."""


def as_document(report: Report) -> dict[str, Any]:
    """The document that stands in report.json; numbers that are not finite are null."""
    plain: dict[str, Any] = {"format": 1}
    for name in (
        "robot", "horizon", "verdict", "added", "stages", "candidates", "where", "unexplained", "next_experiment",
        "data_quality", "parameters", "closest", "detectable", "naive", "worse", "evidence",
        "conditions", "coverage",
    ):  # fmt: skip
        plain[name] = _plain(getattr(report, name))
    return plain


def _plain(value: Any) -> Any:
    if hasattr(value, "__dataclass_fields__"):
        return _plain(asdict(value))
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    if isinstance(value, bool) or not hasattr(value, "__float__"):
        return value
    number = int(value) if hasattr(value, "__index__") else float(value)
    return number if math.isfinite(number) else None
