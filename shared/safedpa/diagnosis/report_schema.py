"""Data classes of a diagnosis report: the contents of report.json.

Read ``Report`` first, at the end. ``Unexplained`` and the classes before it describe structure that no effect of the
library explains.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from safedpa.comparison.summary import as_plain
from safedpa.dynamics import PhysicsModel
from safedpa.result import one_line

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
    "Remainder",
    "Report",
    "Unexplained",
    "Verdict",
    "WorsenedState",
    "as_document",
]


@dataclass(frozen=True)
class FormulaTerm:
    """One term of a formula: d(state)/dt += coefficient term."""

    state: str
    term: str
    coefficient: float
    std: float | None
    """One standard deviation."""
    unit: str


@dataclass(frozen=True)
class Dependence:
    """How much of the residual a function of one variable explains, predicted on unseen blocks."""

    variable: str
    state: str
    """The state whose rate is incomplete."""
    share: float
    """Share of the squares of the residual, noise included."""
    standard_errors: float
    """Gain in standard errors over independent blocks of time."""


@dataclass(frozen=True)
class Profile:
    """The function of one variable that the rate of a state lacks, as values at knots with straight lines between."""

    variable: str
    unit: str
    state: str
    rate_unit: str
    knots: tuple[float, ...]
    values: tuple[float, ...]
    errors: tuple[float, ...]
    """One standard deviation of each value."""
    formula: tuple[float, ...] | None
    """The formula at the knots; None if it depends on other variables too."""
    rows: tuple[int, ...] = ()
    """Measured rows closest to each knot."""


@dataclass(frozen=True)
class RateMap:
    """Mean missing rate in cells of two variables; rows run upwards, None for cells with too few windows."""

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
    """Structure of the residual that no effect of the library explains."""

    depends_on: tuple[str, ...]
    expression: str
    """A formula that fits, not an effect; if nothing could be judged, the reason."""
    share: float
    """Share of the remaining squared error."""
    kind: Literal["place", "formula", "dependence", "no_verdict"] = "no_verdict"
    terms: tuple[FormulaTerm, ...] = ()
    alternatives: tuple[str, ...] = ()
    """Terms that unseen blocks cannot distinguish from the formula's first term."""
    dependence: tuple[Dependence, ...] = ()
    """Every variable that was tried, the one with the largest share first."""
    profile: Profile | None = None
    map: RateMap | None = None


Verdict = Literal["nothing_missing", "effect_missing", "unexplained", "undecided"]
Decision = Literal["accepted", "suspected", "rejected"]


@dataclass(frozen=True)
class FittedValue:
    """A fitted value, one standard deviation (None if unknown) and its unit."""

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
    """In how many runs the error fell compared with the stage before, such as ``9/9``; empty for the first."""


@dataclass(frozen=True)
class WorsenedState:
    """A state that a stage predicts worse in one run than the given model does."""

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
    """Name of the effect; pairs are joined with a plus sign."""
    parameters: dict[str, FittedValue]
    heldout_error: float | None
    score: float | None
    """Held-out gain in standard errors of independent time blocks; larger is better."""
    indistinguishable_from: tuple[str, ...]
    decision: Decision
    reason: str


@dataclass(frozen=True)
class Experiment:
    """The manoeuvre that would separate what these data cannot."""

    manoeuvre: str
    separates: tuple[str, ...]
    why: str


@dataclass(frozen=True)
class PossibleEffect:
    """An effect that may be missing, but that the data do not confirm."""

    effect: str
    parameters: dict[str, FittedValue]
    """By path."""
    heldout_fall: float | None
    """Relative reduction of the held-out error at the search's own horizon."""
    score: float
    """Held-out gain in standard errors of independent time blocks."""
    smallest_detectable: dict[str, FittedValue]
    """By path: the change from the neutral value that these recordings would have shown."""
    drive: str
    """The manoeuvre that would decide; empty if none of the list does."""
    reason: str


@dataclass(frozen=True)
class Detectable:
    """Detectability of one parameter of an effect that the model lacks, in these recordings."""

    effect: str
    parameter: str
    unit: str
    smallest: float | None
    """Smallest change from the neutral value that is found with 95 % power; None if there is none within bounds."""
    ordinary: float
    """The typical change."""
    only_with: tuple[str, ...]
    """Effects or free parameters that displace the predictions in the same way: only their sum is identifiable."""
    drive: str = ""
    """The manoeuvre that shows it best, if these recordings do not show a typical size."""

    @property
    def shown(self) -> bool:
        """Whether a typical size would have been found."""
        return self.smallest is not None and self.smallest <= self.ordinary


