"""At what time of its run a model is asked, for who asks it tick by tick: filter, estimator, policy."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["RunClock"]


@dataclass
class RunClock:
    """Seconds since the start of the run, 0 until somebody says; what a call says as ``time`` counts from there.

    Who serves several robots with one model sets it anew before each question.
    """

    seconds: float = 0.0
