"""Checks of the barriers themselves: margin, unit, gradient, and what lies between two ticks.

Checks of what the actions can do about h: conditions that no one can keep, and why.
"""

from __future__ import annotations

from math import inf, log2, log10
from typing import Final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.safety.barriers.base import AbstractBarrier, AbstractBarrierSet
from safedpa.safety.barriers.stack import make_barrier_set
from safedpa.safety.checks.probes import FilterUnderTest, Probe
from safedpa.safety.checks.report import FilterIssue, gathered, shown

__all__ = [
    "condition_issues",
    "gradient_issues",
    "margin_issues",
    "scale_issues",
    "tick_issues",
]


_LOST: Final = 1e-6
"""Share of what a tick changes in h, below which a margin is no margin."""
_STEP: Final = 1e-4
"""Share of a tick's travel by which a gradient is checked."""
_WRONG: Final = 1e-2
"""Share of a gradient's largest part by which it may differ from differences."""
_SOME: Final = 0.1
"""Share of the states, and two of them, at which a gradient has to be wrong: kinks are few."""
_CHASES, _CHASED_TICKS, _BETWEEN = 8, 30, 16


def margin_issues(checked: FilterUnderTest, probes: list[Probe]) -> list[FilterIssue]:
    """Kinds of barriers whose margin is zero."""
    issues = []
    for kind, rows in checked.barriers.rows.items():
        if rows and not checked.epsilon[list(rows)].any():
            names = tuple(checked.barriers.names[row] for row in rows)
            notice = (
                f"got epsilon 0 for barriers of kind '{kind}', wanted more: the model's error in one step would reach "
                f"beyond h = 0; measure it (calibrate_margin) or set epsilon = {{ {kind} = ... }}"
            )
            issues.append(FilterIssue("margin", names, notice))
    return issues


def scale_issues(checked: FilterUnderTest, probes: list[Probe]) -> list[FilterIssue]:
    """Barriers whose unit cannot be that of their margin."""
    h = np.array([probe.h for probe in probes])
    tick = np.array([probe.reached for probe in probes]).max(axis=0)
    cases: dict[int, tuple[float, str]] = {}
    for row in range(len(checked.barriers.names)):
        epsilon, threshold = checked.epsilon[row], checked.threshold[row]
        most, spread = h[:, row].max(), np.ptp(h[:, row])
        if epsilon == 0.0:
            continue
        if most < threshold:
            notice = (
                f"got h of {most:.3g} at most (it varies by {spread:.3g}) over {len(probes)} states, wanted some above "
                f"epsilon / eta = {threshold:.3g}; are h and epsilon in the same unit?"
            )
        elif epsilon < _LOST * tick[row]:
            notice = (
                f"got epsilon = {epsilon:.3g} where the actions change h by {tick[row]:.3g} in one tick, wanted more "
                f"than {_LOST:g} of that; are h and epsilon in the same unit?"
            )
        elif tick[row] < epsilon:
            notice = (
                f"got actions that change h by {tick[row]:.3g} in one tick at most, wanted more than epsilon = "
                f"{epsilon:.3g}, or they cannot satisfy a condition that asks for it; a wrong unit, or h is of a higher "
                "relative degree (RolloutBarrier, HigherOrderBarrier, PendingActions)"
            )
        else:
            continue
        cases[row] = (abs(log10(float(max(tick[row], 1e-300) / epsilon))), notice)
    return gathered("scale", checked.barriers.names, cases)