@dataclass(frozen=True)
class Condition:
    """Where or when an added effect acts, or how a parameter of it varies."""

    effect: str
    kind: str
    """``where`` or ``varies``."""
    phrase: str
    """The law as in model files and ``safedpa add``: ``x above``, ``gain with time``."""
    edge: float | None
    """Width over which a condition sets in, in the unit of its variable; None for ``varies``."""
    sentence: str


@dataclass(frozen=True)
class CoverageGap:
    """A part of a variable's range with less than one block of recorded time."""

    low: float
    high: float
    seconds: float
    """Recorded time there [s]."""


@dataclass(frozen=True)
class CoveredRange:
    """The range of a state or action that the recordings cover, and the gaps in it."""

    variable: str
    unit: str
    low: float
    high: float
    seconds: float
    """Length of all recordings [s]."""
    gaps: tuple[CoverageGap, ...]


@dataclass(frozen=True)
class Remainder:
    """What the last model leaves of unseen data: noise and disturbance, or something that depends on the drive."""

    share: float
    """Share of the residual's squares, noise included, that a function of states, actions, past actions and time
    predicts."""
    standard_errors: float
    """Gain of that function in standard errors over independent blocks."""
    spread: float
    """Ratio of the residual's mean squares in windows with large and small values of ``spread_of``."""
    spread_of: str
    spread_errors: float
    """Difference of these mean squares in standard errors."""
    noise_share: float
    """Share of the squares that measurement noise explains, estimated from these recordings."""
    state: str = ""
    """State with the largest significant share of its own; empty if no state has one."""
    state_share: float = 0.0
    """Share of the squares of that state that depends on the drive."""
    state_errors: float = 0.0
    """Its standard errors over independent blocks."""
    noise_by_state: tuple[float, ...] = ()
    """``noise_share`` of each state."""
    persistence_by_state: tuple[float, ...] = ()
    """Correlation of each state's residual from one compared row to the next: near 1 for motion that is missing."""
    sentence: str = ""
    """Size and place of what neither noise nor a disturbance from outside explains; empty if they explain it."""


@dataclass(frozen=True, repr=False)
class Report:
    """The result of a diagnosis; ``models`` are those of the stages, the given one (refitted) first."""

    robot: str
    horizon: float
    """Horizon of the displayed errors [s]."""
    verdict: Verdict
    added: tuple[str, ...]
    stages: tuple[DiagnosisStage, ...]
    candidates: tuple[Candidate, ...]
    where: tuple[dict[str, Any], ...]
    unexplained: Unexplained | None
    next_experiment: Experiment | None
    data_quality: tuple[dict[str, Any], ...]
    parameters: dict[str, FittedValue]
    """Fitted parameters of the last model by path, including free ones of the base."""
    models: tuple[PhysicsModel, ...] = field(repr=False)
    closest: tuple[PossibleEffect, ...] = ()
    """Effects that come closest if the data are not sure, best first: "likely, not proven"."""
    detectable: tuple[Detectable, ...] = ()
    """For each parameter of each effect that the model lacks, the smallest change that would have been found."""
    naive: dict[str, float] = field(default_factory=dict)
    """Errors of naive predictions after the horizon: "no_change" and "constant_velocity"."""
    worse: tuple[WorsenedState, ...] = ()
    """States that the last stage predicts worse in some run than the given model, the worst first."""
    conditions: tuple[Condition, ...] = ()
    """Laws of added effects that act only in a region or vary."""
    evidence: tuple[float, ...] = ()
    """Horizons of the search [s], which the data determine; the main one first."""
    coverage: tuple[CoveredRange, ...] = ()
    """Covered range of each state and action; outside it the model extrapolates."""
    tried: tuple[int, int] = (0, 0)
    """How many effects, and how many combinations of them, were fitted."""
    uncertain: tuple[str, ...] = ()
    """Added effects that are within two deviations of no effect."""
    remainder: Remainder | None = None
    """None if the recordings are too short to judge what remains."""

    def __repr__(self) -> str:
        facts = {"robot": self.robot, "verdict": self.verdict, "added": ", ".join(self.added) or "nothing"}
        return one_line("Report", {**facts, "stages": len(self.stages), "candidates": len(self.candidates)})


def as_document(report: Report) -> dict[str, Any]:
    """Returns the document of report.json; values that are not finite become null."""
    # An explicit list: the file format is a contract, and ``models`` and private fields are not part of it.
    names = (
        "robot", "horizon", "verdict", "added", "stages", "candidates", "where", "unexplained", "next_experiment",
        "data_quality", "parameters", "closest", "detectable", "naive", "worse", "evidence",
        "conditions", "coverage", "tried", "uncertain", "remainder",
    )  # fmt: skip
    return {"format": 1, **{name: as_plain(getattr(report, name)) for name in names}}
