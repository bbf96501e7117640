"""Checks of the barriers: margin, unit and gradient of h, h between two ticks, and the influence of actions on h."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, log2, log10
from typing import Final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.safety.barriers.base import AbstractBarrier, AbstractBarrierSet
from safedpa.safety.barriers.stack import make_barrier_set
from safedpa.safety.checks.probes import ROUNDING, FilterUnderTest, Probe
from safedpa.safety.checks.report import FilterIssue, collect, format_vector

__all__ = [
    "condition_issues",
    "flat_issues",
    "gradient_issues",
    "margin_issues",
    "scale_issues",
    "stall_issues",
    "tick_issues",
]


_MIN_MARGIN_SHARE: Final = 1e-6
"""Share of what a tick changes in h below which a margin counts as none."""
_GRADIENT_STEP: Final = 1e-4
"""Share of a tick's travel over which a gradient is differenced."""
_GRADIENT_TOLERANCE: Final = 1e-2
"""Share of a gradient's largest entry by which it may differ from the differences."""
_WRONG_SHARE: Final = 0.1
"""Share of the states, and at least two, at which a gradient must be wrong: kinks of h affect few states."""
_CHASE_STARTS, _CHASE_TICKS, _POINTS_PER_TICK = 8, 30, 16
"""States from which h is minimised greedily, ticks of each descent, and intervals of a tick in which h is evaluated."""


def margin_issues(checked: FilterUnderTest, probes: list[Probe]) -> list[FilterIssue]:
    """Kinds of barriers with a margin of zero."""
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
    """Barriers whose h has another unit than their margin, or that the actions influence too little."""
    h = np.array([probe.h for probe in probes])
    tick = np.array([probe.reached for probe in probes]).max(axis=0)
    cases: dict[int, tuple[float, str]] = {}
    for row in range(len(checked.barriers.names)):
        epsilon, threshold = checked.epsilon[row], checked.threshold[row]
        most, spread = h[:, row].max(), np.ptp(h[:, row])
        if epsilon == 0.0:  # ``margin_issues`` reports it
            continue
        if most < threshold:
            notice = (
                f"got h of {most:.3g} at most (it varies by {spread:.3g}) over {len(probes)} states, wanted some above "
                f"epsilon / eta = {threshold:.3g}; are h and epsilon in the same unit?"
            )
        elif epsilon < _MIN_MARGIN_SHARE * tick[row]:
            notice = (
                f"got epsilon = {epsilon:.3g} where the actions change h by {tick[row]:.3g} in one tick, wanted more "
                f"than {_MIN_MARGIN_SHARE:g} of that; are h and epsilon in the same unit?"
            )
        elif tick[row] < epsilon:
            notice = (
                f"got actions that change h by {tick[row]:.3g} in one tick at most, wanted more than epsilon = "
                f"{epsilon:.3g}, or they cannot satisfy its condition; a wrong unit, or h is of a higher relative "
                " degree (RolloutBarrier, HigherOrderBarrier, PendingActions)"
            )
        else:
            continue
        # The severity is the ratio in decades: a wrong unit shows as 3 or 6, whichever way it is wrong.
        cases[row] = (abs(log10(float(max(tick[row], 1e-300) / epsilon))), notice)
    return collect("scale", checked.barriers.names, cases)