def gradient_issues(checked: FilterUnderTest, probes: list[Probe]) -> list[FilterIssue]:
    """Barriers whose gradient is not what their h does; a kink between the differences of both sides is none."""
    moved = np.max([probe.moved for probe in probes], axis=0)
    used = np.flatnonzero(moved > 0.0)
    wrong: dict[int, list[tuple[float, float, float, int]]] = {}
    for probe in probes:
        given = np.asarray(checked.barriers.gradient(probe.state))
        left, right = _one_sided(checked, probe, moved, used)
        share = np.abs(0.5 * (left + right) * moved[used]).max(axis=1)
        allowed = (_WRONG * np.where(share > 0.0, share, 1e-9 * np.abs(probe.h)))[:, np.newaxis] / moved[used]
        low, high = np.minimum(left, right) - allowed, np.maximum(left, right) + allowed
        off = np.maximum(low - given[:, used], given[:, used] - high)
        for row in np.flatnonzero((off > 0.0).any(axis=1)).tolist():
            at = int((off[row] * moved[used]).argmax())
            entry = int(used[at])
            wrong.setdefault(row, []).append(
                (float(off[row, at]), float(given[row, entry]), float(0.5 * (left + right)[row, at]), entry)
            )
    found: dict[int, tuple[float, str]] = {}
    for row, cases in wrong.items():
        if len(cases) >= max(2.0, _SOME * len(probes)):
            off, got, wanted, entry = max(cases)
            notice = (
                f"got a slope of {got:.6g} in entry {entry} of the state, wanted {wanted:.6g}, which is what h does; "
                f"it is wrong at {len(cases)} of {len(probes)} states; correct the gradient or leave it out"
            )
            found[row] = (off, notice)
    return gathered("gradient", checked.barriers.names, found)


def _one_sided(
    checked: FilterUnderTest, probe: Probe, moved: FloatArray, used: NDArray[np.intp]
) -> tuple[FloatArray, FloatArray]:
    """Differences (m, used entries) of h to both sides."""
    left, right = np.empty((len(probe.h), len(used))), np.empty((len(probe.h), len(used)))
    for at, entry in enumerate(used.tolist()):
        for side, table in ((-1.0, left), (1.0, right)):
            near = probe.state.copy()
            near[entry] += side * _STEP * moved[entry]
            table[:, at] = (checked.h(near) - probe.h) / (near[entry] - probe.state[entry])
    return left, right


