"""Lags, delays, limits and play along whole stretches: the library's effects, vectorised and a hundred times faster.

A search needs the effective actions of a recording for hundreds of lags and delays. Tests compare both implementations.
The recursion over rows is evaluated as a parallel prefix over 2, 4, 8 ... rows, all rows at once.

Source: Hillis and Steele, Communications of the ACM 29, 1986 (parallel prefix sums).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from safedpa.arrays import FloatArray, IndexArray
from safedpa.comparison.windows import Windows
from safedpa.effects import AbstractEffect, CommandEffect
from safedpa.effects.channel_effects import KINDS, ChannelEffect, drained
from safedpa.operations import FLOATS, NUMPY

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
    if not isinstance(command, ChannelEffect):
        return None
    values = tuple(parameters[declared.name] for declared in command.parameters)
    along = {"delay": _delayed, "lag": _lagged, "backlash": _with_backlash}.get(command.kind)
    affected = command.commands(columns)
    if along is not None:
        return {name: along(each, values[0], windows) if name in affected else each for name, each in columns.items()}
    if command.kind not in _MEMORY:
        return None
    return {
        name: _from_memory(command, each, values, windows) if name in affected else each
        for name, each in columns.items()
    }


def _from_memory(command: ChannelEffect, column: FloatArray, values: tuple[float, ...], windows: Windows) -> FloatArray:
    """Returns the means over each row, from the memory at its beginning."""
    memory, period = _MEMORY[command.kind](column, values, windows), windows.period
    feel: Any = KINDS[command.kind].feel
    with np.errstate(all="ignore"):
        return np.asarray(feel(column, memory, values, command.parameters, period, NUMPY)[0])


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
    return np.asarray(column + (lag_output(column, decays, windows) - column) * share)


def lag_output(column: FloatArray, decays: FloatArray, windows: Windows, *, from_zero: bool = False) -> FloatArray:
    """Returns the output at the beginning of each row: out[k+1] = decay[k] out[k] + (1 - decay[k]) command[k].

    A stretch begins with its first command, or with 0.
    """
    begin = _first_rows(windows)
    retained, found = np.roll(decays, 1), np.roll((1.0 - decays) * column, 1)
    retained[begin], found[begin] = 0.0, 0.0 if from_zero else column[begin]
    offset = 1
    while offset < len(column) and np.abs(retained).max() > _NEGLIGIBLE:
        found[offset:] += retained[offset:] * found[:-offset]
        retained[offset:] *= retained[:-offset]
        offset *= 2
    return found


def _slewed(column: FloatArray, rates: tuple[float, ...], windows: Windows) -> FloatArray:
    """Returns the output at the beginning of each row of an actuator with limited rates."""
    up, down, felt, found = rates[0], rates[-1], 0.0, []
    begins = set(_first_rows(windows).tolist())
    for row, (command, period) in enumerate(zip(column.tolist(), windows.period.tolist(), strict=True)):
        felt = command if row in begins else felt
        found.append(felt)
        felt = min(max(command, felt - down * period), felt + up * period)
    return np.array(found)


def _lagged_up_down(column: FloatArray, constants: tuple[float, ...], windows: Windows) -> FloatArray:
    """Returns the output at the beginning of each row of a lag that differs for rising and falling commands."""
    rising, falling = (np.exp(-windows.period / max(each, 1e-9)).tolist() for each in constants)
    begins, felt, found = set(_first_rows(windows).tolist()), 0.0, []
    for row, command in enumerate(column.tolist()):
        felt = command if row in begins else felt
        found.append(felt)
        felt = command + (felt - command) * (rising if command > felt else falling)[row]
    return np.array(found)


def _oscillated(column: FloatArray, values: tuple[float, ...], windows: Windows) -> tuple[FloatArray, FloatArray]:
    """Returns y and y' at the beginning of each row of a second-order actuator, y'' = w^2 (u - y) - 2 z w y'.

    With the pole s = -z w + i w sqrt(1 - z^2), m = y' - conj(s) y has the equation m' = s m + w^2 u of first order.
    """
    frequency, damping = values
    pole = frequency * complex(-damping, (1.0 - damping * damping) ** 0.5)
    grown = np.exp(pole * windows.period)
    retained, begin = np.roll(grown, 1), _first_rows(windows)
    found = np.roll((grown - 1.0) / pole * frequency**2 * column, 1)
    retained[begin], found[begin] = 0.0, -pole.conjugate() * column[begin]
    offset = 1
    while offset < len(column) and np.abs(retained).max() > _NEGLIGIBLE:
        found[offset:] += retained[offset:] * found[:-offset]
        retained[offset:] *= retained[:-offset]
        offset *= 2
    felt = found.imag / pole.imag
    return felt, found.real + pole.real * felt


def _drained(column: FloatArray, emptiness: tuple[float, ...], windows: Windows) -> FloatArray:
    """Returns the outflow at the beginning of each row of a vessel that the command fills."""
    begins, felt, found = set(_first_rows(windows).tolist()), 0.0, []
    for row, (command, period) in enumerate(zip(column.tolist(), windows.period.tolist(), strict=True)):
        felt = command if row in begins else felt
        found.append(felt)
        felt = drained(command, felt, emptiness[0], period, FLOATS)[1]
    return np.array(found)


_MEMORY: Mapping[str, Callable[[FloatArray, tuple[float, ...], Windows], Any]] = {
    "slew_limit": _slewed,
    "slew_limit_up_down": _slewed,
    "lag_up_down": _lagged_up_down,
    "second_order": _oscillated,
    "reservoir": _drained,
}
"""The memory at the beginning of each row, by kind."""


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
