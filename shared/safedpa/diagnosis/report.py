"""What a diagnosis found, as plain data: the contents of report.json."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from safedpa.diagnosis.unexplained import Unexplained
from safedpa.dynamics import PhysicsModel

__all__ = ["Candidate", "Decision", "Experiment", "Report", "Stage", "Unexplained", "Value", "Verdict", "as_document"]

Verdict = Literal["nothing_missing", "effect_missing", "unexplained"]
Decision = Literal["accepted", "suspected", "rejected"]


@dataclass(frozen=True)
class Value:
    """A fitted number, one standard deviation (None where it could not be told) and its unit."""

    value: float
    std: float | None
    unit: str


@dataclass(frozen=True)
class Stage:
    """The model after an addition: its effects and its error on data that was not used for fitting."""

    effects: tuple[str, ...]
    heldout_error: float
    per_state: dict[str, float]
    runs_improved: str
    """In how many runs the error fell against the stage before: ``9/9``; empty for the first."""


@dataclass(frozen=True)
class Candidate:
    """One effect on trial at one stage."""

    stage: int
    effect: str
    """Pairs are named with a plus sign between them."""
    parameters: dict[str, Value]
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
class Report:
    """Everything that a diagnosis found; ``models`` are those of the stages, the given one (refitted) first."""

    robot: str
    horizon: float
    """s"""
    verdict: Verdict
    added: tuple[str, ...]
    stages: tuple[Stage, ...]
    candidates: tuple[Candidate, ...]
    where: tuple[dict[str, Any], ...]
    unexplained: Unexplained | None
    next_experiment: Experiment | None
    data_quality: tuple[dict[str, Any], ...]
    parameters: dict[str, Value]
    """Fitted numbers of the last model, by path, the base's free ones as well."""
    models: tuple[PhysicsModel, ...] = field(repr=False)


def as_document(report: Report) -> dict[str, Any]:
    """The document that stands in report.json; numbers that are not finite are null."""
    plain: dict[str, Any] = {"format": 1}
    for name in (
        "robot", "horizon", "verdict", "added", "stages", "candidates", "where", "unexplained", "next_experiment",
        "data_quality", "parameters",
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