def tick_issues(checked: FilterUnderTest, probes: list[Probe]) -> list[FilterIssue]:
    """Barriers that dip between two ticks by more than epsilon / eta, on ways that chase after a smaller h."""
    parts = [(part, rows) for part, rows in _rows_of_parts(checked) if part.since(probes[0].state) is part]
    worst: dict[int, tuple[float, float]] = {}
    alone = [(row, make_barrier_set([part]), entry) for part, rows in parts for entry, row in enumerate(rows)]
    for row, part, entry in alone:
        free = [probe for probe in probes if probe.h[row] >= 0.0]
        order = np.argsort([probe.h[row] for probe in free])
        for at in order[:: max(1, len(order) // _CHASES)].tolist():
            dip, ends = _deepest_dip(checked, free[at].state, part, entry, checked.threshold[row])
            if dip > worst.get(row, (checked.threshold[row], 0.0))[0]:
                worst[row] = dip, ends
    cases = {
        row: (
            dip,
            f"got h = {ends:.3g} at two ticks and {ends - dip:.3g} between them, wanted a fall of epsilon / eta = "
            f"{checked.threshold[row]:.3g} at most: what lies there is thinner than a tick's travel and jumped over; "
            "take RolloutBarrier, which looks between, a shorter period, or a larger epsilon",
        )
        for row, (dip, ends) in worst.items()
    }
    return gathered("ticks", checked.barriers.names, cases)


def _rows_of_parts(checked: FilterUnderTest) -> list[tuple[AbstractBarrier, range]]:
    found: list[tuple[AbstractBarrier, range]] = []
    first = 0
    for part in checked.barriers.parts:
        found.append((part, range(first, first + len(part.names))))
        first += len(part.names)
    return found


def _deepest_dip(
    checked: FilterUnderTest, state: FloatArray, part: AbstractBarrierSet, entry: int, threshold: float
) -> tuple[float, float]:
    """By how much h falls below both ends of a tick at the most, and the lower end, while h is chased.

    h is that ``entry`` of the ``part``, no other is asked. Only where it falls below epsilon / eta: above, nothing is
    near.
    """
    low, high = checked.bounds
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    sides, shares = np.diag(half), np.arange(1, _BETWEEN) / _BETWEEN
    worst, here = (0.0, 0.0), part.values(state)[entry]
    for _ in range(_CHASED_TICKS):
        both = [[part.values(checked.after(state, middle + way))[entry] for way in (side, -side)] for side in sides]
        effect = np.array([more - less for more, less in both])
        largest = np.abs(effect).max()
        following = checked.after(state, middle - (half * effect / largest if largest > 0.0 else 0.0))
        there = part.values(following)[entry]
        ends = min(here, there)
        if ends >= 0.0:  # below it there is nothing to fall from
            between = min(part.values(state + share * (following - state))[entry] for share in shares)
            if between < threshold and ends - between > worst[0]:
                worst = float(ends - between), float(ends)
        state, here = following, there
    return worst


_HIGHER: Final = 1.45
"""An effect that grows with the time held to a power above this has a relative degree above one: 1 for a degree of one,
2 for two with exact ticks, 1.58 where position follows the new speed."""
_SMALL: Final = 0.1
"""Share of an action's range by which it is moved: less than what saturates a servo."""
_ROUNDING: Final = 1e-11
_MOST_JUDGED: Final = 24


def condition_issues(checked: FilterUnderTest, probes: list[Probe]) -> list[FilterIssue]:
    """Barriers that the action does not move within one tick, and states at which no action satisfies every condition."""
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
            higher[row] = min(orders), _message_of_degree(min(orders), len(orders))
        elif cases:
            worst = cases[int(np.argmin([probe.residuals[:, row].max() for probe in cases]))]
            missed[row] = -float(worst.residuals[:, row].max()), _message_of_stuck(worst, row, len(cases))
    issues = [*gathered("relative degree", names, higher), *gathered("conditions", names, missed)]
    if stuck and not issues:
        notice = (
            f"got no action that keeps all of them together at {len(stuck)} states inside h >= epsilon / eta, such as "
            f"{shown(stuck[0].state)}, wanted one everywhere; barriers that a single backup keeps (RolloutBarrier with "
            "all of them in one h) can be kept together"
        )
        issues.append(FilterIssue("conditions", (), notice))
    return issues


def _message_of_degree(order: float, states: int) -> str:
    grown = "does not answer to the action in one tick" if order == inf else f"answers with its time to the {order:.2g}"
    return (
        f"got an h that {grown} at any of {states} states where its condition can break, wanted a relative degree of "
        "one (the answer grows with the time itself); take RolloutBarrier around a backup, HigherOrderBarrier if you "
        "have derivatives, PendingActions for a delay"
    )


def _message_of_stuck(probe: Probe, row: int, states: int) -> str:
    return (
        f"got h = {probe.h[row]:.3g} at {shown(probe.state)}, from which every action tried misses its condition by "
        f"{-probe.residuals[:, row].max():.3g} or more ({states} such states inside h >= epsilon / eta), wanted an "
        "action that keeps it; let h contain what braking can still achieve (RolloutBarrier)"
    )


def _order(checked: FilterUnderTest, state: FloatArray, row: int) -> float:
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


def _effect(
    checked: FilterUnderTest, state: FloatArray, row: int, base: FloatArray, other: FloatArray
) -> tuple[float, float]:
    """By how much two actions part h_row after one tick and after two."""
    one, two = checked.after(state, base), checked.after(state, other)
    once = abs(float(checked.h(one)[row] - checked.h(two)[row]))
    one, two = checked.after(one, base), checked.after(two, other)
    return once, abs(float(checked.h(one)[row] - checked.h(two)[row]))
