"""First-order lag and pure delay of a command that is held over each period, with their memories."""

from __future__ import annotations

from math import inf
from typing import Any

from safedpa.operations import Operations, Scalar

History = tuple[tuple[Scalar, float], ...]
"""Commands and the seconds for which each was held, newest first; the last one has been held forever."""

_SMALLEST_TIME_CONSTANT = 1e-9
"""s; below it exp(-period / time_constant) is 0 in every precision, and the division stays defined."""


def follow(
    command: Scalar, felt: Scalar, time_constant: Scalar, period: float, operations: Operations
) -> tuple[Scalar, Scalar]:
    """Returns the mean of a first-order lag over one period and its value at the end: exact for a held command.

    felt(t) = command + (felt - command) exp(-t / time_constant); at time_constant 0 felt = command.
    """
    decay = operations.exp(-period / operations.maximum(time_constant, _SMALLEST_TIME_CONSTANT))
    difference = felt - command
    return command + difference * ((1.0 - decay) * time_constant / period), command + difference * decay


def settled(command: Scalar) -> History:
    """Returns the history of a command that has been held forever."""
    return ((command, inf),)


def delayed(
    command: Scalar, history: History, delay: Scalar, longest: float, period: float, operations: Operations
) -> tuple[Scalar, History]:
    """Returns the exact mean of command(t - delay) over one period, also for periods of unequal length.

    And the history at the end of the period, as far back as the ``longest`` delay [s].
    """
    # times relative to the start of the period: a command that was held from start to end acts delay seconds later
    total: Any = 0.0
    end = period
    # a float delay overlaps with one to three entries: older ones need not be read
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
    """Returns the overlap [s] of the window (-delay, period - delay) with the time (start, end) of one command."""
    shared = operations.minimum(period - delay, end) - operations.maximum(-delay, start)
    return operations.maximum(shared, 0.0)


def _cached(history: History, longest: float) -> History:
    age = 0.0
    for index, (value, duration) in enumerate(history):
        age += duration
        if age >= longest:
            # the oldest command that a delay can reach is held forever: the history never runs out
            return (*history[:index], (value, inf))
    return history