def gradient_issues(checked: FilterUnderTest, probes: list[Probe]) -> list[FilterIssue]:
    """Barriers whose gradient contradicts their h; at a kink any value between both one-sided differences is right."""
    moved = np.max([probe.moved for probe in probes], axis=0)
    # An entry that never moves within a tick has no influence on any decision.
    used = np.flatnonzero(moved > 0.0)
    wrong: dict[int, list[tuple[float, float, float, int]]] = {}
    for probe in probes:
        given = np.asarray(checked.barriers.grad_h(probe.state))
        left, right = _one_sided(checked, probe, moved, used)
        share = np.abs(0.5 * (left + right) * moved[used]).max(axis=1)
        # Where h does not change, no share of the change can be allowed: rounding of h is the error then.
        allowed = _GRADIENT_TOLERANCE * np.where(share > 0.0, share, 1e-9 * np.abs(probe.h))
        allowed = allowed[:, np.newaxis] / moved[used]
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
        if len(cases) >= max(2.0, _WRONG_SHARE * len(probes)):
            off, got, wanted, entry = max(cases)
            notice = (
                f"got a slope of {got:.6g} in entry {entry} of the state, wanted {wanted:.6g}, which is what h does; "
                f"it is wrong at {len(cases)} of {len(probes)} states; correct the gradient or leave it out"
            )
            found[row] = (off, notice)
    return collect("gradient", checked.barriers.names, found)


def _one_sided(
    checked: FilterUnderTest, probe: Probe, moved: FloatArray, used: NDArray[np.intp]
) -> tuple[FloatArray, FloatArray]:
    """One-sided differences (m, used entries) of h to both sides."""
    left, right = np.empty((len(probe.h), len(used))), np.empty((len(probe.h), len(used)))
    for at, entry in enumerate(used.tolist()):
        for side, table in ((-1.0, left), (1.0, right)):
            near = probe.state.copy()
            near[entry] += side * _GRADIENT_STEP * moved[entry]
            # The step is computed again from the shifted state, which differs from the intended one by rounding.
            table[:, at] = (checked.h(near) - probe.h) / (near[entry] - probe.state[entry])
    return left, right


