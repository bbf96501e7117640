"""Checks of what the actions can do about h: conditions that nobody can keep, and why."""

from __future__ import annotations

from math import inf, log2
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from safedpa.safety.check_probes import Checked, Probe
from safedpa.safety.check_report import FilterIssue, gathered, shown

__all__ = ["condition_issues"]

Values: TypeAlias = NDArray[np.float64]

_HIGHER: Final = 1.45
"""An effect that grows with the time held to a power above this has a relative degree above one: 1 for a degree of one,
2 for two with exact ticks, 1.58 where position follows the new speed."""
_SMALL: Final = 0.1
"""Share of an action's range by which it is moved: less than what saturates a servo."""
_ROUNDING: Final = 1e-11
_MOST_JUDGED: Final = 24


def condition_issues(checked: Checked, probes: list[Probe]) -> list[FilterIssue]:
    """Barriers that the action does not move within one tick, and states at which no action keeps every condition."""
    names = checked.barriers.names
    stuck = [probe for probe in probes if probe.inside and not probe.kept]
    higher: dict[int, tuple[float, str]] = {}
    missed: dict[int, tuple[float, str]] = {}
    for row in range(len(names)):
        broken = [probe for probe in probes if probe.inside and (probe.residuals[:, row] < 0.0).any()]
        judged = sorted(broken, key=lambda probe: probe.kept)[:_MOST_JUDGED]
        orders = [_order(checked, probe.state, row) for probe in judged]
        cases = [probe for probe in stuck if probe.residuals[:, row].max() < 0.0]
        if orders and min(orders) > _HIGHER:
            higher[row] = min(orders), _said_of_degree(min(orders), len(orders))
        elif cases:
            worst = cases[int(np.argmin([probe.residuals[:, row].max() for probe in cases]))]
            missed[row] = -float(worst.residuals[:, row].max()), _said_of_stuck(worst, row, len(cases))
    issues = [*gathered("relative degree", names, higher), *gathered("conditions", names, missed)]
    if stuck and not issues:
        said = (
            f"got no action that keeps all of them together at {len(stuck)} states inside h >= epsilon / eta, such as "
            f"{shown(stuck[0].state)}, wanted one everywhere; barriers that a single backup keeps (RolloutBarrier with "
            "all of them in one h) can be kept together"
        )
        issues.append(FilterIssue("conditions", (), said))
    return issues


def _said_of_degree(order: float, states: int) -> str:
    grown = "does not answer to the action in one tick" if order == inf else f"answers with its time to the {order:.2g}"
    return (
        f"got an h that {grown} at any of {states} states where its condition can break, wanted a relative degree of "
        "one (the answer grows with the time itself); take RolloutBarrier around a backup, HigherOrderBarrier if you "
        "have derivatives, PendingActions for a delay"
    )


def _said_of_stuck(probe: Probe, row: int, states: int) -> str:
    return (
        f"got h = {probe.h[row]:.3g} at {shown(probe.state)}, from which every action tried misses its condition by "
        f"{-probe.residuals[:, row].max():.3g} or more ({states} such states inside h >= epsilon / eta), wanted an "
        "action that keeps it; let h contain what braking can still achieve (RolloutBarrier)"
    )


def _order(checked: Checked, state: Values, row: int) -> float:
    """Least growth of an action's effect on h_row, held for one tick and for two: effect ~ time^order."""
    low, high = checked.bounds
    least, size = inf, max(abs(float(checked.h(state)[row])), float(checked.epsilon[row]))
    for base in checked.corners():
        for column in range(len(low)):
            other = base.copy()
            inward = _SMALL * (high - low)[column]
            other[column] += inward if base[column] + inward <= high[column] else -inward
            once, twice = _effect(checked, state, row, base, other)
            if once > _ROUNDING * size:
                least = min(least, log2(max(twice, once) / once))
    return least


def _effect(checked: Checked, state: Values, row: int, base: Values, other: Values) -> tuple[float, float]:
    """By how much two actions part h_row after one tick and after two."""
    one, two = checked.after(state, base), checked.after(state, other)
    once = abs(float(checked.h(one)[row] - checked.h(two)[row]))
    one, two = checked.after(one, base), checked.after(two, other)
    return once, abs(float(checked.h(one)[row] - checked.h(two)[row]))
