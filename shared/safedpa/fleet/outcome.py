"""The part of a robot's report that the fleet comparison uses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from safedpa.effects import effects_of
from safedpa.errors import InputError

# Weight of evidence from the Kalman filter: a value has to be 9 standard deviations from neutral, where unseen blocks
# have to gain 3 standard errors.
_BY_FILTER = 3.0
# Standard errors above which the unseen blocks were decisive.
_BLOCKS = 3.0


@dataclass(frozen=True)
class Number:
    """A fitted value with its standard deviation, NaN if unknown."""

    value: float
    std: float
    unit: str


@dataclass(frozen=True)
class EffectEvidence:
    """An effect in one robot: its parameter values, and the gain on unseen blocks in standard errors."""

    effect: str
    numbers: Mapping[str, Number]
    score: float
    equals: tuple[str, ...] = ()
    """Effects that this robot's data cannot distinguish from it."""
    others: Mapping[str, EffectEvidence] | None = None
    """The candidates of the same stage among ``equals``, by name."""


@dataclass(frozen=True)
class RobotOutcome:
    """The diagnosis of one robot."""

    name: str
    status: str
    reason: str
    found: tuple[EffectEvidence, ...] = ()
    evidence: float = -math.inf
    """Gain on unseen blocks in standard errors, of the weakest found effect or, without one, the best candidate."""
    trials: int = 1
    """Number of candidates among which the best was chosen."""
    last: Mapping[str, EffectEvidence] | None = None
    """All single effects of the last stage, in addition to those found."""
    free: Mapping[str, Number] | None = None
    """Refitted parameters of the given model, by path."""
    error_before: float = math.nan
    error_after: float = math.nan
    unexplained: str = ""
    depends_on: tuple[str, ...] = ()
    measured_seconds: float = 0.0
    processor_seconds: float = 0.0
    memory_mebibytes: float = 0.0
    unread: int = 0
    """Number of unreadable files."""
    findings: int = 0
    """Number of messages about the data's quality."""

    @property
    def judged(self) -> bool:
        """Whether the data allowed a verdict."""
        return self.status == "diagnosed"


def outcome_of(result: Mapping[str, Any], report: Mapping[str, Any] | None) -> RobotOutcome:
    """Returns the outcome from ``result.json`` and ``report.json`` (None without a diagnosis)."""
    costs = {name: float(result.get(name, 0.0)) for name in _COSTS}
    common = {"name": result["robot"], "status": result["status"], "reason": result["reason"], **costs}
    common["unread"] = len(result["unreadable_files"])
    if report is None:
        return RobotOutcome(**common)
    # Conditions (where, when) are specific to a robot. A value that is valid in one region is not pooled with one that
    # is valid everywhere.
    laws = {item["effect"]: item for item in report.get("conditions") or ()}
    every = set(report["added"])
    added = tuple(name for name in report["added"] if name not in laws)
    found = tuple(_found(name, report) for name in added)
    rest = report["unexplained"] or {}
    unexplained = [rest["expression"]] if rest.get("depends_on") else []
    last = _last(report)
    best = max((item["score"] for item in report["candidates"] if item["score"] is not None), default=-math.inf)
    return RobotOutcome(
        **common,
        found=found,
        evidence=min((_evidence(item, report["robot"]) for item in found), default=best),
        trials=max(1, sum(item["stage"] == 0 for item in report["candidates"])),
        last=last,
        free={path: _number(item) for path, item in report["parameters"].items() if path.split(".")[0] not in every},
        error_before=_float(report["stages"][0]["heldout_error"]),
        error_after=_float(report["stages"][-1]["heldout_error"]),
        unexplained="; ".join([item["sentence"] for item in laws.values()] + unexplained),
        depends_on=tuple(rest.get("depends_on", ())),
        findings=len({item["message"] for item in report["data_quality"]}),
    )


_COSTS = ("measured_seconds", "processor_seconds", "memory_mebibytes")


def neutral_of(robot: str, effect: str, parameter: str) -> float | None:
    """Returns the value at which a parameter has no effect; None if it has none or the effect is unknown."""
    try:
        known = effects_of(robot).get(effect)
    except InputError:
        return None
    own = {item.name: item.neutral for item in known.parameters} if known is not None else {}
    return own.get(parameter)


def _found(name: str, report: Mapping[str, Any]) -> EffectEvidence:
    """Returns an accepted effect with its final values; the candidate is the one accepted last."""
    own = [c for c in report["candidates"] if name in c["effect"].split(" + ") and c["decision"] == "accepted"]
    item = own[-1] if own else None
    numbers = {
        path.split(".")[1]: _number(value) for path, value in report["parameters"].items() if path.split(".")[0] == name
    }
    if item is None:  # it replaced an accepted effect and was no candidate itself
        return EffectEvidence(name, numbers, math.inf)
    equals = tuple(other for other in item["indistinguishable_from"] if " + " not in other)
    same = [c for c in report["candidates"] if c["stage"] == item["stage"] and c["effect"] in equals]
    return EffectEvidence(name, numbers, _float(item["score"]), equals, {c["effect"]: _tried(c) for c in same})


def _last(report: Mapping[str, Any]) -> dict[str, EffectEvidence]:
    """Returns the single effects of the last stage, in which none was accepted."""
    every = [item for item in report["candidates"] if " + " not in item["effect"]]
    stage = max((item["stage"] for item in every), default=0)
    return {i["effect"]: _tried(i) for i in every if i["stage"] == stage and i["decision"] != "accepted"}


def _tried(item: Mapping[str, Any]) -> EffectEvidence:
    numbers = {name: _number(value) for name, value in item["parameters"].items()}
    return EffectEvidence(item["effect"], numbers, _float(item["score"]), tuple(item["indistinguishable_from"]))


def _number(item: Mapping[str, Any]) -> Number:
    return Number(_float(item["value"]), _float(item["std"]), str(item["unit"]))


def _float(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _evidence(item: EffectEvidence, robot: str) -> float:
    """Returns the gain on unseen blocks in standard errors if decisive, else a third of the filter's evidence."""
    if item.score > _BLOCKS:
        return item.score
    away = []
    for name, number in item.numbers.items():
        neutral = neutral_of(robot, item.effect, name)
        if neutral is not None and number.std > 0:
            away.append(abs(number.value - neutral) / number.std)
    return max([item.score, *(value / _BY_FILTER for value in away)])
