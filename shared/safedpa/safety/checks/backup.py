"""Checks of the backup: within bounds, equal to the barrier's own, satisfying every constraint, at rest at the end."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.safety.barriers.rollout import RolloutBarrier
from safedpa.safety.checks.probes import ROUNDING, FilterUnderTest, Probe
from safedpa.safety.checks.report import FilterIssue, collect, format_vector

__all__ = ["backup_issues", "horizon_issues", "lost_state_issues"]

_LOST_TICKS = 100
"""Ticks without a state that are rolled out: 5 s at 20 Hz."""


def backup_issues(checked: FilterUnderTest, probes: list[Probe], *, can_stop: bool) -> list[FilterIssue]:
    """A backup that has a wrong shape, is out of bounds, differs from a rollout's, or violates constraints."""
    actions = [checked.backup(probe.state) for probe in probes]
    low, high = checked.bounds
    # Relative to the range: a backup computed by the user may exceed its bound by rounding.
    slack = ROUNDING * (high - low)
    # A wrong shape or bound is reported alone: the other checks would only repeat its consequences.
    for probe, action in zip(probes, actions, strict=True):
        if action.shape != low.shape or not np.isfinite(action).all():
            notice = f"got {action} at {format_vector(probe.state)}, wanted ({len(low)},) finite numbers"
            return [FilterIssue("backup", (), notice)]
        if (action < low - slack).any() or (action > high + slack).any():
            notice = (
                f"got {format_vector(action)} at {format_vector(probe.state)}, wanted {format_vector(low)} to "
                f"{format_vector(high)}: the filter would clip it, and another action would be taken than intended"
            )
            return [FilterIssue("backup", (), notice)]
    issues = _other_backups(checked, probes, actions)
    return issues + (_violations(checked, probes, actions) if can_stop and not issues else [])


def _other_backups(checked: FilterUnderTest, probes: list[Probe], actions: list[FloatArray]) -> list[FilterIssue]:
    """Rollouts with another backup than the filter's."""
    width = np.subtract(*checked.bounds[::-1])
    issues = []
    # The guarantee of a rollout barrier is that of its own backup: another one may violate every constraint.
    for part in checked.barriers.parts:
        if isinstance(part, RolloutBarrier):
            for probe, action in zip(probes, actions, strict=True):
                own = part.backup(probe.state)
                if own.shape != action.shape or (np.abs(own - action) > ROUNDING * width).any():
                    notice = (
                        f"got {format_vector(action)} from the filter's backup and {format_vector(own)} from the "
                        f"barrier's at {format_vector(probe.state)}, wanted the same; give the filter "
                        "backup=barrier.backup"
                    )
                    issues.append(FilterIssue("backup", part.names, notice))
                    break
    return issues


def _violations(checked: FilterUnderTest, probes: list[Probe], actions: list[FloatArray]) -> list[FilterIssue]:
    """Barriers whose constraint the backup violates although every h_i >= epsilon_i / eta."""
    worst: dict[int, tuple[float, Probe]] = {}
    # Only inside h >= epsilon / eta is the backup expected to satisfy every constraint.
    inside = [(probe, action) for probe, action in zip(probes, actions, strict=True) if probe.inside]
    for probe, action in inside:
        residual = checked.residual(probe.state, action)
        for row in np.flatnonzero(residual < -checked.tolerance(probe.h)).tolist():
            if residual[row] < worst.get(row, (0.0, probe))[0]:
                worst[row] = float(residual[row]), probe
    cases = {
        row: (
            -residual,
            f"got an h that misses its condition by {-residual:.3g} under the backup, from h = {probe.h[row]:.3g} at "
            f"{format_vector(probe.state)}, wanted it satisfied wherever all h >= epsilon / eta; another backup, or a "
            "barrier that contains what this one can still achieve (RolloutBarrier); a robot that has no safe "
            "standstill: can_stop=False",
        )
        for row, (residual, probe) in worst.items()
    }
    return collect("backup", checked.barriers.names, cases)


def horizon_issues(checked: FilterUnderTest, probes: list[Probe]) -> list[FilterIssue]:
    """Rollouts at whose horizon h still falls."""
    issues, first = [], 0
    for part in checked.barriers.parts:
        # The rows of this part in the h of the whole set.
        rows = slice(first, first + len(part.names))
        first += len(part.names)
        if not isinstance(part, RolloutBarrier):
            continue
        inside = [probe for probe in probes if (probe.h[rows] >= checked.threshold[rows]).all()]
        falls = [part.fall_beyond(probe.state) for probe in inside]
        for probe, fall in zip(inside, falls, strict=True):
            if (fall > checked.tolerance(probe.h)[rows]).any():
                notice = (
                    f"got an h that falls by {fall.max():.3g} after the horizon of {part.horizon} ticks from "
                    f"{format_vector(probe.state)}, wanted a backup at rest by then; a longer horizon, or a "
                    "backup that ends where it can stay"
                )
                issues.append(FilterIssue("horizon", part.names, notice))
                break
    return issues


def lost_state_issues(checked: FilterUnderTest, probes: list[Probe], *, can_stop: bool) -> list[FilterIssue]:
    """A backup that brakes by the state, while the action without a state lets the robot coast into a barrier.

    Both are rolled out from states inside h >= epsilon / eta: h must not fall below 0 without a state if it does not
    with one.
    """
    if not can_stop or checked.safe.tools.backup is None:
        return []
    worst: dict[int, tuple[float, str]] = {}
    for probe in [one for one in probes if one.inside][:_LOST_PROBES]:
        blind = _blind_action(checked)
        if np.array_equal(blind, checked.backup(probe.state)):
            continue
        least = _least_h(checked, probe.state, partial(_always, blind))
        hit = np.flatnonzero((least < 0.0) & (_least_h(checked, probe.state, checked.backup) >= 0.0))
        for row in hit.tolist():
            if -least[row] > worst.get(row, (0.0, ""))[0]:
                notice = (
                    f"got {format_vector(blind)} when the state is lost, which takes h to {least[row]:.3g} from "
                    f"{format_vector(probe.state)}, where the backup with a state stays at h >= 0; decide through a "
                    "FilterSession, which brakes along the predicted state"
                )
                worst[row] = float(-least[row]), notice
    return collect("lost state", checked.barriers.names, worst)


_LOST_PROBES = 8
"""States from which a lost state is rolled out: each takes up to twice as many evaluations as there are ticks."""


def _blind_action(checked: FilterUnderTest) -> FloatArray:
    """What the filter falls back to without a state (actions,)."""
    verdict = checked.safe.decide(None, checked.safe.settings.resting_action, checked.latent, barriers=checked.barriers)
    return np.array(verdict.action)


def _always(action: FloatArray, state: FloatArray) -> FloatArray:
    del state
    return action


def _least_h(checked: FilterUnderTest, state: FloatArray, action: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """The least h (m,) along the rollout of an action chosen at each state."""
    low, high = checked.bounds
    least = checked.h(state)
    for _ in range(_LOST_TICKS):
        following = checked.next_state(state, np.clip(action(state), low, high))
        least = np.minimum(least, checked.h(following))
        if np.array_equal(following, state):
            break
        state = following
    return least
