"""Effects that remember: first-order lag and pure delay of a command that is held over each period."""

from __future__ import annotations

from typing import Any

from safedpa.operations import Operations, Scalar

__all__ = ["delayed", "follow"]

_SMALLEST_TIME_CONSTANT = 1e-6
"""s; keeps exp(-period / time_constant) defined at the neutral value 0, where the lag vanishes to 1e-6."""


def follow(
    command: Scalar, felt: Scalar, time_constant: Scalar, period: float, operations: Operations
) -> tuple[Scalar, Scalar]:
    """First-order lag over one period, exact for a held command.

    felt(t) = command + (felt - command) exp(-t / time_constant). Returns the mean of felt over the period and its
    value at the end.
    """
    time_constant = operations.maximum(time_constant, _SMALLEST_TIME_CONSTANT)
    ratio = period / time_constant
    decay = operations.exp(-ratio)
    difference = felt - command
    return command + difference * (1.0 - decay) / ratio, command + difference * decay


def delayed(
    command: Scalar, history: tuple[Scalar, ...], delay: Scalar, period: float, operations: Operations
) -> tuple[Scalar, tuple[Scalar, ...]]:
    """Pure delay over one period, exact in the mean for a held command.

    ``history`` holds the commands of the last periods, newest first. With n = delay / period the mean of
    command(t - delay) over the period is the triangular average sum_i max(0, 1 - |n - i|) command[-i]; delays
    longer than the history take its oldest entry.
    """
    commands: tuple[Scalar, ...] = (command, *history)
    periods = delay / period
    if isinstance(periods, float):
        steps = min(int(periods), len(commands) - 1)
        rest = min(periods - steps, 1.0)
        older = commands[min(steps + 1, len(commands) - 1)]
        return (1.0 - rest) * commands[steps] + rest * older, commands[:-1]
    periods = operations.minimum(periods, float(len(commands) - 1))
    total: Any = 0.0
    for index, value in enumerate(commands):
        total = total + operations.maximum(1.0 - operations.absolute(periods - float(index)), 0.0) * value
    return total, commands[:-1]
