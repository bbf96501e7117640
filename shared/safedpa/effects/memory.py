"""Effects that remember: first-order lag and pure delay of a command that is held over each period."""

from __future__ import annotations

from math import inf
from typing import Any

from safedpa.operations import Operations, Scalar

__all__ = ["History", "delayed", "follow", "settled"]

History = tuple[tuple[Scalar, float], ...]
"""Commands and the seconds for which each was held, newest first; the last one has been held for ever."""

_SMALLEST_TIME_CONSTANT = 1e-9
"""s; below it exp(-period / time_constant) is 0 in every precision, and the division stays defined."""


def follow(
    command: Scalar, felt: Scalar, time_constant: Scalar, period: float, operations: Operations
) -> tuple[Scalar, Scalar]:
    """First-order lag over one period, exact for a held command; no lag at all at time_constant 0.

    felt(t) = command + (felt - command) exp(-t / time_constant). Returns the mean of felt over the period and its
    value at the end.
    """
    decay = operations.exp(-period / operations.maximum(time_constant, _SMALLEST_TIME_CONSTANT))
    difference = felt - command
    return command + difference * ((1.0 - decay) * time_constant / period), command + difference * decay


def settled(command: Scalar) -> History:
    """The history of a command that has been held for ever."""
    return ((command, inf),)


def delayed(
    command: Scalar, history: History, delay: Scalar, longest: float, period: float, operations: Operations
) -> tuple[Scalar, History]:
    """Pure delay over one period: the exact mean of command(t - delay), also for periods of unequal length.

    Returns that mean and the history at the end of the period, as far back as the ``longest`` delay [s] reaches.
    """
    total: Any = 0.0
    end = period
    # a float delay meets one to three entries: the rest of the history need not be looked at
    reach = delay if isinstance(delay, float) else longest
    for value, duration in ((command, period), *history):
        start = end - duration
        if end > -reach:
            total = total + _overlap(start, end, delay, period, operations) / period * value
        end = start
        if start <= -reach:
            break
    return total, _cached(((command, period), *history), longest)


def _overlap(start: float, end: float, delay: Scalar, period: float, operations: Operations) -> Scalar:
    """Seconds shared by the window (-delay, period - delay) and the time (start, end) for which a command was held."""
    shared = operations.minimum(period - delay, end) - operations.maximum(-delay, start)
    return operations.maximum(shared, 0.0)


def _cached(history: History, longest: float) -> History:
    age = 0.0
    for index, (value, duration) in enumerate(history):
        age += duration
        if age >= longest:
            return (*history[:index], (value, inf))
    return history
