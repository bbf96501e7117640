"""Channels that break: they jump by more than their own motion explains, or be stationary while the robot moves.

Being stationary are a frozen sensor, and commands that are no longer recorded.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import BoolArray, FloatArray
from safedpa.records.column_map.apply import Rows
from safedpa.records.column_map.derive import slopes_within
from safedpa.records.quality.clock import change_rows, hold_rows
from safedpa.records.quality.findings import count_text, finding
from safedpa.records.run import Finding, Stretch
from safedpa.systems import System

__all__ = ["dead_rows", "frozen_rows", "jump_rows"]

Found = tuple[BoolArray, list[Finding]]

_LONG = 2.0
"""s without a change to the last digit, at least, and this many rows:"""
_ROWS = 20
_RARE = 0.3
"""Share of the other rows in which such a channel may repeat itself: one that always does, does not freeze."""
_MOVES = 0.1
"""Of its own range by which another channel has to move meanwhile."""
_DEAD = 3.0
"""s in which a command may stay the same, at least, and this share of the run:"""
_DEAD_SHARE = 0.25
_EXPLAINS = 0.3
"""Share of what moves elsewhere that a command has to explain, before its silence says anything."""
_AS_MUCH, _FAR = 0.5, 4.0
"""Of the usual changes, and times what a regression leaves elsewhere, by which the robot has to go on otherwise."""
_WINDOW = 0.3
"""s over which slopes are taken."""


def frozen_rows(rows: Rows, stretches: list[Stretch], system: System, measured: list[bool]) -> Found:
    """Rows in which a measured state is stationary to the last digit while other states, or commands, change."""
    bad = np.zeros(len(rows.t), dtype=bool)
    found = []
    for index, variable in enumerate(system.state):
        if not measured[index]:
            continue
        values = rows.states[:, index]
        spans = _still(rows.t, values, stretches, _LONG)
        others = np.concatenate([np.delete(rows.states, index, axis=1), rows.actions], axis=1)
        spans = [span for span in spans if _others_move(others, span)]
        if not spans or not _alive(values, spans):
            continue
        for span in spans:
            bad[span] = True
        seconds = sum(float(rows.t[span.stop - 1] - rows.t[span.start]) for span in spans)
        text = (
            f"{variable.name} is stationary at {values[spans[0].start]:.4g} {variable.unit} to the last digit for "
            f"{seconds:.3g} s while the rest moves: its sensor looks frozen"
        )
        count = sum(span.stop - span.start for span in spans)
        done = 'cut out; if it did be stationary, say keep = ["frozen"] in a column map'
        found.append(finding("frozen", text, count, rows.t[spans[0].start], done))
    return bad, found


def dead_rows(rows: Rows, stretches: list[Stretch], system: System) -> Found:
    """Rows in which a command is 0 for long, or the same to the end, while what it drives elsewhere goes on changing.

    In between, commands may well be held: that is a manoeuvre.
    """
    bad = np.zeros(len(rows.t), dtype=bool)
    found = []
    whole = sum(float(rows.t[part.stop - 1] - rows.t[part.start]) for part in stretches)
    motion = _motion(rows, stretches, system)
    for index, variable in enumerate(system.action):
        spans = _still(rows.t, rows.actions[:, index], stretches, max(_DEAD, _DEAD_SHARE * whole))
        spans = [
            span
            for span in spans
            if (rows.actions[span.start, index] == 0.0 or span.stop >= stretches[-1].stop)
            and _goes_on(motion, rows, system, index, span)
        ]
        if not spans:
            continue
        for span in spans:
            bad[span] = True
        first = spans[0]
        seconds = sum(float(rows.t[span.stop - 1] - rows.t[span.start]) for span in spans)
        text = (
            f"{variable.name} stays at {rows.actions[first.start, index]:.4g} {variable.unit} for {seconds:.3g} s "
            "while the robot goes on as if it were commanded: its recording looks dead"
        )
        count = sum(span.stop - span.start for span in spans)
        done = 'cut out; if it was commanded so, say keep = ["dead_command"] in a column map'
        found.append(finding("dead_command", text, count, rows.t[first.start], done))
    return bad, found


def _still(t: FloatArray, values: FloatArray, stretches: list[Stretch], seconds: float) -> list[slice]:
    """Spans of rows inside stretches, of at least so many seconds, in which a channel does not change at all."""
    spans = []
    for part in stretches:
        own = values[part.start : part.stop]
        edges = np.flatnonzero(np.diff(own) != 0.0) + 1
        bounds = np.concatenate([[0], edges, [len(own)]]) + part.start
        lengths = np.diff(bounds)
        for number in np.flatnonzero(lengths > _ROWS).tolist():
            low, high = int(bounds[number]), int(bounds[number + 1])
            if t[high - 1] - t[low] >= seconds:
                spans.append(slice(low, high))
    return spans


def _others_move(others: NDArray[np.float64], span: slice) -> bool:
    """Whether a channel among some (rows, channels) moves by much in a span."""
    whole = np.nanquantile(others, 0.99, axis=0) - np.nanquantile(others, 0.01, axis=0)
    part = np.ptp(others[span], axis=0)
    return bool(((whole > 1e-9) & (part > _MOVES * whole)).any())


def _alive(values: FloatArray, spans: list[slice]) -> bool:
    """Whether a channel changes nearly always outside some spans."""
    outside = np.ones(len(values), dtype=bool)
    for span in spans:
        outside[span] = False
    steps = np.diff(values)[outside[1:] & outside[:-1]]
    return len(steps) > _ROWS and float((steps == 0.0).mean()) < _RARE


def _motion(rows: Rows, stretches: list[Stretch], system: System) -> NDArray[np.float64]:
    """Slopes of the states (rows, states), NaN outside stretches; of positions none, which follow from speeds."""
    found = np.full(rows.states.shape, np.nan)
    for index, variable in enumerate(system.state):
        if variable.unit != "m":
            found[:, index] = slopes_within(rows.t, rows.states[:, index], stretches, _WINDOW)
    return found


def _goes_on(motion: NDArray[np.float64], rows: Rows, system: System, action: int, span: slice) -> bool:
    """Whether some slope that the command explains elsewhere is far from what the command asks for in a span.

    Slopes are regressed on states, actions and their products, without the span; there what is left is compared.
    """
    outside = np.ones(len(rows.t), dtype=bool)
    outside[span] = False
    states, actions = rows.states - np.nanmean(rows.states, axis=0), rows.actions
    products = [
        actions[:, index, None] * part for index in range(actions.shape[1]) for part in (states, np.abs(states))
    ]
    every = np.hstack([states, np.ones((len(rows.t), 1)), actions, *products])
    still = np.hstack([states, np.ones((len(rows.t), 1)), np.delete(actions, action, axis=1)])
    for slopes in motion.T:
        good = np.isfinite(slopes) & np.isfinite(every).all(axis=1)
        there, here = good & outside, good & ~outside
        if there.sum() < 10 * every.shape[1] or here.sum() < _ROWS:
            continue
        spread = float(np.var(slopes[there]))
        without, usual = (_left(part, slopes, there, there) for part in (still, every))
        now = min(_left(every, slopes, there, here), float(np.var(slopes[here])))
        if without - usual > _EXPLAINS * spread and now > max(_AS_MUCH * spread, _FAR * usual):
            return True
    return False


def _left(columns: NDArray[np.float64], wanted: FloatArray, fitted: BoolArray, judged: BoolArray) -> float:
    """Mean square that a linear regression over some rows leaves in others."""
    size = np.linalg.norm(columns[fitted], axis=0) + 1e-12
    solution = np.linalg.lstsq(columns[fitted] / size, wanted[fitted], rcond=1e-9)[0]
    return float(np.mean((wanted[judged] - (columns[judged] / size) @ solution) ** 2))


_SMALLEST_JUMP = {"m": 0.1, "rad": 0.3, "m/s": 1.5, "rad/s": 5.0}
"""Smaller steps are never called jumps: they are noise, or a harmless part of the motion."""
_NEIGHBOURS = 5
_TIMES_MEDIAN = 4.0
_BLOCK = 100_000


def jump_rows(
    rows: Rows, stretches: list[Stretch], system: System, measured: list[bool]
) -> tuple[NDArray[np.bool_], list[Finding]]:
    """Rows behind a jump of a measured state.

    A step |x[k+1] - x[k]| is a jump when it exceeds a floor plus 4 times the median rate of the five steps on either
    side, times its own duration: the change is then not explained by the speed around it. A held column is judged at
    the rows where it changes.
    """
    mask = np.zeros(len(rows.t), dtype=bool)
    found = []
    for index, variable in enumerate(system.state):
        floor = _SMALLEST_JUMP.get(variable.unit)
        if floor is None or not measured[index]:
            continue
        at, largest = _jumps(rows.t, rows.states[:, index], stretches, floor)
        if len(at):
            mask[at] = True
            text = (
                f"{variable.name} jumps {count_text(len(at), 'time', 'times')} by up to {largest:.4g} {variable.unit}"
            )
            text += ", more than the motion around explains"
            found.append(finding("jump", text, len(at), rows.t[at[0]], "cut there"))
    return mask, found


def _jumps(
    t: NDArray[np.float64], values: NDArray[np.float64], stretches: list[Stretch], floor: float
) -> tuple[NDArray[np.intp], float]:
    found, largest = [], 0.0
    for stretch in stretches:
        part = values[stretch.start : stretch.stop]
        at = np.arange(len(part))
        if hold_rows(part) > 1.0:
            at = np.append(0, change_rows(part))
        steps = np.abs(np.diff(part[at]))
        large = np.flatnonzero(steps > floor)
        times = np.diff(t[stretch.start : stretch.stop][at])
        usual = _TIMES_MEDIAN * _usual_rate(steps / times, large) * times[large]
        jumps = large[steps[large] > floor + usual]
        found.append(at[jumps + 1] + stretch.start)
        largest = max(largest, float(steps[jumps].max(initial=0.0)))
    return np.concatenate(found) if found else np.empty(0, dtype=np.intp), largest


def _usual_rate(rates: NDArray[np.float64], rows: NDArray[np.intp]) -> NDArray[np.float64]:
    """Median of each rate and its neighbours on either side, at some rows, in blocks to bound the memory."""
    if not len(rows):
        return np.empty(0)
    padded = np.pad(rates, _NEIGHBOURS, mode="reflect" if len(rates) > _NEIGHBOURS else "edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _NEIGHBOURS + 1)
    return np.concatenate([np.median(windows[rows[k : k + _BLOCK]], axis=1) for k in range(0, len(rows), _BLOCK)])
