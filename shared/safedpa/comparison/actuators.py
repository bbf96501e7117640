"""The library's lags, delays and play along whole stretches: what their effects say row by row, a hundred times faster.

A search asks for the felt actions of a log at hundreds of lags and delays; tests hold both ways against each other.
What each row does to what was felt before it is put together over 2, 4, 8 ... rows, all rows at once.

Source: Hillis and Steele, Communications of the ACM 29, 1986 (parallel prefix sums).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safedpa.arrays import FloatArray, IndexArray
from safedpa.comparison.windows import Windows
from safedpa.effects import AbstractEffect, CommandEffect
from safedpa.effects.general_commands import ChannelDelay, ChannelLag
from safedpa.operations import FLOATS

__all__ = ["delayed_actions", "effective_action_columns"]

_DELAYS = frozenset({"steering_delay", "drive_delay", "actuator_delay", "torque_delay"})
_LAGS = frozenset({"steering_lag", "drive_lag", "torque_lag"})
"""The library's effects of these names; which commands they make late, each says itself: a robot's `drive_lag` may be
that of one command or of two."""
_PLAY = {"backlash": "torque"}
_PERIOD = 0.05
"""s, over which a step is looked at."""
_FORGOTTEN = 1e-18
"""Share of what was felt some rows before that no longer counts."""


def delayed_actions(item: AbstractEffect, names: Sequence[str]) -> frozenset[str]:
    """The actions that an effect of ordinary size makes late: a step is not felt whole in the period that begins it."""
    if not isinstance(item, CommandEffect):
        return frozenset()
    memory = item.initial_memory(dict.fromkeys(names, 0.0))
    if memory is None:
        return frozenset()
    values = {parameter.name: parameter.typical for parameter in item.parameters}
    felt, _ = item.transform(dict.fromkeys(names, 1.0), memory, values, _PERIOD, FLOATS)
    return frozenset(name for name in names if felt[name] != 1.0)


def effective_action_columns(
    command: CommandEffect, columns: dict[str, FloatArray], own: dict[str, float], windows: Windows
) -> dict[str, FloatArray] | None:
    """The felt columns of one of the library's own lags and delays, or of its play; None for every other effect."""
    if not type(command).__module__.startswith(("safedpa.effects.", "safedpa.robots.")):
        return None
    if command.name in _PLAY:
        name = _PLAY[command.name]
        return {**columns, name: _with_play(columns[name], own["width"], windows)}
    if isinstance(command, (ChannelDelay, ChannelLag)):
        follow = _delayed if isinstance(command, ChannelDelay) else _lagged
        (value,) = own.values()
        return {**columns, command.channel: follow(columns[command.channel], value, windows)}
    if command.name in _DELAYS | _LAGS and len(own) == 1:
        (value,), follow = own.values(), _delayed if command.name in _DELAYS else _lagged
        late = delayed_actions(command, tuple(columns))
        return {name: follow(column, value, windows) if name in late else column for name, column in columns.items()}
    return None


def _delayed(column: FloatArray, delay: float, windows: Windows) -> FloatArray:
    """Mean over each period of command(t - delay), by the integral of the command over time."""
    felt = np.empty(len(column))
    for begin, stop in windows.bounds.tolist():
        command, period = column[begin:stop], windows.period[begin:stop]
        if not len(command):
            continue
        edges = np.concatenate([[0.0], np.cumsum(period)])
        before = 2.0 * delay + 1.0
        integral = np.concatenate([[0.0], np.cumsum(command * period)])
        times = np.concatenate([[-before], edges])
        sums = np.concatenate([[-before * command[0]], integral])
        late = np.interp(edges - delay, times, sums)
        felt[begin:stop] = np.diff(late) / period
    return felt


def _lagged(column: FloatArray, time_constant: float, windows: Windows) -> FloatArray:
    """Mean over each period of a first-order lag, exact for held commands."""
    if time_constant <= 1e-9:
        return column
    decays = np.exp(-windows.period / time_constant)
    share = (1.0 - decays) * time_constant / windows.period
    return np.asarray(column + (_starts(column, decays, windows) - column) * share)


def _starts(column: FloatArray, decays: FloatArray, windows: Windows) -> FloatArray:
    """What is felt at the beginning of each row: felt[k+1] = decay[k] felt[k] + (1 - decay[k]) command[k]."""
    begin = _begins(windows)
    retained, found = np.roll(decays, 1), np.roll((1.0 - decays) * column, 1)
    retained[begin], found[begin] = 0.0, column[begin]
    back = 1
    while back < len(column) and retained.max() > _FORGOTTEN:
        found[back:] += retained[back:] * found[:-back]
        retained[back:] *= retained[:-back]
        back *= 2
    return found


def _with_play(column: FloatArray, width: float, windows: Windows) -> FloatArray:
    """felt[k] = clip(felt[k-1], command[k] - width / 2, command[k] + width / 2); two clips in a row are one."""
    low, high, begin = column - 0.5 * width, column + 0.5 * width, _begins(windows)
    low[begin] = high[begin] = column[begin]
    back = 1
    while back < len(column) and (low < high).any():
        before = low[:-back].copy(), high[:-back].copy()
        bounds = low[back:].copy(), high[back:].copy()
        low[back:], high[back:] = (np.minimum(np.maximum(value, bounds[0]), bounds[1]) for value in before)
        back *= 2
    return low


def _begins(windows: Windows) -> IndexArray:
    """The first row of every stretch that has rows."""
    return np.asarray([begin for begin, stop in windows.bounds.tolist() if stop > begin], dtype=np.int64)
