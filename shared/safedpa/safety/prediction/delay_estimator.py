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

Before a delay is found, a filter that trusted the reported one would drive faster than the robot can stop. Therefore
``possible_delays`` are those that are not ruled out: at first every delay up to ``STATED_DELAY``, later those that the
motion does not reject. The filter imposes its constraints under each of them, which limits the speed near obstacles and
nowhere else. Two bodies of evidence are kept. All periods count for what is possible. Only those in which the robot
moves count for what is found and reported: a heavy load sticks at rest for a while, which looks like a delay.

Source: maximum likelihood with unknown noise variances, as in Ljung, System Identification, 2nd ed. 1999, section 7.4,
one model for each delay.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, exp, isfinite, log
from typing import Final, NamedTuple, final

from safedpa.safety.prediction.predictor import Prediction

__all__ = [
    "EVIDENCE",
    "MAX_DELAY",
    "POSSIBLE_EVIDENCE",
    "STATED_DELAY",
    "TOLERATED_DELAY",
    "USUAL_DELAY",
    "DelayEstimator",
    "Transition",
]

Plain = tuple[float, ...]

MAX_DELAY: Final = 10
"""Periods; a longer delay is estimated as this one."""
STATED_DELAY: Final = 0.15
"""s; an unreported delay up to which the filter's promise holds from the start. A radio link takes 20 to 100 ms."""
TOLERATED_DELAY: Final = 2
"""Periods up to which nothing is compensated."""
USUAL_DELAY: Final = 1
"""Periods of every delay that are not compensated."""
POSSIBLE_EVIDENCE: Final = 16.0
"""Difference of two log-likelihoods that rules a delay out. Model errors are correlated over ticks, so there are fewer
independent ones than ticks: hence much more than the 3 to 5 of textbooks."""
EVIDENCE: Final = 24.0
"""Difference of two log-likelihoods beyond which a delay is found. More than what rules one out: a message must be
true, while the constraints hold for every possible delay anyway. Chosen so that a load of twice the mass is none."""
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
class _Evidence:
    """The sums S_nj of squared errors with forgetting, and the delays that they do not reject."""

    def __init__(self, period: float, evidence: float) -> None:
        self._keep, self._evidence = exp(-period / _FORGETTING_TIME), evidence
        self._count = 0.0
        self._sums: list[list[float]] = []
        self.accepted: list[int] = []
        """Delays [periods] that are not rejected, ascending; empty without evidence."""
        self.likely: list[int] = []
        """The same with ``POSSIBLE_EVIDENCE``."""

    def add(self, squares: list[list[float]]) -> None:
        """Adds the squared errors of each delay and state."""
        # Another number of delays or states means another model: its errors cannot be added to the old ones.
        states = len(squares[0])
        if len(self._sums) != len(squares) or len(self._sums[0]) != states:
            self._sums, self._count = [[0.0] * states for _ in squares], 0.0
            self.accepted, self.likely = [], []
        self._count = self._keep * self._count + 1.0
        keep = self._keep
        for delay in range(len(squares)):  # over indices: compiled, an iterator over pairs takes five times as long
            sums, own = self._sums[delay], squares[delay]
            for index in range(states):
                sums[index] = keep * sums[index] + own[index]
        if self._count >= _MIN_COUNT:
            self._reject()

    def _reject(self) -> None:
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
        best, most = min(costs), 2.0 / self._count
        self.accepted = [delay for delay, cost in enumerate(costs) if cost <= best + most * self._evidence]
        self.likely = [delay for delay, cost in enumerate(costs) if cost <= best + most * POSSIBLE_EVIDENCE]


