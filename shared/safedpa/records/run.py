"""A recorded run: time, states and actions of one robot, cut into stretches without defects."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from safedpa.systems import System

__all__ = ["Finding", "RawRows", "Run", "Stretch"]


@dataclass(frozen=True)
class RawRows:
    """t (rows,), states (rows, states) and actions (rows, actions) of a log, before its quality was checked."""

    t: NDArray[np.float64]
    states: NDArray[np.float64]
    actions: NDArray[np.float64]

    def taken(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> RawRows:
        """Some of the rows."""
        return RawRows(self.t[index], self.states[index], self.actions[index])


@dataclass(frozen=True)
class Finding:
    """A fact about the quality of the data that the user should know."""

    kind: str
    """Such as gap, repeated_row, not_a_number, clock_reset, jump, constant_input."""
    message: str
    """A sentence: what was found, how often, where first, and what was done about it."""
    count: int = 1
    start_t: float | None = None
    """Time of the first occurrence, s."""


@dataclass(frozen=True)
class Stretch:
    """Rows ``start`` to ``stop`` (exclusive) of a run, without a gap, jump or missing value."""

    start: int
    stop: int

    def __len__(self) -> int:
        return self.stop - self.start


@dataclass(frozen=True)
class Run:
    """One recording, in SI units and radians, angles unwrapped.

    t (samples,) [s] grows strictly within each stretch; states (samples, states); actions (samples, actions), where the
    action of a row is applied until the next row. Defective rows are removed; do not compute across the border of two
    stretches. Time is that of the source, possibly seconds since 1970: compute differences in float64.
    """

    name: str
    system: System
    t: NDArray[np.float64]
    states: NDArray[np.float64]
    actions: NDArray[np.float64]
    stretches: tuple[Stretch, ...]
    findings: tuple[Finding, ...] = ()

    @cached_property  # cached: used for each stretch, and a log can have thousands
    def period(self) -> float:
        """Median time between rows [s]."""
        steps = [np.diff(self.t[part.start : part.stop]) for part in self.stretches if len(part) > 1]
        return float(np.median(np.concatenate(steps))) if steps else float("nan")

    @property
    def duration(self) -> float:
        """Total duration of the stretches, s."""
        return float(sum(self.t[part.stop - 1] - self.t[part.start] for part in self.stretches if len(part)))

    def parts(self) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]:
        """Yields (t, states, actions) of each stretch."""
        for part in self.stretches:
            rows = slice(part.start, part.stop)
            yield self.t[rows], self.states[rows], self.actions[rows]
