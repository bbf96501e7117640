"""The last states of one robot with the commands sent and the actuator memory.

They have two uses. A state may be older than the moment at which its action is applied: then commands of the last ticks
act meanwhile. And a prediction beyond a dead time can be compared with the measurement only when that time is over,
along the commands that were applied by then.

Timing: the action of tick i acts for one period, from ``until_action`` seconds after the state was measured. With
q = ceil(until_action / period) the command that acts when state k is measured is that of tick k - q.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from math import ceil, inf
from typing import Any, Final, NamedTuple, final

from safedpa.dynamics import PhysicsModel
from safedpa.safety.prediction.dead_time import MAX_PERIODS, ActuatorModel, InFlightCommands
from safedpa.safety.prediction.delay_estimator import Transition

__all__ = ["LONGEST_AGE", "CommandHistory", "DelayedPrediction"]

Plain = tuple[float, ...]

LONGEST_AGE: Final = 1.0
"""Largest delay [s] from a state to its action; beyond it the state says nothing about where the robot is then."""
_GAP: Final = 2.0
"""Periods between two states from which on commands may be missing; clocks jitter by less than a period."""
_ROUNDING: Final = 1e-9
"""s; shorter intervals are rounding errors of sums of periods."""


class DelayedPrediction(NamedTuple):
    """The last measured state and the last two predictions, made before the dead time."""

    predicted_prev: Sequence[float]
    measured_prev: Sequence[float]
    predicted: Sequence[float]
    queued_periods: int = 0
    """Whole periods of commands in flight before the action; the margin grows with them."""


@dataclass
class _DatedTransition:
    tick: int
    values: Plain
    applied: Plain
    memory: Any
    """Actuator memory when this tick's action is applied."""
    sent: tuple[Plain, Any]
    """The action applied before it, and the actuator memory at that time."""
    latent: Plain | None = None
    decided: bool = False