@final
class DelayEstimator:
    """The estimate of one robot; call ``observe`` for each of its periods."""

    def __init__(self, prediction: Prediction, ranges: Sequence[float], period: float) -> None:
        self._prediction, self._ranges, self._period = prediction, ranges, period
        self._all, self._moving = _Evidence(period, POSSIBLE_EVIDENCE), _Evidence(period, EVIDENCE)
        self.periods = 0
        """The estimated delay beyond the model's own; what the robot reports is part of it."""

    def continue_from(self, former: DelayEstimator) -> None:
        """Takes over the evidence and the estimate of a former session with the same model."""
        self._all, self._moving, self.periods = former._all, former._moving, former.periods

    def delay_to_compensate(self, reported: float) -> float:
        """Delay [s] to compensate when the robot reports ``reported`` [s]: that, unless far more was found."""
        return self._found if self._is_found(reported) else reported

    def possible_delays(self, reported: float) -> tuple[float, ...]:
        """Other delays [s] that are not ruled out, for which the constraints are imposed as well.

        Without evidence these are all up to ``STATED_DELAY`` beyond ``reported`` [s]. Otherwise they are those that the
        motion does not reject; of these, only the smallest one may exceed that limit until a delay has been found.
        """
        stated = int(reported / self._period) + ceil(STATED_DELAY / self._period - _ROUNDING)
        if self._is_found(reported):
            seen = self._moving.accepted or [self.periods]
            low, high = max(0, seen[0] - USUAL_DELAY), seen[-1] - USUAL_DELAY
        elif self._all.accepted:
            least, most = self._all.accepted[0] - USUAL_DELAY, self._all.accepted[-1] - USUAL_DELAY
            low, high = 0, max(least, min(most, stated))
        else:
            low, high = 0, stated
        base, nearest = self.delay_to_compensate(reported), 0.5 * self._period
        found = [count * self._period for count in range(low, high + 1)]
        found = [delay for delay in found if delay > reported + _ROUNDING and abs(delay - base) > nearest]
        # The shortest and the longest: each delay takes as long as a whole evaluation of the model and the barriers.
        return (found[0], found[-1]) if len(found) > 1 else tuple(found)

    def too_long(self, reported: float) -> str:
        """Why the robot has to brake: a delay beyond ``STATED_DELAY`` and ``reported`` [s] was found; else empty.

        What depends on the commands that act, such as an estimated load, is then wrong as well, so that no prediction
        over the delay holds.
        """
        if not self._is_found(reported) or self._found <= reported + STATED_DELAY + _ROUNDING:
            return ""
        return (
            f"commands act about {self.periods * self._period:.2g} s late, reported were {reported:.2g} s and up to "
            f"{STATED_DELAY:g} s more are allowed for; report the delay with each state"
        )

    @property
    def _found(self) -> float:
        return (self.periods - USUAL_DELAY) * self._period

    def _is_found(self, reported: float) -> bool:
        return self.periods * self._period - reported > (TOLERATED_DELAY + _ROUNDING) * self._period

    def remark(self, coverage: float, promised: float) -> str:
        """What the verdict reports while an estimated delay is compensated.

        ``coverage`` is the share of the last predictions that the margin covered (below 0: none was compared),
        ``promised`` the share it was calibrated for. Only with the latter does the message say that it holds.
        """
        late = self.periods * self._period
        held = (
            f"the filter looks past that, and {100.0 * coverage:.3g} % of the last predictions held"
            if 0.0 < promised <= coverage
            else "whether the filter's predictions hold with that is not confirmed"
        )
        return f"Commands act about {late:.2g} s later than reported; {held}."

    def observe(self, transition: Transition, latent: Plain | None, *, stationary: bool = False) -> None:
        """Takes in one period; ignores one with values that are not finite or of the wrong shape.

        A ``stationary`` period counts for what is possible, not for what is found. Raises whatever the model raises.
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
        if not states or not squares or not isfinite(sum(map(sum, squares))):
            return
        self._all.add(squares)
        if stationary:
            return
        self._moving.add(squares)
        accepted = self._moving.accepted
        # The smallest plausible delay: compensating too much would act on a state that the robot has not reached yet.
        if accepted and min(self.periods, len(squares) - 1) not in accepted:
            self.periods = accepted[0]
        # Beyond the stated delay no promise holds: the robot brakes as soon as all others are ruled out.
        likely = self._moving.likely
        if likely and self.periods < likely[0] and (likely[0] - USUAL_DELAY) * self._period > STATED_DELAY + _ROUNDING:
            self.periods = likely[0]

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
