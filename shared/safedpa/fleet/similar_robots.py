"""Groups of robots that lack the same effects with similar parameter values."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from safedpa.fleet.outcome import EffectEvidence, Number, RobotOutcome, neutral_of

APART = 0.33
"""Minimum relative difference between two groups."""
SURELY = 4.0
"""Minimum difference between two groups in standard deviations of the difference."""

Vector = Mapping[str, Number]


@dataclass(frozen=True)
class Group:
    """Robots with the same result; if they lack effects, with values that form one cluster."""

    kind: str
    members: tuple[RobotOutcome, ...]
    effects: tuple[str, ...] = ()
    equals: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """By effect, the effects that no member can distinguish from it."""
    reason: str = ""


def with_one_name(outcomes: Sequence[RobotOutcome]) -> list[RobotOutcome]:
    """Replaces effects by the most frequent equivalent one in the fleet, if the robot's data cannot distinguish them.

    The parameter values are those of that candidate in the robot's own search.
    """
    votes = Counter(item.effect for outcome in outcomes for item in outcome.found)
    return [replace(outcome, found=_renamed(outcome.found, votes)) for outcome in outcomes]


def _renamed(found: tuple[EffectEvidence, ...], votes: Counter[str]) -> tuple[EffectEvidence, ...]:
    retained: list[EffectEvidence] = []
    own = {item.effect for item in found}
    for item in found:
        others = [name for name in item.others or {} if name not in own]
        best = max(others, key=lambda name: votes[name], default=item.effect)
        retained.append(_as(item, best) if votes[best] > votes[item.effect] else item)
    return tuple(retained)


def _as(item: EffectEvidence, name: str) -> EffectEvidence:
    other = (item.others or {})[name]
    equals = (item.effect, *(each for each in item.equals if each != name))
    others = {**(item.others or {}), item.effect: item}
    return EffectEvidence(name, other.numbers, item.score, equals, others)


def same_effects(outcomes: Sequence[RobotOutcome], robot: str, kind: str = "missing") -> list[Group]:
    """Groups robots by the effects found in them and by clusters of their values; the largest group first."""
    sets: dict[tuple[str, ...], list[RobotOutcome]] = {}
    for outcome in outcomes:
        sets.setdefault(tuple(sorted(item.effect for item in outcome.found)), []).append(outcome)
    groups = []
    for effects, members in sets.items():
        for part in connected_components(members, lambda one, other: differ_significantly(one, other, robot)):
            groups.append(Group(kind, tuple(part), effects, _equals(effects, part)))
    return sorted(groups, key=lambda group: (-len(group.members), group.effects))


def _equals(effects: tuple[str, ...], members: Sequence[RobotOutcome]) -> dict[str, tuple[str, ...]]:
    found = {}
    for effect in effects:
        every = [set(item.equals) for member in members for item in member.found if item.effect == effect]
        found[effect] = tuple(sorted(set.intersection(*every)))
    return found


def connected_components(
    members: Sequence[RobotOutcome], different: Callable[[RobotOutcome, RobotOutcome], bool]
) -> list[list[RobotOutcome]]:
    """Returns the connected components of the graph whose edges are pairs that do not differ (single linkage)."""
    parts: list[list[RobotOutcome]] = []
    for member in members:
        near = [part for part in parts if any(not different(member, other) for other in part)]
        joined = [each for part in near for each in part] + [member]
        parts = [part for part in parts if not any(part is other for other in near)] + [joined]
    return parts


def differ_significantly(one: RobotOutcome, other: RobotOutcome, robot: str) -> bool:
    """Whether the values of an effect differ by a relevant and significant amount.

    Relevant: |a - b| > APART (|a| + |b|) / 2. a and b are the vectors of all parameters of one unit, relative to their
    neutral values, so that the direction of a force counts as well as its magnitude. Significant: the sum of
    (a - b)^2 / (s_a^2 + s_b^2) exceeds SURELY^2.
    """
    theirs = {item.effect: item.numbers for item in other.found}
    return any(_differ(item.effect, item.numbers, theirs[item.effect], robot) for item in one.found)


def _differ(effect: str, one: Vector, other: Vector, robot: str) -> bool:
    units: dict[str, list[str]] = {}
    for name in one:
        if name in other:
            units.setdefault(one[name].unit, []).append(name)
    return any(_differ_in(effect, names, one, other, robot) for names in units.values())


def _differ_in(effect: str, names: Sequence[str], one: Vector, other: Vector, robot: str) -> bool:
    neutral = [neutral_of(robot, effect, name) or 0.0 for name in names]
    change = [one[name].value - other[name].value for name in names]
    sizes = [math.hypot(*(each[n].value - at for n, at in zip(names, neutral, strict=True))) for each in (one, other)]
    widely = math.hypot(*change) > APART * 0.5 * sum(sizes)
    squares = [d * d / _variance(one[n], other[n]) for n, d in zip(names, change, strict=True)]
    return widely and sum(squares) > SURELY**2


def _variance(one: Number, other: Number) -> float:
    """Returns the variance of a difference; infinite if a standard deviation is unknown."""
    both = one.std**2 + other.std**2
    return both if both > 0 and math.isfinite(both) else math.inf
