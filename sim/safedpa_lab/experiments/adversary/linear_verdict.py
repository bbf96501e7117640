"""One answer of the filter to a linear problem, compared with the reference."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from safedpa.safety import Verdict
from safedpa_lab.experiments.adversary.linear_judge import LinearJudge
from safedpa_lab.experiments.adversary.linear_problem import LinearProblem

__all__ = ["BROKEN", "FAR", "Judged", "judged"]

BROKEN = 1e-9
"""Share of its scale by which a condition is broken beyond rounding."""
FAR = 1e-6
"""Weighted ranges by which a correction is further from the nominal action than it had to be."""
_SIGN = 1e-12
"""Share of its scale within which h has no sign: the filter and the judge add in different orders."""


@final
@dataclass(frozen=True)
class Judged:
    """What was wrong with one answer; None where a question does not arise."""

    status: str
    out_of_bounds: bool
    altered: bool
    """Passed, but not the nominal action bit for bit."""
    broken: float | None
    """Passed or corrected: by how much the worst condition is broken, in its scale; 0 when all are kept."""
    below: bool
    """Passed or corrected, and some predicted h is below 0."""
    untold: bool
    """Some h is below 0 now, and the status is not violated; or the other way round."""
    excess: float | None
    """Corrected: distance from the nominal action beyond the least, in weighted ranges; None where the reference has none."""
    missed: bool
    """Relaxed or fallback, though an action satisfies every condition with room."""
    shortfall: float | None
    """Relaxed, violated or fallback: least scaled h left, against the best attainable, of the rows that the
    actions move; 0 where the conditions of all these are kept."""
    needless: bool
    """Relaxed or fallback predicts h < 0, where an action with all h >= 0 exists."""
    reason: str = ""


def judged(problem: LinearProblem, verdict: Verdict) -> Judged:
    """What the reference says of a verdict."""
    judge, action, status = LinearJudge(problem), verdict.action, verdict.status.value
    kept = status in ("passed", "corrected")
    unsafe_now = bool((judge.now / judge.scale < -judge.rounding - _SIGN).any())
    safe_now = bool((judge.now / judge.scale > judge.rounding).all())
    broken = judge.broken(action) if kept else None
    missed, shortfall, needless = (False, None, False) if kept else _least_violation(problem, judge, verdict)
    return Judged(
        status=status,
        out_of_bounds=bool((action < problem.low).any() or (action > problem.high).any()),
        altered=status == "passed" and not np.array_equal(action, problem.nominal),
        broken=broken,
        below=kept and (verdict.h_next < 0.0 or judge.lowest(action) < -_SIGN),
        untold=(unsafe_now and status != "violated") or (safe_now and status == "violated"),
        excess=_excess(judge, verdict) if status == "corrected" and broken is not None and broken <= BROKEN else None,
        missed=missed,
        shortfall=shortfall,
        needless=needless,
        reason=verdict.reason,
    )


def _least_violation(problem: LinearProblem, judge: LinearJudge, verdict: Verdict) -> tuple[bool, float, bool]:
    action, status = verdict.action, verdict.status.value
    room, keeper = judge.best_least_residual()
    if problem.witness is not None:
        room = max(room, float(judge.residuals(problem.witness).min()))
    best, lifted = judge.best_least_height()
    best = max(best, float(judge.movable(keeper).min()))
    own = float(judge.movable(action).min())
    safe = bool((judge.heights(lifted) >= 0.0).all() or (judge.heights(keeper) >= 0.0).all())
    needless = status != "violated" and float(judge.heights(action).min()) < -BROKEN and safe
    if judge.keeps_movable(action, BROKEN):
        best = own
    return status != "violated" and room > BROKEN, max(0.0, best - own), needless


def _excess(judge: LinearJudge, verdict: Verdict) -> float | None:
    nearest = judge.nearest()
    return None if nearest is None else max(0.0, judge.distance(verdict.action) - nearest.distance)
