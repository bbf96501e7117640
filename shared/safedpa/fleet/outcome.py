"""What a robot's report says, as far as a fleet compares it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from safedpa.effects import effects_of
from safedpa.errors import InputError

__all__ = ["EffectEvidence", "Number", "RobotOutcome", "neutral_of", "outcome_of"]

_BY_FILTER = 3.0
"""The filter's standard deviations count a third: it has to put a number 9 away from doing nothing where unseen blocks
have to gain 3 standard errors."""
_BLOCKS = 3.0
"""Standard errors above which unseen blocks decided."""


@dataclass(frozen=True)
class Number:
    """A fitted number with one standard deviation, NaN where it could not be told."""

    value: float
    std: float
    unit: str


@dataclass(frozen=True)
class EffectEvidence:
    """One effect in one robot: its numbers by name, and what unseen blocks say of it in standard errors."""

    effect: str
    numbers: Mapping[str, Number]
    score: float
    equals: tuple[str, ...] = ()
    """Effects that this robot's data cannot tell from it."""
    others: Mapping[str, EffectEvidence] | None = None
    """The same stage's candidates among ``equals``, by name."""


@dataclass(frozen=True)
class RobotOutcome:
    """One robot's diagnosis."""

    name: str
    status: str
    reason: str
    found: tuple[EffectEvidence, ...] = ()
    evidence: float = -math.inf
    """Of the weakest found effect, of the best candidate where none was found: standard errors on unseen blocks."""
    trials: int = 1
    """Candidates among which the best was chosen."""
    last: Mapping[str, EffectEvidence] | None = None
    """Every single effect in the last stage, next to all that was found."""
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
    """Files that could not be read next to those that could."""
    findings: int = 0
    """Messages about the data's quality."""

    @property
    def judged(self) -> bool:
        """Whether the data allowed a verdict."""
        return self.status == "diagnosed"


def outcome_of(result: Mapping[str, Any], report: Mapping[str, Any] | None) -> RobotOutcome:
    """The outcome of ``result.json`` and ``report.json``, which is None where there was nothing to diagnose."""
    costs = {name: float(result.get(name, 0.0)) for name in _COSTS}
    common = {"name": result["robot"], "status": result["status"], "reason": result["reason"], **costs}
    common["unread"] = len(result["unreadable_files"])
    if report is None:
        return RobotOutcome(**common)
    # where and when are a robot's own: a number that holds in one place is not pooled with one that holds everywhere
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
    """The value at which a parameter does nothing; None where it has none, or the effect is no longer known."""
    try:
        known = effects_of(robot).get(effect)
    except InputError:
        return None
    own = {item.name: item.neutral for item in known.parameters} if known is not None else {}
    return own.get(parameter)


def _found(name: str, report: Mapping[str, Any]) -> EffectEvidence:
    """An accepted effect with its final numbers; the candidate is the one that was accepted last."""
    own = [c for c in report["candidates"] if name in c["effect"].split(" + ") and c["decision"] == "accepted"]
    item = own[-1] if own else None
    numbers = {
        path.split(".")[1]: _number(value) for path, value in report["parameters"].items() if path.split(".")[0] == name
    }
    if item is None:  # it took the place of one that was accepted
        return EffectEvidence(name, numbers, math.inf)
    equals = tuple(other for other in item["indistinguishable_from"] if " + " not in other)
    same = [c for c in report["candidates"] if c["stage"] == item["stage"] and c["effect"] in equals]
    return EffectEvidence(name, numbers, _float(item["score"]), equals, {c["effect"]: _tried(c) for c in same})


def _last(report: Mapping[str, Any]) -> dict[str, EffectEvidence]:
    """Single effects of the last stage that were not added, in which nothing passed any more."""
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
    """Standard errors of unseen blocks where they decided; else those of the filter, a third of them."""
    if item.score > _BLOCKS:
        return item.score
    away = []
    for name, number in item.numbers.items():
        neutral = neutral_of(robot, item.effect, name)
        if neutral is not None and number.std > 0:
            away.append(abs(number.value - neutral) / number.std)
    return max([item.score, *(value / _BY_FILTER for value in away)])
