"""Analysis of a fleet's diagnosis, and the contents of fleet.json."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from safedpa.fleet.common import Confirmation, FleetEffect, common_effects, together_effects
from safedpa.fleet.outcome import RobotOutcome
from safedpa.fleet.pooled_evidence import (
    FALSE_SHARE,
    PooledEvidence,
    believed,
    chance,
    evidence_over,
    pooled_number,
    pooled_numbers,
)
from safedpa.fleet.similar_robots import Group, same_effects, with_one_name

# Robust standard deviations of log(error) from which a robot is an outlier, and the minimum ratio to the fleet's error.
_ODD = 5.0
_ODD_RATIO = 1.5
# Number of effects whose pooled evidence is reported.
_POOLED = 8

ORDER = ("missing", "unexplained", "suspected", "nothing", "no_verdict", "unreadable", "failed")
"""Kinds of groups in the order of the report."""


@dataclass(frozen=True)
class Analysis:
    """The complete comparison of a fleet."""

    robot: str
    """Kind of robot."""
    outcomes: tuple[RobotOutcome, ...]
    groups: tuple[Group, ...]
    chances: Mapping[str, float]
    limit: float
    common: tuple[FleetEffect, ...]
    together: tuple[FleetEffect, ...]
    """Effects with evidence only over all robots together; one of them may be common to all."""
    evidence: tuple[PooledEvidence, ...]
    odd: tuple[tuple[str, float], ...]
    """Outliers: robots with a much larger error than the others, even with the effects found, and the ratio."""


def analyse_fleet(outcomes: Sequence[RobotOutcome], robot: str) -> Analysis:
    """Computes groups, false discoveries, pooled evidence and outliers of a fleet."""
    named = with_one_name(sorted(outcomes, key=lambda item: item.name))
    judged = [item for item in named if item.judged]
    chances = {i.name: chance(i.evidence, i.trials) if i.found else 1.0 for i in judged}
    significant, limit = believed([chances[item.name] for item in judged])
    sure = {item.name for item, well in zip(judged, significant, strict=True) if well}
    evidence = evidence_over(judged)
    groups = _groups(named, sure, robot)
    common = common_effects(judged, robot)
    taken = {item.effect for item in common}
    together = [item for item in together_effects(judged, evidence) if item.effect not in taken]
    return Analysis(
        robot=robot,
        outcomes=tuple(named),
        groups=groups,
        chances=chances,
        limit=limit,
        common=tuple(common),
        together=tuple(together),
        evidence=tuple(evidence[:_POOLED]),
        odd=_odd(judged),
    )


def _groups(outcomes: Sequence[RobotOutcome], sure: set[str], robot: str) -> tuple[Group, ...]:
    missing = [item for item in outcomes if item.judged and item.found]
    groups = same_effects([item for item in missing if item.name in sure], robot)
    groups += same_effects([item for item in missing if item.name not in sure], robot, "suspected")
    groups += _by_text("unexplained", [i for i in outcomes if i.judged and not i.found and i.unexplained])
    nothing = tuple(i for i in outcomes if i.judged and not i.found and not i.unexplained)
    groups += [Group("nothing", nothing)] if nothing else []
    for kind in ("no_verdict", "unreadable", "failed"):
        own = tuple(item for item in outcomes if item.status == kind)
        groups += [Group(kind, own)] if own else []
    return tuple(sorted(groups, key=lambda group: ORDER.index(group.kind)))


def _by_text(kind: str, outcomes: Sequence[RobotOutcome]) -> list[Group]:
    """Returns one group for each set of variables on which the unexplained error depends."""
    sets: dict[tuple[str, ...], list[RobotOutcome]] = {}
    for outcome in outcomes:
        sets.setdefault(tuple(sorted(outcome.depends_on)), []).append(outcome)
    return [Group(kind, tuple(own), reason=f"depends on {' and '.join(names)}") for names, own in sets.items()]


def _odd(judged: Sequence[RobotOutcome]) -> tuple[tuple[str, float], ...]:
    known = [item for item in judged if item.error_after > 0 and math.isfinite(item.error_after)]
    if len(known) < 8:
        return ()
    logs = np.log([item.error_after for item in known])
    middle = float(np.median(logs))
    width = max(1.4826 * float(np.median(np.abs(logs - middle))), 1e-3)
    far = [(item.name, float(np.exp(log - middle))) for item, log in zip(known, logs, strict=True)]
    return tuple((name, ratio) for name, ratio in far if ratio > _ODD_RATIO and math.log(ratio) > _ODD * width)


def fleet_document(
    analysis: Analysis, corrected: Sequence[tuple[FleetEffect, Confirmation]], **about: Any
) -> dict[str, Any]:
    """Returns the contents of ``fleet.json``.

    ``corrected`` has the common effects with the result of their test; ``about`` has the model, horizon, by, left_out
    and the number of robots diagnosed.
    """
    place = {member.name: number for number, group in enumerate(analysis.groups) for member in group.members}
    return {
        "format": 1,
        "robot": analysis.robot,
        **about,
        "counts": {kind: sum(len(g.members) for g in analysis.groups if g.kind == kind) for kind in ORDER},
        "groups": [_group_document(group) for group in analysis.groups],
        "common": _common_document(corrected),
        "false_discovery": _discovery_document(analysis),
        "pooled": [asdict(item) | {"rivals": list(item.rivals)} for item in analysis.evidence],
        "odd": [{"robot": name, "times": round(ratio, 3)} for name, ratio in analysis.odd],
        "free": _free_document(analysis.outcomes),
        "robots": [_robot_document(item, place[item.name], analysis) for item in analysis.outcomes],
    }


def _group_document(group: Group) -> dict[str, Any]:
    found = []
    for effect in group.effects:
        own = [item for member in group.members for item in member.found if item.effect == effect]
        numbers = {name: _plain(asdict(number)) for name, number in pooled_numbers(own).items()}
        equals = list(group.equals.get(effect, ()))
        found.append({"effect": effect, "indistinguishable_from": equals, "parameters": numbers})
    return {
        "kind": group.kind,
        "effects": found,
        "robots": [member.name for member in group.members],
        "error_before": _median([member.error_before for member in group.members]),
        "error_after": _median([member.error_after for member in group.members]),
        "reason": group.reason,
    }


def _common_document(corrected: Sequence[tuple[FleetEffect, Confirmation]]) -> dict[str, Any] | None:
    if not corrected:
        return None
    effects = [
        {
            "effect": item.effect,
            "indistinguishable_from": list(item.rivals) if item.together is None else [],
            "instead_of": list(item.rivals) if item.together is not None else [],
            "parameters": {name: _plain(asdict(number)) for name, number in item.numbers.items()},
            "found_in": item.found_in,
            "of": item.of,
            "together": item.together,
            "differs": item.differs,
            "confirmed": {**_plain(asdict(tried)), "holds": tried.holds},
        }
        for item, tried in corrected
    ]
    return {"effects": effects, "model": "model.toml" if any(tried.holds for _, tried in corrected) else None}


def _discovery_document(analysis: Analysis) -> dict[str, Any]:
    judged = [item for item in analysis.outcomes if item.judged]
    quiet = [item.evidence for item in judged if not item.found and math.isfinite(item.evidence)]
    found = [item for item in judged if item.found]
    count = sum(len(group.members) for group in analysis.groups if group.kind == "missing")
    return {
        "share": FALSE_SHARE,
        "judged": len(judged),
        "found": len(found),
        "believed": count,
        "largest_chance_believed": analysis.limit,
        "largest_score_where_nothing_was_found": max(quiet) if quiet else None,
        "smallest_score_where_something_was": _finite(min((i.evidence for i in found), default=math.nan)),
    }


def _free_document(outcomes: Sequence[RobotOutcome]) -> dict[str, Any]:
    """Returns the pooled free parameters of the given model."""
    numbers: dict[str, list[Any]] = {}
    for outcome in outcomes:
        for path, number in (outcome.free or {}).items():
            numbers.setdefault(path, []).append(number)
    return {path: _plain(asdict(pooled_number(own))) for path, own in numbers.items()}


def _robot_document(item: RobotOutcome, group: int, analysis: Analysis) -> dict[str, Any]:
    kind = analysis.groups[group].kind
    return {
        "robot": item.name,
        "group": group,
        "kind": kind,
        "found": [
            {
                "effect": tried.effect,
                "parameters": {name: _plain(asdict(number)) for name, number in tried.numbers.items()},
                "score": _finite(tried.score),
                "indistinguishable_from": list(tried.equals),
            }
            for tried in item.found
        ],
        "unexplained": item.unexplained or None,
        "reason": item.reason,
        "evidence": _finite(item.evidence),
        "chance": analysis.chances.get(item.name),
        "error_before": _finite(item.error_before),
        "error_after": _finite(item.error_after),
        "measured_seconds": item.measured_seconds,
        "processor_seconds": item.processor_seconds,
        "memory_mebibytes": item.memory_mebibytes,
        "unreadable_files": item.unread,
        "findings": item.findings,
        "report": f"robots/{item.name}/report.html" if item.status in ("diagnosed", "no_verdict") else None,
    }


def _median(values: Sequence[float]) -> float | None:
    known = [value for value in values if math.isfinite(value)]
    return float(np.median(known)) if known else None


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: _finite(v) if isinstance(v, float) else v for name, v in values.items()}
