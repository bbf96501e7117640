"""Windows: intervals of recordings over which open-loop predictions are compared with measurements."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray, IndexArray
from safedpa.errors import InputError, RunError
from safedpa.records.run import Run
from safedpa.systems import System

# Largest relative difference of periods that count as equal: rounding of recorded time stamps.
_SAME_PERIOD = 1e-6


@dataclass(frozen=True)
class Windows:
    """All windows of all runs, as indices into one table of the trusted rows of all runs.

    A window consists of a row and the ``steps`` rows after it; it never leaves its stretch (rows without a gap).
    Shapes: ``t``, ``time``, ``clock``, ``period`` (rows,), ``states`` (rows, states), ``actions`` (rows, actions);
    ``bounds`` (stretches, 2) with the first row of a stretch and one past the last; ``start``, ``steps``, ``begin``,
    ``run`` (windows,).
    """

    system: System
    names: tuple[str, ...]
    """Names of the runs."""
    horizon: float
    """Length of a window [s]."""
    t: FloatArray
    """Time as recorded [s]."""
    time: FloatArray
    """Time since the first trusted row of the run [s]."""
    clock: FloatArray
    """Time that increases over the whole table [s], with a gap longer than the horizon between stretches."""
    period: FloatArray
    """Time to the next row [s]; at the last row of a stretch the run's median, which nothing uses."""
    states: FloatArray
    actions: FloatArray
    bounds: IndexArray
    start: IndexArray
    """Row at which the window starts."""
    steps: IndexArray
    begin: IndexArray
    """First row of the window's stretch."""
    run: IndexArray
    """Index of the window's run in ``names``."""
    memo: dict[Any, dict[str, FloatArray]] = field(default_factory=dict, repr=False, compare=False)
    """Cache of effective actions by command effects and their parameters; shared by all selections of one table."""

    def __len__(self) -> int:
        return len(self.start)

    @property
    def end(self) -> IndexArray:
        """Last row of each window, shape (windows,)."""
        return self.start + self.steps

    @cached_property
    def common_period(self) -> float | None:
        """The period [s] of all rows; None if rows are spaced irregularly."""
        middle = float(np.median(self.period))
        return middle if np.ptp(self.period) <= _SAME_PERIOD * middle else None

    def rows_after(self, seconds: float) -> IndexArray:
        """Returns the row closest to ``seconds`` after each start and inside the window, (windows,)."""
        wanted = self.clock[self.start] + seconds
        later = np.clip(np.searchsorted(self.clock, wanted), self.start + 1, self.end)
        earlier = np.maximum(later - 1, self.start + 1)
        nearer = wanted - self.clock[earlier] <= self.clock[later] - wanted
        return np.asarray(np.where(nearer, earlier, later), dtype=np.int64)

    def select(self, index: IndexArray | NDArray[np.bool_]) -> Windows:
        """Returns the same table with a selection of the windows."""
        return replace(
            self,
            start=self.start[index],
            steps=self.steps[index],
            begin=self.begin[index],
            run=self.run[index],
        )


def windows_of(
    runs: Sequence[Run], horizon: float, *, stride: int = 10, every: float | None = None, partial: bool = False
) -> Windows:
    """Returns windows of ``horizon`` [s] from every ``stride``-th trusted row of each run, or from every ``every`` [s].

    The last row of a window is the last one up to the horizon plus half the run's median period. Windows that reach
    beyond their stretch are dropped; with ``partial`` they are kept with the rows that exist.

    Raises InputError for a horizon that is not positive, shorter than half a period or longer than every stretch.
    Raises RunError for runs of different systems, without rows, or with values that are not finite.
    """
    if not (math.isfinite(horizon) and horizon > 0):
        raise InputError(f"horizon: got {horizon} s, wanted a positive number of seconds, such as 1")
    check_runs(runs)
    table = _table(runs, horizon)
    strides = [stride if every is None else max(1, round(every / run.period)) for run in runs]
    counts = [sum(len(part) for part in run.stretches) for run in runs]
    chosen = [np.arange(count) % step == 0 for count, step in zip(counts, strides, strict=True)]
    rows = np.flatnonzero(np.concatenate(chosen))
    stretch = np.searchsorted(table.bounds[:, 1], rows, side="right")
    last = table.bounds[stretch, 1] - 1
    run = np.repeat(np.arange(len(runs)), [len(item.stretches) for item in runs])[stretch]
    half = 0.5 * np.array([item.period for item in runs])[run]
    until = np.searchsorted(table.clock, table.clock[rows] + horizon + half, side="right") - 1
    steps = np.minimum(until, last) - rows
    whole = (table.clock[last] >= table.clock[rows] + horizon - half) & (steps > 0)
    if not whole.any():
        raise _no_window(runs, horizon)
    retained = steps > 0 if partial else whole
    begin = table.bounds[stretch, 0]
    return replace(table, start=rows[retained], steps=steps[retained], begin=begin[retained], run=run[retained])


