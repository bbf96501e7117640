"""Commands that reach the car's actuators late: a slow link, a slow receiver."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from math import isfinite
from typing import final

from safedpa.errors import InputError

__all__ = ["LateCommands"]

_ROUNDING = 1e-9
"""s; a piece of a period shorter than this is rounding."""


@final
class LateCommands:
    """felt drive(t) = drive(t - drive_seconds), felt steer(t) = steer(t - steer_seconds), exact between ticks as well.

    Before the first command the car was told to stand with its wheels straight. Raises InputError for a delay that is
    not a finite number of seconds, 0 or more.
    """

    def __init__(self, drive_seconds: float, steer_seconds: float) -> None:
        for name, seconds in (("drive_seconds", drive_seconds), ("steer_seconds", steer_seconds)):
            if not (isfinite(seconds) and seconds >= 0.0):
                raise InputError(f"{name}: got {seconds!r}, wanted a finite number of seconds, 0 or more")
        self._seconds = (drive_seconds, steer_seconds)
        self._now = 0.0
        self._felt: tuple[list[tuple[float, float]], ...] = ([(0.0, 0.0)], [(0.0, 0.0)])
        """Of drive and steer: the time [s] from which a command is felt, and the command; oldest first."""

    def felt(self, command: tuple[float, float], seconds: float) -> Iterator[tuple[float, float, float]]:
        """Drive, steer and for how long [s], in order, over the period in which ``command`` is sent."""
        begin, end = self._now, self._now + seconds
        for history, value, late in zip(self._felt, command, self._seconds, strict=True):
            history.append((begin + late, value))
        edges = [begin]
        for edge in sorted(time for history in self._felt for time, _ in history):
            if edges[-1] + _ROUNDING < edge < end - _ROUNDING:
                edges.append(edge)
        for start, stop in pairwise([*edges, end]):
            yield self._at(0, start), self._at(1, start), stop - start
        self._now = end
        for history in self._felt:
            while len(history) > 1 and history[1][0] <= end + _ROUNDING:
                del history[0]

    def _at(self, channel: int, time: float) -> float:
        return [value for begin, value in self._felt[channel] if begin <= time + _ROUNDING][-1]
