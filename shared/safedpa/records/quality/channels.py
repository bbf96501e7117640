"""Checks of channels: jumps, frozen sensors, and commands that are no longer recorded."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import BoolArray, FloatArray
from safedpa.records.quality.clock import change_rows, hold_rows
from safedpa.records.quality.findings import count_text, finding
from safedpa.records.quality.response import Response, response_of
from safedpa.records.run import Finding, RawRows, Stretch
from safedpa.systems import System

__all__ = ["dead_rows", "frozen_rows", "jump_rows", "quantised_findings", "spike_rows"]

Found = tuple[BoolArray, list[Finding]]

_FROZEN_SECONDS = 2.0
"""A frozen sensor does not change at all for at least so many seconds,"""
_FROZEN_ROWS = 20
"""and so many rows."""
_NOTHING = 1e-300
"""Smaller numbers are zeros over a part of a number."""
_FEWEST_ZEROS = 3
"""Rows of zeros, of a sensor that is lost for a moment or in a file without checksums."""
_MAX_REPEATS = 0.3
"""Largest share of repeated values elsewhere; a channel that often repeats values is slow, not frozen."""
_MIN_MOTION = 0.1
"""Share of its range by which another channel must move meanwhile."""
_DEAD_SECONDS = 3.0
"""A dead command is constant for at least so many seconds,"""
_DEAD_SHARE = 0.25
"""and this share of the run."""
_MATTERS = 1.5
"""How many times more is unexplained outside a span without a command that matters."""
_CONTRADICTS, _AS_WITHOUT = 4.0, 0.4
"""In a dead span more than this multiple of the usual is unexplained, and this share of that without the command."""
_STEPS_AFTER = 4.0
"""Multiples of a quick step by which a state may differ after it stood: a frozen sensor has missed a motion."""
_FOLLOWS = 0.7
"""Correlation from which a rate is that of a state."""
_LEAST_LEVELLED, _FEWEST_LEVELS, _MOST_REPEATED = 200, 4, 0.5
"""Rows that a check for steps needs, levels that make a grid, and levels as a share of the rows."""
_COARSE, _ON_GRID = 0.02, 0.02
"""Share of a state's range from which a step is coarse, and distance from the grid in steps."""


def frozen_rows(rows: RawRows, stretches: list[Stretch], system: System, measured: list[bool]) -> Found:
    """Rows in which a measured state does not change at all while other states or commands do."""
    bad = np.zeros(len(rows.t), dtype=bool)
    found = []
    for index, variable in enumerate(system.state):
        if not measured[index]:
            continue
        values = rows.states[:, index]
        spans = _unchanged_spans(rows.t, values, stretches, _FROZEN_SECONDS)
        spans += [span for span in _zero_spans(values) if span not in spans]
        others = np.concatenate([np.delete(rows.states, index, axis=1), rows.actions], axis=1)
        spans = [span for span in spans if _others_move(others, span)]
        if not spans or not _usually_changes(values, spans):
            continue
        spans = [span for span in spans if not _stands(rows, index, span, system)]
        if not spans:
            continue
        for span in spans:
            bad[span] = True
        seconds = sum(float(rows.t[span.stop - 1] - rows.t[span.start]) for span in spans)
        text = (
            f"{variable.name} stays at exactly {values[spans[0].start]:.4g} {variable.unit} for "
            f"{seconds:.3g} s while the rest moves: its sensor looks frozen"
        )
        count = sum(span.stop - span.start for span in spans)
        done = 'cut out; if it really did not change, set keep = ["frozen"] in a column map'
        found.append(finding("frozen", text, count, rows.t[spans[0].start], done))
    return bad, found


def dead_rows(rows: RawRows, stretches: list[Stretch], system: System) -> Found:
    """Rows in which a command is 0 for long, or constant to the end, while the robot moves as if commanded.

    A constant command in the middle of a run is a manoeuvre, not a defect.
    """
    bad = np.zeros(len(rows.t), dtype=bool)
    found: list[Finding] = []
    total_time = sum(float(rows.t[part.stop - 1] - rows.t[part.start]) for part in stretches)
    response = response_of(rows, stretches, system)
    if response is None:
        return bad, found
    for index, variable in enumerate(system.action):
        shortest = max(_DEAD_SECONDS, _DEAD_SHARE * total_time)
        spans = _unchanged_spans(rows.t, rows.actions[:, index], stretches, shortest)
        spans += [span for span in _zero_spans(rows.actions[:, index]) if span not in spans]
        spans = [
            span
            for span in spans
            if (rows.actions[span.start, index] == 0.0 or span.stop >= stretches[-1].stop)
            and _contradicts_command(response, index, rows.t[span.start], rows.t[span.stop - 1])
        ]
        if not spans:
            continue
        for span in spans:
            bad[span] = True
        first = spans[0]
        seconds = sum(float(rows.t[span.stop - 1] - rows.t[span.start]) for span in spans)
        text = (
            f"{variable.name} stays at {rows.actions[first.start, index]:.4g} {variable.unit} for {seconds:.3g} s "
            "while the robot moves as if it were commanded: its recording looks dead"
        )
        count = sum(span.stop - span.start for span in spans)
        done = 'cut out; if it was commanded so, set keep = ["dead_command"] in a column map'
        found.append(finding("dead_command", text, count, rows.t[first.start], done))
    return bad, found


