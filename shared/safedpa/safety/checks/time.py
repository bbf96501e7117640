"""Checks how long decisions take on this machine, compared with the period of the control loop."""

from __future__ import annotations

from time import perf_counter
from typing import Final

import numpy as np

from safedpa.safety.checks.probes import FilterUnderTest, Probe
from safedpa.safety.checks.report import FilterIssue

__all__ = ["time_issues"]

_DECISIONS: Final = 300
"""Decisions that are timed: the 99th percentile then has three above it."""
_LONGEST: Final = 20.0
"""s after which timing ends with what there is."""


def time_issues(checked: FilterUnderTest, probes: list[Probe], period: float) -> list[FilterIssue]:
    """Decisions under extreme nominal actions that take longer than ``period`` [s] at the 99th percentile."""
    # Without the last one, the middle of the range: extreme nominal actions need corrections, which take longest.
    corners, seconds = checked.corners()[:-1], list[float]()
    began = perf_counter()
    for at in range(_DECISIONS):
        probe, nominal = probes[at % len(probes)], corners[at % len(corners)]
        start = perf_counter()
        checked.safe.decide(
            probe.state, nominal, checked.latent, barriers=checked.barriers, epsilon=checked.margins, time=0.0
        )
        seconds.append(perf_counter() - start)
        if seconds[-1] + start - began > _LONGEST:
            break
    # Not the maximum: a single interruption by the operating system says nothing about the filter.
    half, most = 1e3 * np.quantile(seconds, (0.5, 0.99))
    if most <= 1e3 * period:
        return []
    notice = (
        f"got decisions of {half:.3g} ms in the median and {most:.3g} ms at the 99th percentile of {len(seconds)} on "
        f"this machine, wanted at most the period of {1e3 * period:.3g} ms; a shorter horizon, a model and an h that "
        "can be recorded (written over Operations), a longer period, or decide(..., deadline=...)"
    )
    return [FilterIssue("time", (), notice)]