@final
class CommandHistory:
    """The last states and commands of one robot with this model; one entry per tick."""

    def __init__(self, model: PhysicsModel) -> None:
        self._model, self._actuators = model, ActuatorModel(model)
        self._seconds: float | None = None
        # Long enough for the longest dead time and the oldest usable state, and no longer: a fleet has many of them.
        self._entries: deque[_DatedTransition] = deque(maxlen=MAX_PERIODS + ceil(LONGEST_AGE / model.period) + 2)

    def add(self, tick: int, values: Plain, applied: Plain, memory: Any, seconds: float | None = None) -> None:
        """Adds a tick's state, the action applied before it, and the actuator memory; starts again after a gap.

        ``seconds``: when the state was measured. Ticks that follow each other two periods apart, or backwards, are a
        gap as well; None: not known.
        """
        # After a gap the commands between are unknown: a history with a hole would predict wrong states.
        if (self._entries and self._entries[-1].tick != tick - 1) or not self.is_next(seconds):
            self._entries.clear()
        self._seconds = seconds
        before = self._entries[-1].memory if self._entries else memory
        self._entries.append(_DatedTransition(tick, values, applied, memory, (applied, before)))

    def continue_from(self, former: CommandHistory) -> None:
        """Takes over the entries of a former session with the same model."""
        self._entries, self._seconds = former._entries, former._seconds

    def is_next(self, seconds: float | None) -> bool:
        """Whether a state measured at ``seconds`` follows the newest one by about a period; true if not known."""
        if seconds is None or self._seconds is None:
            return True
        return 0.0 < seconds - self._seconds < _GAP * self._model.period

    def commands(self, tick: int, applied: Plain) -> list[Plain]:
        """The actions applied before each tick up to this one, oldest first; ``applied`` alone after a gap."""
        known = [entry.applied for entry in self._entries if entry.tick < tick]
        return [*known, applied] if known and self._entries[-1].tick in (tick - 1, tick) else [applied]

    def last_transition(self, most: int) -> Transition | None:
        """The last period with the commands of 0 to ``most`` periods earlier; None if they are not known.

        Before a robot's first tick no command was sent: its first one counts as applied all the time.
        """
        entries = self._entries
        if len(entries) < 2 or (len(entries) < most + 2 and entries[0].tick != 0):
            return None
        first = entries[0].applied, entries[0].memory
        known = [entry.sent for entry in islice(reversed(entries), min(most + 1, len(entries) - 1))]
        commands = (*known, *[first] * (most + 1 - len(known)))
        return Transition(entries[-2].values, entries[-1].values, commands)

    def mark_decided(self, latent: Plain | None) -> None:
        """Marks the newest state as decided, with the latent that was used."""
        self._entries[-1].latent, self._entries[-1].decided = latent, True

    def pending(self, until_action: float, others: Sequence[float] = ()) -> InFlightCommands:
        """The commands in flight at the newest state, and under ``others``, delays [s] that are not ruled out."""
        found = self._pending(until_action)
        return found._replace(alternatives=tuple([self._pending(one) for one in others])) if others else found

    def _pending(self, until_action: float) -> InFlightCommands:
        entries, period = self._entries, self._model.period
        count, rest = _delay(until_action, period)
        if count == 0:
            return InFlightCommands(entries[-1].memory, entries[-1].applied)
        oldest = entries[max(0, len(entries) - 1 - count)]
        commands = [entry.applied for entry in list(entries)[-count:]]
        # After a short history the oldest known command stands for earlier ones.
        commands = [commands[0]] * (count - len(commands)) + commands
        # The oldest command has acted for part of its period already: the actuators start from there.
        memory = self._model.felt(commands[0], oldest.memory, oldest.latent, period=rest)[1] if rest else oldest.memory
        spans = [period - rest] + [period] * (count - 1)
        return InFlightCommands(memory, commands[-1], tuple(zip(commands, spans, strict=True)))

    def predict(self, action: Plain, latent: Plain | None, pending: InFlightCommands, steps: int) -> list[list[float]]:
        """(steps, states) one period apart from the newest state on: pending commands first, then the action."""
        left = deque((*pending.queue, (action, inf)))
        now, memory = self._entries[-1].values, pending.memory
        rows = list[list[float]]()
        for _ in range(steps):
            wanted = self._model.period
            while wanted > _ROUNDING:
                command, seconds = left.popleft()
                # A command may end within a period; the next one fills the rest.
                span = min(seconds, wanted)
                now, memory = self._actuators.advance(now, command, memory, latent, span)
                wanted -= span
                if seconds > span + _ROUNDING:
                    left.appendleft((command, seconds - span))
            rows.append(list(now))
        return rows

    def delayed_prediction(self, until_action: float) -> DelayedPrediction | None:
        """The newest two states as predicted before the dead time; None if it is not over, or nothing was decided."""
        entries, period = list(self._entries), self._model.period
        count, rest = _delay(until_action, period)
        newest = len(entries) - 1
        if newest < 1 or not entries[newest - 1].decided:
            return None
        # With the latent of that time: the dead time may depend on it.
        waits = self._actuators.dead_time_periods(entries[newest - 1].latent).max_periods + count
        start = newest - 1 - waits
        if waits == 0 or start - count < 0 or not entries[start].decided:
            return None
        first = entries[start]
        memory = entries[start - count].memory
        if rest:
            memory = self._model.felt(entries[start - count + 1].applied, memory, first.latent, period=rest)[1]
        now, before = first.values, first.values
        for index in range(start - count + 1, newest - count + 1):
            # Each period is split where the command changes, ``rest`` before the state of the next tick.
            before = now
            for command, seconds in ((index, period - rest), (index + 1, rest)):
                if seconds > 0.0:
                    action = entries[command].applied
                    now, memory = self._actuators.advance(now, action, memory, first.latent, seconds)
        return DelayedPrediction(before, entries[newest - 1].values, now, count - (rest > 0.0))


def _delay(until_action: float, period: float) -> tuple[int, float]:
    """Whole periods, rounded up, and the excess [s]."""
    count = max(0, ceil(until_action / period - _ROUNDING))
    rest = count * period - until_action
    return count, rest if rest > _ROUNDING else 0.0
