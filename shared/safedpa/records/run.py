"""A recorded run: time, states and actions of one robot, cut into stretches that can be trusted."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from safedpa.systems import System

__all__ = ["Finding", "Run", "Stretch"]


@dataclass(frozen=True)
class Finding:
    """Something about the data's quality that a person should know."""

    kind: str
    """One word or two, with underscores: gap, repeated_row, not_a_number, clock_reset, jump, constant_input, ..."""
    message: str
    """One sentence: what was found, how often, where first, and what was done about it."""
    count: int = 1
    start_t: float | None = None
    """s; where it occurs first."""


@dataclass(frozen=True)
class Stretch:
    """Rows start to stop (exclusive) of a run, without gap, jump or missing value between them."""

    start: int
    stop: int

    def __len__(self) -> int:
        return self.stop - self.start


@dataclass(frozen=True)
class Run:
    """One recording, in SI units and radians, angles unwrapped.

    t (samples,) [s] grows strictly within each stretch; states (samples, states); actions (samples, actions), where the
    action of a row holds until the next row. What was cut is not in the arrays any more; nothing may be carried across
    the border of two stretches. Time is that of the source: seconds since 1970 where the log says so, so take
    differences in float64.
    """

    name: str
    system: System
    t: NDArray[np.float64]
    states: NDArray[np.float64]
    actions: NDArray[np.float64]
    stretches: tuple[Stretch, ...]
    findings: tuple[Finding, ...] = ()

    @cached_property  # asked for stretch by stretch, of which a log may have thousands
    def period(self) -> float:
        """Median time between rows [s]."""
        steps = [np.diff(self.t[part.start : part.stop]) for part in self.stretches if len(part) > 1]
        return float(np.median(np.concatenate(steps))) if steps else float("nan")

    @property
    def duration(self) -> float:
        """Seconds inside the stretches."""
        return float(sum(self.t[part.stop - 1] - self.t[part.start] for part in self.stretches if len(part)))

    def parts(self) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]:
        """(t, states, actions) of each stretch."""
        for part in self.stretches:
            rows = slice(part.start, part.stop)
            yield self.t[rows], self.states[rows], self.actions[rows]