def tick_issues(checked: FilterUnderTest, probes: list[Probe]) -> list[FilterIssue]:
    """Barriers that fall between two ticks by more than epsilon / eta, on paths that descend towards smaller h."""
    # A barrier that evaluates the path between two ticks by itself needs no such check.
    parts = [(part, rows) for part, rows in _rows_of_parts(checked) if part.starting_at(probes[0].state) is part]
    worst: dict[int, tuple[float, float]] = {}
    # Each part alone: the other barriers of a set would be evaluated as well, thousands of times.
    alone = [(row, make_barrier_set([part]), entry) for part, rows in parts for entry, row in enumerate(rows)]
    for row, part, entry in alone:
        free = [probe for probe in probes if probe.h[row] >= 0.0]
        # States spread evenly over the sorted h: near and far from the boundary alike.
        order = np.argsort([probe.h[row] for probe in free])
        for at in order[:: max(1, len(order) // _CHASE_STARTS)].tolist():
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
    return collect("ticks", checked.barriers.names, cases)


_MIN_FLAT: Final = 3
"""States at which an h must be flat before it is reported: at one it may be a kink."""


def flat_issues(checked: FilterUnderTest, probes: list[Probe]) -> list[FilterIssue]:
    """Barriers whose h no motion changes at some states, although it changes at others."""
    cases: dict[int, tuple[float, str]] = {}
    for part, rows in _rows_of_parts(checked):
        # A barrier that evaluates the path between two ticks by itself has no such gap.
        if part.starting_at(probes[0].state) is not part:
            continue
        for row in rows:
            change = np.array([np.abs(p.h_next[:, row] - p.h[row]).max() for p in probes])
            size = ROUNDING * (np.array([abs(p.h[row]) for p in probes]) + checked.epsilon[row])
            flat = [p for p, most, least in zip(probes, change, size, strict=True) if most <= least and p.moved.any()]
            if len(flat) >= _MIN_FLAT and (change > size).any():
                notice = (
                    f"got an h that stays at {flat[0].h[row]:.3g} whatever the robot does in a tick, at {len(flat)} of "
                    f"{len(probes)} states such as {format_vector(flat[0].state)}, wanted one that shows an approach: "
                    "a truncated distance, a cost map or an occupancy map can be jumped through between two ticks; "
                    "state a bound (LipschitzBarrier), or take DistanceFieldBarrier(...).bounded"
                )
                cases[row] = float(len(flat)), notice
    return collect("flat", checked.barriers.names, cases)


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
    """By how much h falls below both ends of a tick at most, and the lower end, along a greedy descent of h.

    h is this ``entry`` of ``part`` alone. A fall counts only below epsilon / eta: above, the boundary is far away.
    """
    low, high = checked.bounds
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    sides, shares = np.diag(half), np.arange(1, _POINTS_PER_TICK) / _POINTS_PER_TICK
    worst, here = (0.0, 0.0), part.h(state)[entry]
    for _ in range(_CHASE_TICKS):
        both = [[part.h(checked.next_state(state, middle + way))[entry] for way in (side, -side)] for side in sides]
        effect = np.array([more - less for more, less in both])
        largest = np.abs(effect).max()
        # The corner that lowers h most: a path straight towards the obstacle, which is where a jump over it is
        # possible.
        following = checked.next_state(state, middle - (half * effect / largest if largest > 0.0 else 0.0))
        there = part.h(following)[entry]
        ends = min(here, there)
        if ends >= 0.0:  # from a violated state there is nothing to fall from
            between = min(part.h(state + share * (following - state))[entry] for share in shares)
            if between < threshold and ends - between > worst[0]:
                worst = float(ends - between), float(ends)
        state, here = following, there
    return worst


_MIN_HIGHER_DEGREE: Final = 1.45
"""Exponent above which the relative degree is above one. An effect grows with the time to the power of the degree: 1
for one, 2 for two with exact ticks, 1.58 if the position follows the new speed."""
_ACTION_STEP: Final = 0.1
"""Share of an action's range for a change that does not saturate a servo."""
_EFFECT_ROUNDING: Final = 1e-11
"""Share of |h| below which an effect is rounding error."""
_MAX_JUDGED: Final = 24
"""States per row at which the relative degree is determined; each takes many predictions."""
_MAX_ROWS: Final = 4
"""Rows per state at which the influence of each entry of the action is determined."""


def condition_issues(checked: FilterUnderTest, probes: list[Probe]) -> list[FilterIssue]:
    """Barriers without influence of the action within one tick, and states at which no action is feasible."""
    names = checked.barriers.names
    infeasible = [probe for probe in probes if probe.inside and not probe.is_feasible]
    higher: dict[int, tuple[float, str]] = {}
    missed: dict[int, tuple[float, str]] = {}
    for row in range(len(names)):
        violated = [probe for probe in probes if probe.inside and (probe.residuals[:, row] < 0.0).any()]
        # Infeasible states first: there the cause is wanted.
        judged = sorted(violated, key=lambda probe: probe.is_feasible)[:_MAX_JUDGED]
        orders = [_relative_degree(checked, probe.state, row) for probe in judged]
        cases = [probe for probe in infeasible if probe.residuals[:, row].max() < 0.0]
        if orders and min(orders) > _MIN_HIGHER_DEGREE:
            higher[row] = min(orders), _degree_message(min(orders), len(orders))
        elif cases:
            worst = cases[int(np.argmin([probe.residuals[:, row].max() for probe in cases]))]
            missed[row] = -float(worst.residuals[:, row].max()), _infeasible_message(worst, row, len(cases))
    issues = [*collect("relative degree", names, higher), *collect("conditions", names, missed)]
    if infeasible and not issues:
        notice = (
            f"got no action that keeps all of them together at {len(infeasible)} states inside h >= epsilon / eta, "
            f"such as {format_vector(infeasible[0].state)}, wanted one everywhere; barriers that a single backup keeps "
            "(RolloutBarrier with all of them in one h) can be kept together"
        )
        issues.append(FilterIssue("conditions", (), notice))
    return issues


def stall_issues(checked: FilterUnderTest, probes: list[Probe]) -> list[FilterIssue]:
    """Entries of the action that move the robot, but no barrier within one tick, while other entries move barriers."""
    entries = len(checked.bounds[0])
    judged = [probe for probe in probes if probe.inside][:_MAX_JUDGED]
    idle: list[int] = []
    for column in range(entries if len(judged) >= _MIN_FLAT else 0):
        orders = [_relative_degree(checked, probe.state, row, (column,)) for probe in judged for row in _nearest(probe)]
        if min(orders) > _MIN_HIGHER_DEGREE and any(_moves(checked, probe.state, column) for probe in judged):
            idle.append(column)
    # If no entry moves h, the relative degree says so.
    if not idle or len(idle) == entries:
        return []
    notice = (
        f"got no barrier that entry {idle[0]} of the action changes within one tick, at any of {len(judged)} states, "
        "wanted one if the robot is to drive around an obstacle: as it is, the filter can only use the other entries, "
        "and the robot creeps to rest in front of it; take a point ahead of the robot (LookAheadBarrier), or "
        "RolloutBarrier; nothing to do if that entry has nothing to do with the barriers"
    )
    return [FilterIssue("stall", (), notice)]


def _nearest(probe: Probe) -> list[int]:
    """The rows with the smallest h; a scene may have hundreds."""
    return [int(row) for row in np.argsort(probe.h)[:_MAX_ROWS]]


def _moves(checked: FilterUnderTest, state: FloatArray, column: int) -> bool:
    """Whether an entry of the action moves the state."""
    low, high = checked.bounds
    one, other = 0.5 * (low + high), 0.5 * (low + high)
    one[column], other[column] = low[column], high[column]
    return bool((checked.next_state(state, one) != checked.next_state(state, other)).any())


def _degree_message(order: float, states: int) -> str:
    grown = "does not answer to the action in one tick" if order == inf else f"answers with its time to the {order:.2g}"
    return (
        f"got an h that {grown} at any of {states} states where its condition can break, wanted a relative degree of "
        "one (the answer grows with the time itself); take RolloutBarrier around a backup, HigherOrderBarrier if you "
        "have derivatives, PendingActions for a delay"
    )


def _infeasible_message(probe: Probe, row: int, states: int) -> str:
    return (
        f"got h = {probe.h[row]:.3g} at {format_vector(probe.state)}, from which every action tried misses its "
        f"condition by {-probe.residuals[:, row].max():.3g} or more ({states} such states inside h >= epsilon / eta), "
        "wanted an action that keeps it; let h contain what braking can still achieve (RolloutBarrier)"
    )


def _relative_degree(
    checked: FilterUnderTest, state: FloatArray, row: int, columns: Sequence[int] | None = None
) -> float:
    """The smallest relative degree of h_row over the actions, from effects after one and two ticks (~ time^degree).

    ``columns``: entries of the action to consider; None: all.
    """
    low, high = checked.bounds
    least, size = inf, max(abs(float(checked.h(state)[row])), float(checked.epsilon[row]))
    for base in checked.corners():
        for column in range(len(low)) if columns is None else columns:
            other = base.copy()
            # The other action stays within the bounds: the model need not be defined beyond them.
            inward = _ACTION_STEP * (high - low)[column]
            other[column] += inward if base[column] + inward <= high[column] else -inward
            once, twice = _effect(checked, state, row, base, other)
            # An effect at the level of rounding has no exponent; an action without any effect leaves the degree
            # infinite.
            if once > _EFFECT_ROUNDING * size:
                # An effect that fades after one tick has degree 0; without the maximum it would be negative.
                least = min(least, log2(max(twice, once) / once))
    return least


def _effect(
    checked: FilterUnderTest, state: FloatArray, row: int, base: FloatArray, other: FloatArray
) -> tuple[float, float]:
    """The difference of h_row between two actions after one tick and after two."""
    one, two = checked.next_state(state, base), checked.next_state(state, other)
    once = abs(float(checked.h(one)[row] - checked.h(two)[row]))
    one, two = checked.next_state(one, base), checked.next_state(two, other)
    return once, abs(float(checked.h(one)[row] - checked.h(two)[row]))
