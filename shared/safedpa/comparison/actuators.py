"""Lags, delays and backlash along whole stretches: the library's effects, vectorised and a hundred times faster.

A search needs the effective actions of a recording for hundreds of lags and delays. Tests compare both implementations.
The recursion over rows is evaluated as a parallel prefix over 2, 4, 8 ... rows, all rows at once.

Source: Hillis and Steele, Communications of the ACM 29, 1986 (parallel prefix sums).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safedpa.arrays import FloatArray, IndexArray
from safedpa.comparison.windows import Windows
from safedpa.effects import AbstractEffect, CommandEffect
from safedpa.effects.channel_effects import ChannelEffect
from safedpa.operations import FLOATS

_BACKLASH = {"backlash": "torque"}
# Period [s] over which a step response is evaluated: a typical control period.
_PERIOD = 0.05
# Remaining share of an earlier value that no longer changes a double-precision sum.
_NEGLIGIBLE = 1e-18


def delayed_actions(item: AbstractEffect, names: Sequence[str]) -> frozenset[str]:
    """Returns the actions that an effect of typical size delays: a step does not fully act in its first period."""
    if not isinstance(item, CommandEffect):
        return frozenset()
    memory = item.initial_memory(dict.fromkeys(names, 0.0))
    if memory is None:
        return frozenset()
    values = {parameter.name: parameter.typical for parameter in item.parameters}
    effective, _ = item.transform(dict.fromkeys(names, 1.0), memory, values, _PERIOD, FLOATS)
    return frozenset(name for name in names if effective[name] != 1.0)


def effective_action_columns(
    command: CommandEffect, columns: dict[str, FloatArray], parameters: dict[str, float], windows: Windows
) -> dict[str, FloatArray] | None:
    """Returns the effective columns of the library's lags, delays and backlash; None for every other effect."""
    # A user's effect may have the same name but other equations.
    if not type(command).__module__.startswith(("safedpa.effects.", "safedpa.robots.")):
        return None
    if command.name in _BACKLASH:
        name = _BACKLASH[command.name]
        return {**columns, name: _with_backlash(columns[name], parameters["width"], windows)}
    if isinstance(command, ChannelEffect) and command.kind in ("delay", "lag"):
        (value,), follow = parameters.values(), _delayed if command.kind == "delay" else _lagged
        affected = command.commands(columns)
        return {
            name: follow(column, value, windows) if name in affected else column for name, column in columns.items()
        }
    return None


def _delayed(column: FloatArray, delay: float, windows: Windows) -> FloatArray:
    """Returns the mean over each period of command(t - delay), from the integral of the command over time."""
    effective = np.empty(len(column))
    for begin, stop in windows.bounds.tolist():
        command, period = column[begin:stop], windows.period[begin:stop]
        if not len(command):
            continue
        edges = np.concatenate([[0.0], np.cumsum(period)])
        # Before the stretch the first command held, for longer than any delay.
        before = 2.0 * delay + 1.0
        integral = np.concatenate([[0.0], np.cumsum(command * period)])
        times = np.concatenate([[-before], edges])
        sums = np.concatenate([[-before * command[0]], integral])
        shifted = np.interp(edges - delay, times, sums)
        effective[begin:stop] = np.diff(shifted) / period
    return effective


def _lagged(column: FloatArray, time_constant: float, windows: Windows) -> FloatArray:
    """Returns the mean over each period of a first-order lag, exact for held commands."""
    if time_constant <= 1e-9:
        return column
    decays = np.exp(-windows.period / time_constant)
    share = (1.0 - decays) * time_constant / windows.period
    return np.asarray(column + (_lag_output(column, decays, windows) - column) * share)


def _lag_output(column: FloatArray, decays: FloatArray, windows: Windows) -> FloatArray:
    """Returns the output at the beginning of each row: out[k+1] = decay[k] out[k] + (1 - decay[k]) command[k]."""
    begin = _first_rows(windows)
    retained, found = np.roll(decays, 1), np.roll((1.0 - decays) * column, 1)
    retained[begin], found[begin] = 0.0, column[begin]
    offset = 1
    while offset < len(column) and retained.max() > _NEGLIGIBLE:
        found[offset:] += retained[offset:] * found[:-offset]
        retained[offset:] *= retained[:-offset]
        offset *= 2
    return found


def _with_backlash(column: FloatArray, width: float, windows: Windows) -> FloatArray:
    """Returns out[k] = clip(out[k-1], command[k] - width / 2, command[k] + width / 2).

    Two clips in a row are one clip, so they combine like the terms of a prefix sum.
    """
    low, high, begin = column - 0.5 * width, column + 0.5 * width, _first_rows(windows)
    low[begin] = high[begin] = column[begin]
    offset = 1
    while offset < len(column) and (low < high).any():
        before = low[:-offset].copy(), high[:-offset].copy()
        bounds = low[offset:].copy(), high[offset:].copy()
        low[offset:], high[offset:] = (np.minimum(np.maximum(value, bounds[0]), bounds[1]) for value in before)
        offset *= 2
    return low


def _first_rows(windows: Windows) -> IndexArray:
    """Returns the first row of every stretch that has rows."""
    return np.asarray([begin for begin, stop in windows.bounds.tolist() if stop > begin], dtype=np.int64)
