"""A check of a filter before it is trusted: barrier, model, margin and backup probed, each fault a sentence."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from safedpa.errors import InputError
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.barriers.stack import make_barrier_set
from safedpa.safety.checks.backup import backup_issues, horizon_issues
from safedpa.safety.checks.barriers import condition_issues, gradient_issues, margin_issues, scale_issues, tick_issues
from safedpa.safety.checks.compatibility import check_reads
from safedpa.safety.checks.probes import FilterUnderTest, Probe, probed
from safedpa.safety.checks.report import FilterIssue, FilterReport
from safedpa.safety.filter import SafetyFilter
from safedpa.safety.validation import checked_output

__all__ = ["check_filter"]


_CHECKS: Final[tuple[Callable[[FilterUnderTest, list[Probe]], list[FilterIssue]], ...]] = (
    margin_issues,
    scale_issues,
    condition_issues,
    horizon_issues,
    tick_issues,
    gradient_issues,
)


def check_filter(
    safe: SafetyFilter,
    states: ArrayLike,
    *,
    barriers: Sequence[AbstractBarrier] | None = None,
    latent: ArrayLike | None = None,
    epsilon: Mapping[str, float] | None = None,
    stationary_for: bool = True,
    ticks: int = 60,
    seed: int = 0,
) -> FilterReport:
    """What is amiss with a filter at ``states`` (k, states) or (states,), and where it can be pushed from there.

    ``barriers``, ``latent`` and ``epsilon`` as in ``decide``. ``stands``: whether the backup is meant to keep every
    condition, as braking is; false for a robot that has no stand. From the states that keep h >= epsilon / eta the
    filter is driven for ``ticks`` ticks, twelve times, by extreme nominal actions from ``seed``. Looked for:

    - a margin of zero; an epsilon that is no match for h (another unit, or actions that reach less than it);
    - states inside h >= epsilon / eta at which no action satisfies every condition, and whether that is because the
      action moves h only after more than one tick (relative degree above one, a delay);
    - a backup out of bounds, not the one of a ``RolloutBarrier``, or under which a condition breaks; a horizon that
      ends before the backup has come to rest;
    - obstacles thinner than a tick's travel: h dips between two ticks by more than epsilon / eta;
    - a gradient that its own h contradicts; anything that raises, is no finite number, or that the filter refuses.

    A report without issues is no proof: it knows the states that it saw. Raises InputError for states of a wrong shape
    or without barriers.
    """
    if not isinstance(safe, SafetyFilter):
        raise InputError(f"safe: got {type(safe).__name__}, wanted a SafetyFilter")
    rows = np.atleast_2d(checked_output("states", states))
    if rows.ndim != 2 or not rows.size or not np.isfinite(rows).all():
        raise InputError(f"states: got shape {np.shape(states)}, wanted (k, states) finite numbers, k at least 1")
    scene = safe.barriers if barriers is None else barriers
    check_reads(scene, ())
    stack = make_barrier_set(scene)
    if not stack.names:
        raise InputError("barriers: got none, wanted at least one to check")
    free = None if latent is None else checked_output("latent", latent)
    margins = {**safe.settings.epsilon, **(epsilon or {})}
    checked = FilterUnderTest(safe, stack, margins, free)
    try:
        probes = probed(checked, list(rows), ticks, seed)
        issues = [issue for check in _CHECKS for issue in check(checked, probes)]
        issues += backup_issues(checked, probes, stationary_for=stationary_for)
    except Exception as error:  # noqa: BLE001 - a user's function may raise anything, and that is what is asked for
        notice = f"got {type(error).__name__}: {error}; wanted an answer at every probed state, as the robot needs one"
        return FilterReport([FilterIssue("failure", (), notice)], len(rows))
    return FilterReport(issues, len(probes))
