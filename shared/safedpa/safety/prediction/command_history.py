"""The last states of one robot, with what its actuators remembered and what was sent.

Two things need them. A state may be older than the moment at which its action is put in force: then commands of the
last ticks are in force meanwhile. And a prediction past a dead time can only be compared with the measurement when that
time is over, along the commands that were in force by then.

Clock: the action of tick i is in force from ``until_action`` seconds after the moment of the state's values, for one
period. With q = ceil(until_action / period) the command in force at the moment of state k is that of tick k - q.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from math import ceil, inf
from typing import Any, Final, NamedTuple, final

from safedpa.dynamics import PhysicsModel
from safedpa.safety.prediction.dead_time import LONGEST, ActuatorModel, InFlightCommands
from safedpa.safety.prediction.delay_estimator import Transition

__all__ = ["LONGEST_AGE", "CommandHistory", "DelayedPrediction"]

Plain = tuple[float, ...]

LONGEST_AGE: Final = 1.0
"""s; a state whose action acts later than that says nothing about where the robot is then."""
_ROUNDING: Final = 1e-9


class DelayedPrediction(NamedTuple):
    """The last two states, and what was predicted of them from before the dead time."""

    hoped_before: Sequence[float]
    before: Sequence[float]
    hoped: Sequence[float]


@dataclass
class _DatedTransition:
    tick: int
    values: Plain
    applied: Plain
    memory: Any
    """What the actuators remember when this tick's action is put in force."""
    sent: tuple[Plain, Any]
    """The action in force before it, and what the actuators remembered when that was put in force."""
    latent: Plain | None = None
    decided: bool = False


@final
class CommandHistory:
    """Of a robot with this model; one entry a tick."""

    def __init__(self, model: PhysicsModel) -> None:
        self._model, self._actuators = model, ActuatorModel(model)
        self._entries: deque[_DatedTransition] = deque(maxlen=LONGEST + ceil(LONGEST_AGE / model.period) + 2)

    def add(self, tick: int, values: Plain, applied: Plain, memory: Any) -> None:
        """The state of a tick, the action in force before it, and the actuators' memory; begins again after a gap."""
        if self._entries and self._entries[-1].tick != tick - 1:
            self._entries.clear()
        before = self._entries[-1].memory if self._entries else memory
        self._entries.append(_DatedTransition(tick, values, applied, memory, (applied, before)))

    def commands(self, tick: int, applied: Plain) -> list[Plain]:
        """What was in force before each tick up to this one, oldest first; ``applied`` alone after a gap."""
        known = [entry.applied for entry in self._entries if entry.tick < tick]
        return [*known, applied] if known and self._entries[-1].tick in (tick - 1, tick) else [applied]

    def passed(self, most: int) -> Transition | None:
        """The last period with the commands of 0 to ``most`` periods earlier; None where they are not known.

        Before a robot's first tick there were none: what it holds there was always in force.
        """
        entries = self._entries
        if len(entries) < 2 or (len(entries) < most + 2 and entries[0].tick != 0):
            return None
        first = entries[0].applied, entries[0].memory
        known = [entry.sent for entry in islice(reversed(entries), min(most + 1, len(entries) - 1))]
        commands = (*known, *[first] * (most + 1 - len(known)))
        return Transition(entries[-2].values, entries[-1].values, commands)

    def decided(self, latent: Plain | None) -> None:
        """The newest state's latent, with which its action was chosen."""
        self._entries[-1].latent, self._entries[-1].decided = latent, True

    def pending(self, until_action: float) -> InFlightCommands:
        """What is on its way at the newest state."""
        entries, period = self._entries, self._model.period
        count, rest = _delay(until_action, period)
        if count == 0:
            return InFlightCommands(entries[-1].memory, entries[-1].applied)
        oldest = entries[max(0, len(entries) - 1 - count)]
        commands = [entry.applied for entry in list(entries)[-count:]]
        commands = [commands[0]] * (count - len(commands)) + commands
        memory = self._model.felt(commands[0], oldest.memory, oldest.latent, period=rest)[1] if rest else oldest.memory
        spans = [period - rest] + [period] * (count - 1)
        return InFlightCommands(memory, commands[-1], tuple(zip(commands, spans, strict=True)))

    def expected(self, action: Plain, latent: Plain | None, pending: InFlightCommands, steps: int) -> list[list[float]]:
        """(steps, states) one period apart from the newest state on: what is pending is in force, then the action."""
        left = deque((*pending.sent, (action, inf)))
        now, memory = self._entries[-1].values, pending.memory
        rows = list[list[float]]()
        for _ in range(steps):
            wanted = self._model.period
            while wanted > _ROUNDING:
                command, seconds = left.popleft()
                span = min(seconds, wanted)
                now, memory = self._actuators.moved(now, command, memory, latent, span)
                wanted -= span
                if seconds > span + _ROUNDING:
                    left.appendleft((command, seconds - span))
            rows.append(list(now))
        return rows

    def delayed_prediction(self, until_action: float) -> DelayedPrediction | None:
        """The newest two states, predicted from before the dead time; None: there is none, or it is not yet over."""
        entries, period = list(self._entries), self._model.period
        count, rest = _delay(until_action, period)
        newest = len(entries) - 1
        if newest < 1 or not entries[newest - 1].decided:
            return None
        waits = self._actuators.reach(entries[newest - 1].latent).last + count
        start = newest - 1 - waits
        if waits == 0 or start - count < 0 or not entries[start].decided:
            return None
        first = entries[start]
        memory = entries[start - count].memory
        if rest:
            memory = self._model.felt(entries[start - count + 1].applied, memory, first.latent, period=rest)[1]
        now, before = first.values, first.values
        for index in range(start - count + 1, newest - count + 1):
            before = now
            for command, seconds in ((index, period - rest), (index + 1, rest)):
                if seconds > 0.0:
                    action = entries[command].applied
                    now, memory = self._actuators.moved(now, action, memory, first.latent, seconds)
        return DelayedPrediction(before, entries[newest - 1].values, now)


def _delay(until_action: float, period: float) -> tuple[int, float]:
    """Whole periods, rounded up, and what was rounded up [s]."""
    count = max(0, ceil(until_action / period - _ROUNDING))
    rest = count * period - until_action
    return count, rest if rest > _ROUNDING else 0.0