def check_runs(runs: Sequence[Run]) -> None:
    """Raises RunError for runs of different systems, without rows, or with values that are not finite."""
    if not runs:
        raise RunError("runs: got none, wanted at least one recording")
    for run in runs:
        if (run.system.name, run.system.state_names, run.system.action_names) != _columns_of(runs[0].system):
            raise RunError(
                f"{run.name}: a run of robot '{run.system.name}' with actions {', '.join(run.system.action_names)} "
                f"next to {runs[0].name} of '{runs[0].system.name}' with {', '.join(runs[0].system.action_names)}; "
                "compare them one at a time"
            )
        if not any(len(part) > 1 for part in run.stretches):
            raise RunError(f"{run.name}: no two rows that can be used follow each other; see its data quality findings")
        for _, states, actions in run.parts():
            if not (np.isfinite(states).all() and np.isfinite(actions).all()):
                raise RunError(f"{run.name}: got values that are not finite inside a stretch; cut those rows out")


def _columns_of(system: System) -> tuple[str, tuple[str, ...], tuple[str, ...]]:
    return system.name, system.state_names, system.action_names


def _table(runs: Sequence[Run], horizon: float) -> Windows:
    t, time, clock, period, bounds = [], [], [], [], []
    row, elapsed = 0, 0.0
    for run in runs:
        first = next(part_t[0] for part_t, _, _ in run.parts() if len(part_t))
        for part_t, _, _ in run.parts():
            bounds.append((row, row + len(part_t)))
            row += len(part_t)
            if not len(part_t):
                continue
            t.append(part_t)
            time.append(part_t - first)
            clock.append(part_t - part_t[0] + elapsed)
            period.append(np.append(np.diff(part_t), run.period))
            # A gap longer than any window, so that a search by clock never crosses a stretch.
            elapsed = float(clock[-1][-1]) + 2.0 * horizon + 1.0
    empty = np.zeros(0, dtype=np.int64)
    return Windows(
        system=runs[0].system,
        names=tuple(run.name for run in runs),
        horizon=horizon,
        t=np.concatenate(t),
        time=np.concatenate(time),
        clock=np.concatenate(clock),
        period=np.concatenate(period),
        states=np.concatenate([states for run in runs for _, states, _ in run.parts()]),
        actions=np.concatenate([actions for run in runs for _, _, actions in run.parts()]),
        bounds=np.array(bounds, dtype=np.int64),
        start=empty,
        steps=empty,
        begin=empty,
        run=empty,
    )


def _no_window(runs: Sequence[Run], horizon: float) -> InputError:
    longest = max(part_t[-1] - part_t[0] for run in runs for part_t, _, _ in run.parts() if len(part_t))
    period = min(run.period for run in runs)
    if horizon < period:
        return InputError(f"horizon: got {horizon} s, the rows are {period:.4g} s apart; choose at least that")
    # Windows begin at some rows only: here only in shorter stretches, or before a long time step.
    if horizon <= longest:
        return InputError(
            f"horizon: got {horizon} s, but no window begins in a part without a gap of that length, although the "
            f"longest stretch without a gap lasts {longest:.4g} s; choose another horizon, or begin more windows"
        )
    cuts = [finding.message for run in runs for finding in run.findings if finding.kind == "gap"]
    why = f" ({cuts[0]})" if cuts else ""
    lasts = f"the longest stretch without a gap lasts {longest:.4g} s{why}"
    return InputError(f"horizon: got {horizon} s, {lasts}; choose a shorter horizon")
