"""Checks a filter before it is trusted: barriers, model, margin and backup are probed, each issue is one sentence."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import inf
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from safedpa.arrays import FloatArray
from safedpa.errors import InputError, described
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.barriers.rollout import RolloutBarrier
from safedpa.safety.barriers.stack import make_barrier_set
from safedpa.safety.checks.backup import backup_issues, horizon_issues, lost_state_issues
from safedpa.safety.checks.barriers import (
    condition_issues,
    flat_issues,
    gradient_issues,
    margin_issues,
    scale_issues,
    stall_issues,
    tick_issues,
)
from safedpa.safety.checks.compatibility import check_reads
from safedpa.safety.checks.probes import FilterUnderTest, Probe, collect_probes
from safedpa.safety.checks.report import FilterIssue, FilterReport
from safedpa.safety.checks.time import time_issues
from safedpa.safety.filter import SafetyFilter
from safedpa.safety.session.filter_session import FilterSession
from safedpa.safety.validation import checked_output

__all__ = ["check_filter"]


# In order of how basic a mistake is: the first issue is usually the cause of those that follow.
_CHECKS: Final[tuple[Callable[[FilterUnderTest, list[Probe]], list[FilterIssue]], ...]] = (
    margin_issues,
    scale_issues,
    condition_issues,
    stall_issues,
    horizon_issues,
    tick_issues,
    flat_issues,
    gradient_issues,
)


def check_filter(
    safe: SafetyFilter | FilterSession,
    states: ArrayLike,
    *,
    barriers: Sequence[AbstractBarrier] | None = None,
    latent: ArrayLike | None = None,
    epsilon: Mapping[str, float] | None = None,
    can_stop: bool = True,
    period: float | None = None,
    ticks: int = 60,
    seed: int = 0,
) -> FilterReport:
    """Returns what is wrong with a filter at ``states`` (k, states) or (states,), and where it drives from there.

    ``barriers``, ``latent`` and ``epsilon`` are as in ``decide``. ``can_stop``: whether the backup is meant to satisfy
    every constraint, as braking does; False for a robot without a safe standstill. From states with h >= epsilon / eta
    the filter is driven for ``ticks`` ticks, twelve times, by extreme nominal actions from ``seed``. It reports:

    - a margin of zero; an epsilon of another unit than h, or larger than what the actions can change;
    - states inside h >= epsilon / eta at which no action satisfies every constraint, and whether that is because the
      action influences h only after more than one tick (relative degree above one, a delay);
    - a backup out of bounds, one that differs from a ``RolloutBarrier``'s, or that violates a constraint; a horizon
      that ends before the backup has come to rest; a fallback without a state that lets the robot coast
      (not with a ``FilterSession`` in place of the filter);
    - obstacles thinner than a tick's travel: h falls between two ticks by more than epsilon / eta;
    - an h that is flat at some states, and an entry of the action that moves no h, so that the robot stalls;
    - with a ``period`` [s], decisions that take longer than that on this machine, at the 99th percentile;
    - a gradient that contradicts its own h; anything that raises, is not finite, or that the filter refuses.

    Notes say why Python decides instead of C, and name the line that prevents a ``RolloutBarrier`` from being compiled.
    A report without issues says nothing about other states. Raises InputError for a wrong shape, or without barriers.

    Example:

        >>> model, settings = safedpa.load_model("pendulum"), safedpa.settings_named("pendulum")
        >>> safe = safedpa.SafetyFilter.for_model(model, settings, [safedpa.CorridorBarrier(-0.3, 0.3, 0.25)])
        >>> print(safedpa.check_filter(safe, [[0.0, 0.0], [0.1, 0.0]], latent=model.latent, can_stop=False))
        No issue at ... states.
    """
    # A session brakes along the predicted state when it loses the measured one.
    predicts = isinstance(safe, FilterSession)
    safe = safe.filter if isinstance(safe, FilterSession) else safe
    if not isinstance(safe, SafetyFilter):
        raise InputError(f"safe: got {type(safe).__name__}, wanted a SafetyFilter, or a FilterSession")
    if period is not None and not 0.0 < period < inf:
        raise InputError(f"period: got {period!r}, wanted a finite number of seconds > 0")
    rows = _checked_rows(states)
    scene = safe.barriers if barriers is None else barriers
    # Without names only the type of each barrier is checked here; the filter has checked the states.
    check_reads(scene, ())
    barrier_set = make_barrier_set(scene)
    if not barrier_set.names:
        raise InputError("barriers: got none, wanted at least one to check")
    free = None if latent is None else checked_output("latent", latent)
    # The same precedence as in a decision: the call overrides the settings by kind.
    checked = FilterUnderTest(safe, barrier_set, {**safe.settings.epsilon, **(epsilon or {})}, free)
    return _report(checked, rows, ticks, seed, can_stop=can_stop, period=period, predicts=predicts)


def _report(
    checked: FilterUnderTest,
    rows: FloatArray,
    ticks: int,
    seed: int,
    *,
    can_stop: bool,
    period: float | None,
    predicts: bool,
) -> FilterReport:
    try:
        probes = collect_probes(checked, list(rows), ticks, seed)
        issues = [issue for check in _CHECKS for issue in check(checked, probes)]
        wrong = backup_issues(checked, probes, can_stop=can_stop)
        # A backup that is wrong in itself is reported alone.
        issues += wrong or ([] if predicts else lost_state_issues(checked, probes, can_stop=can_stop))
        issues += [] if period is None else time_issues(checked, probes, period)
    except Exception as error:  # noqa: BLE001 - a user's function may raise anything, and that is what is checked
        notice = f"got {described(error)}; wanted an answer at every probed state, as the robot needs one"
        return FilterReport([FilterIssue("failure", (), notice)], len(rows))
    return FilterReport(
        issues, len(probes), [*_not_compiled(checked.barriers.parts), *_decided_by_python(checked, rows)]
    )


def _not_compiled(parts: Sequence[AbstractBarrier]) -> list[str]:
    """The line that prevents a rollout from being compiled; it then takes a hundred times as long."""
    return [
        f"Note ({', '.join(part.names[:4])}): computed by NumPy instead of compiled C: {part.not_compiled}"
        for part in parts
        if isinstance(part, RolloutBarrier) and part.not_compiled
    ]


def _decided_by_python(checked: FilterUnderTest, rows: FloatArray) -> list[str]:
    """What keeps the whole decision from being one call of C; it then takes ten to thirty times as long."""
    compiled = checked.safe.tools.compiled
    reason = "" if compiled is None else compiled.why_not(checked.barriers, rows.shape[1])
    return [f"Note (decision): made by Python instead of compiled C: {reason}"] if reason else []


def _checked_rows(states: ArrayLike) -> FloatArray:
    """Returns the states (k, states); raises InputError if they are none or not finite."""
    rows = np.atleast_2d(checked_output("states", states))
    if rows.ndim != 2 or not rows.size or not np.isfinite(rows).all():
        raise InputError(f"states: got shape {np.shape(states)}, wanted (k, states) finite numbers, k at least 1")
    return rows
