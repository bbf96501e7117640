"""The last minutes of one robot: bounded, and cut into a run for a search."""

from __future__ import annotations

from collections import deque
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.records.run import Run, Stretch
from safedpa.systems import System

__all__ = ["History"]

Vector = NDArray[np.float64]


@final
class History:
    """States and the actions that followed them, at most ``longest`` [s] of them."""

    def __init__(self, system: System, period: float, longest: float = 120.0) -> None:
        self._system = system
        self._period = period
        self._rows: deque[tuple[int, Vector, Vector]] = deque(maxlen=max(2, round(longest / period)))
        """Tick, state, and what was applied before it."""

    def add(self, tick: int, state: Vector, applied: Vector) -> None:
        """Keeps one tick; one that cannot be believed is left out, which makes a gap."""
        if self._system.is_plausible(state) and np.isfinite(applied).all():
            self._rows.append((tick, state, applied))

    def last(self, seconds: float) -> list[tuple[int, Vector, Vector]]:
        """Tick, state, and what was applied before it, of the newest rows."""
        return list(self._rows)[-max(1, round(seconds / self._period)) :]

    def seconds_since(self, tick: int) -> float:
        """How much of the time from a tick on is kept [s]."""
        return self._period * sum(row[0] >= tick for row in self._rows)

    def excerpt(self, first: int, name: str) -> Run:
        """The rows from tick ``first`` on as a run, cut where ticks are missing, its time the robot's."""
        rows = [row for row in self._rows if row[0] >= first]
        ticks = np.array([row[0] for row in rows], dtype=np.int64)
        states = np.array([row[1] for row in rows]).reshape(len(rows), len(self._system.state))
        before = np.array([row[2] for row in rows]).reshape(len(rows), len(self._system.action))
        # the action of a row holds until the next one: it is reported with the next tick
        known = np.append(np.diff(ticks) == 1, False)[: len(rows)]
        actions = np.where(known[:, None], np.roll(before, -1, axis=0), 0.0)
        t = np.asarray(ticks * self._period, dtype=np.float64)
        ends = np.flatnonzero(~known)
        starts = np.append(0, ends + 1)[: len(ends)]
        # a stretch ends before the row whose action is not known
        stretches = [Stretch(int(begin), int(end)) for begin, end in zip(starts, ends, strict=True) if end - begin > 1]
        for index in range(2, len(self._system.state)):
            if index in self._system.angles:
                states[:, index] = _unwrapped(states[:, index])
        return Run(name, self._system, t, states, actions, tuple(stretches))


def _unwrapped(angles: Vector) -> Vector:
    return np.asarray(np.unwrap(angles)) if len(angles) else angles