def _unchanged_spans(t: FloatArray, values: FloatArray, stretches: list[Stretch], seconds: float) -> list[slice]:
    """Spans within stretches of at least ``seconds`` in which a channel does not change at all."""
    spans = []
    for part in stretches:
        own = values[part.start : part.stop]
        edges = np.flatnonzero(np.diff(own) != 0.0) + 1
        bounds = np.concatenate([[0], edges, [len(own)]]) + part.start
        lengths = np.diff(bounds)
        for number in np.flatnonzero(lengths > _FROZEN_ROWS).tolist():
            low, high = int(bounds[number]), int(bounds[number + 1])
            if t[high - 1] - t[low] >= seconds:
                spans.append(slice(low, high))
    return spans


def _zero_spans(values: FloatArray) -> list[slice]:
    """Spans of zeros between steps that the channel never makes otherwise: lost, or overwritten in a file."""
    largest = _largest_step(values)
    zero = np.concatenate([[False], np.abs(values) < _NOTHING, [False]]).astype(np.int8)
    found = []
    for low, high in np.flatnonzero(np.diff(zero)).reshape(-1, 2).tolist():
        inside = low > 0 and high < len(values) and high - low >= _FEWEST_ZEROS
        edges = sorted((abs(values[low - 1]), abs(values[high]))) if inside else (0.0, 0.0)
        if edges[0] > largest / _STEPS_AFTER and edges[1] > largest:
            found.append(slice(low, high))
    return found


def _largest_step(values: FloatArray) -> float:
    """Step that a channel never makes but by a fault; infinite if it hardly ever changes."""
    steps = np.abs(np.diff(values))
    moving = steps[(steps > 0.0) & np.isfinite(steps)]
    return _STEPS_AFTER * float(np.quantile(moving, 0.99)) if len(moving) >= _FROZEN_ROWS else np.inf


def spike_rows(rows: RawRows, known: BoolArray, system: System, measured: list[bool]) -> Found:
    """Single rows in which a measured state is far from both neighbours, to the same side; without those ``known``."""
    bad = np.zeros(len(rows.t), dtype=bool)
    found = []
    for index, variable in enumerate(system.state):
        values = rows.states[:, index]
        steps = np.diff(values)
        largest = _largest_step(values)
        if not measured[index] or not np.isfinite(largest):
            continue
        small = np.minimum(np.abs(steps[:-1]), np.abs(steps[1:]))
        at = np.flatnonzero((steps[:-1] * steps[1:] < 0.0) & (small > largest)) + 1
        at = at[~known[at]]
        if len(at):
            bad[at] = True
            text = f"{variable.name} has {count_text(len(at), 'value', 'values')} that neither neighbour explains"
            done = 'cut out; if it is real, set keep = ["jump"] in a column map'
            found.append(finding("jump", text, len(at), rows.t[at[0]], done))
    return bad, found


def _others_move(others: NDArray[np.float64], span: slice) -> bool:
    """Whether any of the channels ``others`` (rows, channels) moves substantially in a span."""
    whole = np.nanquantile(others, 0.99, axis=0) - np.nanquantile(others, 0.01, axis=0)
    part = np.ptp(others[span], axis=0)
    return bool(((whole > 1e-9) & (part > _MIN_MOTION * whole)).any())


def _stands(rows: RawRows, index: int, span: slice, system: System) -> bool:
    """Whether a state that reads the same really stood: stops, brakes, end stops and overflows are no defects.

    The change that its rate implies for the span is small, if it has one, and afterwards it goes on without a step. A
    span that ends with the log must be at an extreme of the state, or have a rate.
    """
    values = rows.states[:, index]
    steps = np.abs(np.diff(values))
    moving = steps[(steps > 0.0) & np.isfinite(steps)]
    if not len(moving):
        return False
    largest = _STEPS_AFTER * float(np.quantile(moving, 0.99))
    before, after = max(span.start - 1, 0), min(span.stop, len(values) - 1)
    if max(abs(values[after] - values[span.stop - 1]), abs(values[span.start] - values[before])) > largest:
        return False
    implied = _implied_change(rows, index, span, system)
    if implied is not None:
        return implied <= max(largest, _MIN_MOTION * float(np.ptp(values[np.isfinite(values)])))
    extremes = np.nanmin(values), np.nanmax(values)
    return bool(span.stop < len(values) or values[span.start] in extremes)


