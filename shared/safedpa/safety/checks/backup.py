"""Checks of the backup: within its bounds, the barrier's own, satisfying every condition, at rest at the horizon's end."""

from __future__ import annotations

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.safety.barriers.rollout import RolloutBarrier
from safedpa.safety.checks.probes import ROUNDING, FilterUnderTest, Probe
from safedpa.safety.checks.report import FilterIssue, gathered, shown

__all__ = ["backup_issues", "horizon_issues"]


def backup_issues(checked: FilterUnderTest, probes: list[Probe], *, stationary_for: bool) -> list[FilterIssue]:
    """A backup of a wrong shape or out of bounds, another one than a rollout's, or one under which conditions break."""
    actions = [checked.backup(probe.state) for probe in probes]
    low, high = checked.bounds
    slack = ROUNDING * (high - low)
    for probe, action in zip(probes, actions, strict=True):
        if action.shape != low.shape or not np.isfinite(action).all():
            notice = f"got {action} at {shown(probe.state)}, wanted ({len(low)},) finite numbers"
            return [FilterIssue("backup", (), notice)]
        if (action < low - slack).any() or (action > high + slack).any():
            notice = (
                f"got {shown(action)} at {shown(probe.state)}, wanted {shown(low)} to {shown(high)}: the filter "
                "would cut it off, and another action would be taken than the one that was thought of"
            )
            return [FilterIssue("backup", (), notice)]
    issues = _foreign(checked, probes, actions)
    return issues + (_breaking(checked, probes, actions) if stationary_for and not issues else [])


def _foreign(checked: FilterUnderTest, probes: list[Probe], actions: list[FloatArray]) -> list[FilterIssue]:
    """Rollouts of another backup than the filter's."""
    width = np.subtract(*checked.bounds[::-1])
    issues = []
    for part in checked.barriers.parts:
        if isinstance(part, RolloutBarrier):
            for probe, action in zip(probes, actions, strict=True):
                own = part.backup(probe.state)
                if own.shape != action.shape or (np.abs(own - action) > ROUNDING * width).any():
                    notice = (
                        f"got {shown(action)} from the filter's backup and {shown(own)} from the barrier's at "
                        f"{shown(probe.state)}, wanted the same; give the filter backup=barrier.backup"
                    )
                    issues.append(FilterIssue("backup", part.names, notice))
                    break
    return issues


def _breaking(checked: FilterUnderTest, probes: list[Probe], actions: list[FloatArray]) -> list[FilterIssue]:
    """Barriers whose condition breaks under the backup, though every h_i >= epsilon_i / eta."""
    worst: dict[int, tuple[float, Probe]] = {}
    inside = [(probe, action) for probe, action in zip(probes, actions, strict=True) if probe.inside]
    for probe, action in inside:
        residual = checked.residual(probe.state, action)
        for row in np.flatnonzero(residual < -checked.slight(probe.h)).tolist():
            if residual[row] < worst.get(row, (0.0, probe))[0]:
                worst[row] = float(residual[row]), probe
    cases = {
        row: (
            -residual,
            f"got an h that misses its condition by {-residual:.3g} under the backup, from h = {probe.h[row]:.3g} at "
            f"{shown(probe.state)}, wanted it kept wherever all h >= epsilon / eta; another backup, or a barrier that "
            "contains what this one can still achieve (RolloutBarrier); a robot without a stand: stands=False",
        )
        for row, (residual, probe) in worst.items()
    }
    return gathered("backup", checked.barriers.names, cases)


def horizon_issues(checked: FilterUnderTest, probes: list[Probe]) -> list[FilterIssue]:
    """Rollouts that end while h still falls."""
    issues, first = [], 0
    for part in checked.barriers.parts:
        rows = slice(first, first + len(part.names))
        first += len(part.names)
        if not isinstance(part, RolloutBarrier):
            continue
        inside = [probe for probe in probes if (probe.h[rows] >= checked.threshold[rows]).all()]
        falls = [part.fall_beyond(probe.state) for probe in inside]
        for probe, fall in zip(inside, falls, strict=True):
            if (fall > checked.slight(probe.h)[rows]).any():
                notice = (
                    f"got an h that falls by {fall.max():.3g} after the horizon of {part.horizon} ticks from "
                    f"{shown(probe.state)}, wanted a backup that has come to rest by then; a longer horizon, or a "
                    "backup that ends where it can stay"
                )
                issues.append(FilterIssue("horizon", part.names, notice))
                break
    return issues
