"""By how much commands act later than anybody told: found from what the robot did, as it drives.

Of every delay n = 0, 1, ... in whole periods the model predicts the next state as if the command of n ticks before had
been in force. With S_nj the sum of squared errors of state j, forgotten over a few seconds, and the errors' size not
known beforehand, the logarithm of the likelihood of n is, but for a constant,

    L_n = -N/2 sum_j log S_nj,

N the ticks that count: those in which the commands of the last ticks differ. It does not depend on the states' units. A
delay is refuted while another one's L is higher by more than ``EVIDENCE``. What is believed stays until it is refuted;
then the smallest delay that is not takes its place. Up to ``TOLERATED`` it is not acted upon, and of a longer one all
but ``USUAL``: so much is between command and motion of every actuator with a lag, and the margin was calibrated so.

Source: maximum likelihood with unknown noise variances, as in Ljung, System Identification, 2nd ed. 1999, section 7.4,
one model for each delay.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, isfinite, log
from typing import Final, NamedTuple, final

from safedpa.safety.prediction.predictor import Prediction

__all__ = ["EVIDENCE", "MOST", "TOLERATED", "USUAL", "DelayEstimator", "Transition"]

Plain = tuple[float, ...]

MOST: Final = 8
"""Periods; a longer delay is taken for this one."""
TOLERATED: Final = 2
"""Periods that are not acted upon."""
USUAL: Final = 1
"""Periods of every delay that are not acted upon."""
EVIDENCE: Final = 16.0
"""Difference of two logarithms of likelihood. Errors of a model go on from tick to tick, so that there are fewer
independent ones than ticks: hence much more than the 3 or 5 of textbooks."""
_SECONDS: Final = 2.0
"""After which a tick counts for a third."""
_FEWEST: Final = 6.0
"""Ticks that count, before anything is believed."""
_DIFFERS: Final = 0.01
"""Share of an action's range by which commands have to differ to tell anything."""
_IS_STATIONARY: Final = 0.1
"""m/s"""
_ROUNDING: Final = 1e-9
"""Share of a state below which an error is none."""
_LEAST: Final = 1e-12
"""Share of a state's largest sum of all delays; smaller sums count as this. A delay that explains everything has none,
and must not count less for it."""


class Transition(NamedTuple):
    """One period of a robot's way."""

    before: Plain
    """(states,) at its begin."""
    now: Plain
    """(states,) at its end."""
    commands: tuple[tuple[Plain, object], ...]
    """Of n = 0, 1, ...: the command (actions,) that was sent n periods earlier, and what actuators remembered then."""

    def stood(self, speeds: Sequence[int]) -> bool:
        """Whether it stood all the time, by the states that are ``speeds`` [m/s]: what is held by friction, or by a
        load that it tows, does not move for a while, however soon its commands act."""
        if len(self.before) != len(self.now) or any(index >= len(self.now) for index in speeds):
            return False  # a state that is none: the node says so
        at = [self.before[index] for index in speeds] + [self.now[index] for index in speeds]
        return bool(at) and all(abs(speed) <= _IS_STATIONARY for speed in at)


@final
class DelayEstimator:
    """Of one robot; ``observe`` each of its periods."""

    def __init__(self, prediction: Prediction, ranges: Sequence[float], period: float) -> None:
        self._prediction, self._ranges, self._period = prediction, ranges, period
        self._keep = exp(-period / _SECONDS)
        self._count = 0.0
        self._sums: list[list[float]] = []
        self.periods = 0
        """The delay that is believed, beyond what the model knows; what the robot tells is part of it."""

    def beyond(self, reported: float) -> float:
        """s that are to be acted upon, of which the robot tells ``reported`` [s]: that, unless far more was found."""
        if self.periods * self._period - reported <= (TOLERATED + _ROUNDING) * self._period:
            return reported
        return (self.periods - USUAL) * self._period

    @property
    def remark(self) -> str:
        """What a verdict has to say where it is acted upon."""
        return f"Commands act about {self.periods * self._period:.2g} s later than told; the filter looks past that."

    def observe(self, passed: Transition, latent: Plain | None) -> None:
        """Takes in one period; one with numbers that are not finite, or that does not fit, says nothing.

        Raises whatever the model raises.
        """
        states = len(passed.now)
        if len(passed.before) != states or not all(map(isfinite, (*passed.before, *passed.now))):
            return
        if any(len(command) != len(self._ranges) for command, _ in passed.commands) or not self._reports(
            passed.commands
        ):
            return
        squares = self._squares(passed, latent)
        if not isfinite(sum(map(sum, squares))):
            return
        if len(self._sums) != len(squares) or len(self._sums[0]) != states:
            self._sums, self._count = [[0.0] * states for _ in squares], 0.0
        self._count = self._keep * self._count + 1.0
        keep = self._keep
        for delay in range(len(squares)):  # over indices: compiled, an iterator over pairs costs five times as much
            sums, own = self._sums[delay], squares[delay]
            for index in range(states):
                sums[index] = keep * sums[index] + own[index]
        if self._count >= _FEWEST:
            self._believe()

    def _squares(self, passed: Transition, latent: Plain | None) -> list[list[float]]:
        """Squared error of each state (states,), in its unit squared, for each delay."""
        motion = self._prediction.affine_motion(passed.before, latent)
        now = list(passed.now)
        found: list[list[float]] = []
        for command, memory in passed.commands:
            if motion is not None:
                reached = motion.after(command)
            else:
                reached = self._prediction.following(passed.before, command, latent, memory)
            if len(reached) != len(now):
                raise ValueError(f"predicted state: got {len(reached)} numbers, wanted {len(now)}")
            own: list[float] = []
            for index in range(len(now)):
                error, rounded = now[index] - reached[index], _ROUNDING * now[index]
                own.append(error * error + rounded * rounded)  # infinite where it is too large, and no exception
            found.append(own)
        return found

    def _reports(self, commands: Sequence[tuple[Plain, object]]) -> bool:
        for index, width in enumerate(self._ranges):
            values = [command[index] for command, _ in commands]
            if max(values) - min(values) > _DIFFERS * width:
                return True
        return False

    def _believe(self) -> None:
        count = len(self._sums)
        costs = [0.0] * count
        for state in range(len(self._sums[0])):
            largest = 0.0
            for delay in range(count):
                value = self._sums[delay][state]
                largest = value if value > largest else largest
            least = _LEAST * largest
            if least > 0.0:
                for delay in range(count):
                    value = self._sums[delay][state]
                    costs[delay] += log(value if value > least else least)
        limit = min(costs) + 2.0 * EVIDENCE / self._count
        if costs[min(self.periods, count - 1)] > limit:
            self.periods = min([n for n, cost in enumerate(costs) if cost <= limit])