def _implied_change(rows: RawRows, index: int, span: slice, system: System) -> float | None:
    """Largest change in a span that the measured rate of a state implies; None if no rate follows its changes."""
    unit, t, values = system.state[index].unit, rows.t, rows.states[:, index]
    found = None
    for other, item in enumerate(system.state):
        rate = rows.states[:, other]
        good = np.isfinite(rate) & np.isfinite(values) & np.isfinite(t)
        good[span] = False
        if item.unit != f"{unit}/s" or good.sum() < _FROZEN_ROWS:
            continue
        both = good[1:] & good[:-1]
        follows = np.corrcoef(np.diff(values)[both], (rate[1:] * np.diff(t))[both])[0, 1] if both.sum() > 2 else 0.0
        if follows > _FOLLOWS:
            way = np.abs(np.nancumsum(rate[span] * np.gradient(t[span])))
            found = max(found or 0.0, float(way.max()))
    return found


def quantised_findings(rows: RawRows, stretches: list[Stretch], system: System, measured: list[bool]) -> list[Finding]:
    """Reports measured states that have coarse steps, throughout or from some time on; nothing is cut."""
    found = []
    used = np.concatenate([np.arange(part.start, part.stop) for part in stretches] or [np.empty(0, dtype=np.intp)])
    for index, item in enumerate(system.state):
        values = rows.states[used, index]
        values = values[np.isfinite(values)]
        if not measured[index] or len(values) < _LEAST_LEVELLED:
            continue
        begin, step = _levels(values)
        if not step or step < _COARSE * float(np.quantile(values, 0.99) - np.quantile(values, 0.01)):
            continue
        text = f"{item.name} has steps of {step:.3g} {item.unit}" + ("" if begin else " throughout")
        text += ", which is coarse for how it moves: nothing smaller can be seen in it"
        found.append(finding("quantised", text, len(values) - begin, rows.t[used[begin]], "nothing was cut for it"))
    return found


def _levels(values: FloatArray) -> tuple[int, float]:
    """First row from which all values lie on a grid, and its step; step 0 if the last quarter of the log does not."""
    last = values[-(len(values) // 4) :]
    levels = np.unique(last)
    gaps = np.diff(levels)
    gaps = gaps[gaps > 1e-9 * max(1e-300, float(np.abs(levels).max()))]
    if len(gaps) < _FEWEST_LEVELS - 1 or len(levels) > _MOST_REPEATED * len(last):
        return 0, 0.0
    step = float(gaps.min())
    if np.ptp(last) > step * len(last):
        return 0, 0.0
    offset = np.abs((values - levels[0]) / step - np.round((values - levels[0]) / step))
    if not (offset[-len(last) :] < _ON_GRID).all():
        return 0, 0.0
    beyond = np.flatnonzero(offset >= _ON_GRID)
    begin = int(beyond[-1]) + 1 if len(beyond) else 0
    return (0 if begin < _FROZEN_ROWS else begin), step


def _usually_changes(values: FloatArray, spans: list[slice]) -> bool:
    """Whether a channel changes in nearly every row outside the spans."""
    outside = np.ones(len(values), dtype=bool)
    for span in spans:
        outside[span] = False
    steps = np.diff(values)[outside[1:] & outside[:-1]]
    return len(steps) > _FROZEN_ROWS and float((steps == 0.0).mean()) < _MAX_REPEATS


def _contradicts_command(response: Response, action: int, begin: float, end: float) -> bool:
    """Whether a state that depends on a command elsewhere moves as if commanded otherwise between two times.

    The regression of the rest of the log, which has the command, predicts the span; its residual is compared with the
    usual one, and with that of a regression without the command.
    """
    times = response.t[response.start]
    inside = (times >= begin) & (times <= end)
    if min(inside.sum(), (~inside).sum()) < _FROZEN_ROWS:
        return False
    outside, span = response.sums(parts=[np.flatnonzero(~inside), np.flatnonzero(inside)])
    usual, without = (
        outside.rest() / outside.count,
        outside.where(response.powers[:, action] == 0).rest() / outside.count,
    )
    now = np.minimum(span.rest(outside.solution()), span.power) / span.count
    return bool(((without > _MATTERS * usual) & (now > _CONTRADICTS * usual) & (now > _AS_WITHOUT * without)).any())


_SMALLEST_JUMP = {"m": 0.1, "rad": 0.3, "m/s": 1.5, "rad/s": 5.0}
"""Smallest jump by unit; smaller steps are noise or harmless."""
_NEIGHBOURS = 5
_TIMES_MEDIAN = 4.0
_BLOCK = 100_000


def jump_rows(
    rows: RawRows, stretches: list[Stretch], system: System, measured: list[bool]
) -> tuple[NDArray[np.bool_], list[Finding]]:
    """Rows after a jump of a measured state.

    A step |x[k+1] - x[k]| is a jump if it exceeds the smallest jump of its unit plus 4 times the median rate of the
    five steps on either side, times its duration: the speed around it does not explain it. A held column is checked at
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
            text += ", more than the motion around it explains"
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
    """Median of the rate and its neighbours at the given rows; in blocks, to bound the memory."""
    if not len(rows):
        return np.empty(0)
    padded = np.pad(rates, _NEIGHBOURS, mode="reflect" if len(rates) > _NEIGHBOURS else "edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _NEIGHBOURS + 1)
    return np.concatenate([np.median(windows[rows[k : k + _BLOCK]], axis=1) for k in range(0, len(rows), _BLOCK)])
