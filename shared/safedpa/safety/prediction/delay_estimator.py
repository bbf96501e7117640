"""Estimates online by how much commands act later than reported, from the robot's motion.

For every delay n = 0, 1, ... in whole periods the model predicts the next state as if the command of n ticks before had
been applied. With S_nj the sum of squared errors of state j, with exponential forgetting over a few seconds, and
unknown error variances, the log-likelihood of n is, up to a constant,

    L_n = -N/2 sum_j log S_nj,

N the number of informative ticks, in which the commands of the last ticks differ. It does not depend on the states'
units. A delay is rejected while another one's L is higher by more than ``EVIDENCE``. The estimate stays until it is
rejected; then the smallest delay that is not rejected replaces it. Up to ``TOLERATED_DELAY`` nothing is compensated,
and of a longer one all but ``USUAL_DELAY``: every actuator with a lag has that much, and it was present when the margin
was calibrated.

Source: maximum likelihood with unknown noise variances, as in Ljung, System Identification, 2nd ed. 1999, section 7.4,
one model for each delay.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, isfinite, log
from typing import Final, NamedTuple, final

from safedpa.safety.prediction.predictor import Prediction

__all__ = ["EVIDENCE", "MAX_DELAY", "TOLERATED_DELAY", "USUAL_DELAY", "DelayEstimator", "Transition"]

Plain = tuple[float, ...]

MAX_DELAY: Final = 8
"""Periods; a longer delay is estimated as this one."""
TOLERATED_DELAY: Final = 2
"""Periods up to which nothing is compensated."""
USUAL_DELAY: Final = 1
"""Periods of every delay that are not compensated."""
EVIDENCE: Final = 16.0
"""Difference of two log-likelihoods that rejects a delay. Model errors are correlated over ticks, so there are fewer
independent ones than ticks: hence much more than the 3 to 5 of textbooks."""
_FORGETTING_TIME: Final = 2.0
"""Time constant [s] of the forgetting."""
_MIN_COUNT: Final = 6.0
"""Informative ticks (with forgetting) before anything is estimated."""
_MIN_DIFFERENCE: Final = 0.01
"""Share of an action's range by which commands must differ to be informative."""
_STATIONARY_SPEED: Final = 0.1
"""Speed [m/s] below which a robot counts as stationary."""
_ROUNDING: Final = 1e-9
"""Share of a state below which an error counts as rounding."""
_MIN_SHARE: Final = 1e-12
"""Share of the largest sum over all delays below which a sum counts as this: a delay without any error would otherwise
have an infinite likelihood."""


class Transition(NamedTuple):
    """One period of a robot's motion."""

    before: Plain
    """(states,) at its start."""
    now: Plain
    """(states,) at its end."""
    commands: tuple[tuple[Plain, object], ...]
    """For n = 0, 1, ...: the command (actions,) sent n periods earlier, and the actuators' memory then."""

    def is_stationary(self, speeds: Sequence[int]) -> bool:
        """Whether the robot was stationary throughout, by the entries ``speeds`` [m/s].

        Static friction or a towed load may hold a robot for a while, however soon its commands act.
        """
        if len(self.before) != len(self.now) or any(index >= len(self.now) for index in speeds):
            return False  # an invalid state: the node reports it
        values = [self.before[index] for index in speeds] + [self.now[index] for index in speeds]
        return bool(values) and all(abs(speed) <= _STATIONARY_SPEED for speed in values)


@final
class DelayEstimator:
    """The estimate of one robot; call ``observe`` for each of its periods."""

    def __init__(self, prediction: Prediction, ranges: Sequence[float], period: float) -> None:
        self._prediction, self._ranges, self._period = prediction, ranges, period
        self._keep = exp(-period / _FORGETTING_TIME)
        self._count = 0.0
        self._sums: list[list[float]] = []
        self.periods = 0
        """The estimated delay beyond the model's own; what the robot reports is part of it."""

    def delay_to_compensate(self, reported: float) -> float:
        """Delay [s] to compensate when the robot reports ``reported`` [s]: that, unless far more was found."""
        if self.periods * self._period - reported <= (TOLERATED_DELAY + _ROUNDING) * self._period:
            return reported
        return (self.periods - USUAL_DELAY) * self._period

    @property
    def remark(self) -> str:
        """What the verdict says while an estimated delay is compensated."""
        late = self.periods * self._period
        return f"Commands act about {late:.2g} s later than reported; the filter compensates for that."

    def observe(self, transition: Transition, latent: Plain | None) -> None:
        """Takes in one period; ignores one with values that are not finite or of the wrong shape.

        Raises whatever the model raises.
        """
        states = len(transition.now)
        if len(transition.before) != states or not all(map(isfinite, (*transition.before, *transition.now))):
            return
        # Equal commands predict equal states for every delay: such a tick would only dilute the evidence.
        if any(len(command) != len(self._ranges) for command, _ in transition.commands) or not self._is_informative(
            transition.commands
        ):
            return
        squares = self._squared_errors(transition, latent)
        if not isfinite(sum(map(sum, squares))):
            return
        # Another number of delays or states means another model: its errors cannot be added to the old ones.
        if len(self._sums) != len(squares) or len(self._sums[0]) != states:
            self._sums, self._count = [[0.0] * states for _ in squares], 0.0
        self._count = self._keep * self._count + 1.0
        keep = self._keep
        for delay in range(len(squares)):  # over indices: compiled, an iterator over pairs takes five times as long
            sums, own = self._sums[delay], squares[delay]
            for index in range(states):
                sums[index] = keep * sums[index] + own[index]
        if self._count >= _MIN_COUNT:
            self._update_estimate()

    def _squared_errors(self, transition: Transition, latent: Plain | None) -> list[list[float]]:
        """Squared error of each state (states,), in its unit squared, for each delay."""
        motion = self._prediction.affine_motion(transition.before, latent)
        now = list(transition.now)
        found: list[list[float]] = []
        for command, memory in transition.commands:
            if motion is not None:
                predicted = motion.next_state(command)
            else:
                predicted = self._prediction.next_state_floats(transition.before, command, latent, memory)
            if len(predicted) != len(now):
                raise ValueError(f"predicted state: got {len(predicted)} values, wanted {len(now)}")
            own: list[float] = []
            for index in range(len(now)):
                error, rounded = now[index] - predicted[index], _ROUNDING * now[index]
                # The rounding term keeps every error above 0; a huge error overflows to infinity without an exception.
                own.append(error * error + rounded * rounded)
            found.append(own)
        return found

    def _is_informative(self, commands: Sequence[tuple[Plain, object]]) -> bool:
        for index, width in enumerate(self._ranges):
            values = [command[index] for command, _ in commands]
            if max(values) - min(values) > _MIN_DIFFERENCE * width:
                return True
        return False

    def _update_estimate(self) -> None:
        count = len(self._sums)
        costs = [0.0] * count
        for state in range(len(self._sums[0])):
            largest = 0.0
            for delay in range(count):
                value = self._sums[delay][state]
                largest = value if value > largest else largest
            smallest = _MIN_SHARE * largest
            if smallest > 0.0:
                for delay in range(count):
                    value = self._sums[delay][state]
                    costs[delay] += log(value if value > smallest else smallest)
        # ``costs`` are -2 L / N, so the difference of log-likelihoods is scaled by 2 / N.
        limit = min(costs) + 2.0 * EVIDENCE / self._count
        if costs[min(self.periods, count - 1)] > limit:
            # The smallest plausible delay: compensating too much would act on a state that the robot has not reached
            # yet.
            self.periods = min([n for n, cost in enumerate(costs) if cost <= limit])
