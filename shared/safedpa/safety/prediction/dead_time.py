"""What is on its way to the actuators: where the robot will be when an action that is chosen now begins to act.

An action that is sent now is felt late: what was sent before arrives first, actuators follow slowly, and the state
itself is older than the moment at which the action is put in force. Until then no one can change what happens. So a
barrier condition is judged at the state where this action begins to act,

    h(x[n+1]) >= (1 - eta) h(x[n]) + epsilon,     x[n] = state after n periods if the last command stays,
                                                  x[n+1] = state one period later if this action is sent from now on,

with n the dead time of the slowest channel in whole periods. The action that keeps the last plan going leads to the
x[n] of the next tick, so what one decision promises is where the next one begins. With a pure delay of all channels
x[n] does not depend on the action at all; of a quicker channel the action is held meanwhile.

Method: Smith, Closer control of loops with dead time, Chemical Engineering Progress 53, 1957 (predict past the dead
time, then control); for barriers Jankovic, Control barrier functions for constrained control of linear systems with
input delay, ACC 2018.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from math import ceil
from typing import Any, Final, NamedTuple, final

import numpy as np

from safedpa.dynamics import PhysicsModel

__all__ = [
    "LONGEST",
    "NOTHING_FELT",
    "ActuatorModel",
    "DeadTime",
    "EffectStart",
    "InFlightCommands",
    "MultiStepBarriers",
]

Plain = tuple[float, ...]

NOTHING_FELT: Final = 1e-9
"""Share of an action's range; what is felt of it within a period is less while it is only on its way."""
_AT_ONCE: Final = 0.25
"""Periods; an actuator with less dead time acts at once: three quarters of the action are felt in its own period."""
LONGEST: Final = 64
"""Periods after which an actuator counts as settled, whatever it is."""
_SETTLED: Final = 0.99
"""Share of the action's range that is felt once an actuator counts as settled."""
_SAME_LATENT: Final = 3
"""Decimals of the latent to which dead times are remembered: a thousandth of a second, where it is one."""
_NUDGE: Final = 1e-3
"""Share of an action's range by which it is changed to see what follows: small against the range, large against
rounding."""


class InFlightCommands(NamedTuple):
    """What is on its way when a state was measured; may be given as a filter's ``memory``."""

    memory: Any
    """What the actuators remember when the state was measured, as the model has it; None: they have settled at
    ``held``."""
    held: Plain
    """(actions,) the last command."""
    sent: tuple[tuple[Plain, float], ...] = ()
    """Commands (actions,) that are in force from the moment of the state until an action that is chosen now is, and for
    how long [s] each: the state's age, and the time from sense to act."""


class DeadTime(NamedTuple):
    """When an action acts, in whole periods from the moment at which it is put in force."""

    first: int
    """Periods in which nothing of it is felt on any channel."""
    last: int
    """Dead time of the slowest channel: the mean delay of its step response."""


class EffectStart(NamedTuple):
    """Where an action begins to act, and over what it is judged."""

    state: Plain
    """(rows * states,) what is judged if the last command stays: after each period in which the quicker channels act
    alone, and last where the slowest begins to act."""
    path: tuple[Plain, ...]
    """States between the measured one and the first that the action changes, which no one can change any more."""
    near: Plain
    """(states,) the last of them: from here on the action is felt."""
    memory: Any
    """What the actuators remember when the action is put in force; None: they have settled at the action."""
    waits: int
    """Periods from there to ``near``, in which the action is only on its way."""
    rows: int
    """Periods from ``near`` to the end of the period over which the action is judged, 1 or more."""

    @property
    def at_once(self) -> bool:
        """Whether the action is felt from ``near`` on, and judged one period later: only the state is older."""
        return self.waits == 0 and self.rows == 1


@final
class MultiStepBarriers:
    """Barriers over plain numbers at several states in a row as if they were one; ``heights``, ``along``, ``steepest``.

    Of a state of ``rows * states`` numbers; h has ``rows`` times as many entries.
    """

    def __init__(self, barriers: Any, rows: int, states: int) -> None:
        self._barriers, self._rows, self._states = barriers, rows, states
        self._count = 0

    def heights(self, state: Sequence[float]) -> list[float]:
        """h (rows * m,)."""
        found: list[float] = []
        for here in self._parts(state):
            found.extend(self._barriers.heights(here))
        self._count = len(found) // self._rows
        return found

    def along(
        self, state: Sequence[float], g: list[list[float]], widths: list[float], rows: Sequence[int]
    ) -> list[list[float]]:
        """What each action changes in h, of the rows asked for; after ``heights``. ``g`` (rows * states, actions)."""
        parts, count, states = self._parts(state), self._count, self._states
        found: list[list[float]] = []
        for row in rows:
            part, barrier = divmod(row, count)
            own = g[part * states : (part + 1) * states]
            found.extend(self._barriers.along(parts[part], own, widths, [barrier]))
        return found

    def steepest(self, state: Sequence[float]) -> list[float] | None:
        """(rows * states,) what no slope exceeds; None where that is not known."""
        found: list[float] = []
        for here in self._parts(state):
            steepest = self._barriers.steepest(here)
            if steepest is None:
                return None
            found.extend(steepest)
        return found

    def _parts(self, state: Sequence[float]) -> list[Plain]:
        return [tuple(state[at : at + self._states]) for at in range(0, self._rows * self._states, self._states)]


@final
class ActuatorModel:
    """When the actions of one model act, and where the robot is then.

    Without actuators that remember, and with nothing pending, that is the measured state itself.
    """

    def __init__(self, model: PhysicsModel) -> None:
        self._model = model
        self._low, self._high = model.system.action_low.tolist(), model.system.action_high.tolist()
        self.remember = bool(model.initial_memory(np.array(self._low)))
        """Whether the model has actuators with a memory at all."""
        self._known: dict[Plain, DeadTime] = {}

    def reach(self, latent: Plain | None) -> DeadTime:
        """First and last periods at the latent (latents,), from the model's response to a step of each action."""
        if not self.remember:
            return DeadTime(0, 0)
        key = () if latent is None else tuple([round(value, _SAME_LATENT) for value in latent])
        known = self._known.get(key)
        if known is None:
            if len(self._known) >= LONGEST:
                self._known.clear()
            known = self._known[key] = self._responded(latent)
        return known

    def dead_time(self, latent: Plain | None) -> float:
        """s until the slowest channel begins to act, from the moment at which an action is put in force."""
        return self.reach(latent).last * self._model.period

    def begin(self, state: Plain, latent: Plain | None, pending: Any) -> EffectStart | None:
        """Where an action begins to act that is chosen at ``state`` (states,), ``pending`` as a filter's ``memory``.

        None: there and then.
        """
        first, last = self.reach(latent)
        if last == 0 and not (isinstance(pending, InFlightCommands) and pending.sent):
            return None
        known = pending if isinstance(pending, InFlightCommands) else InFlightCommands(pending, ())
        memory, now = known.memory, state
        if memory is None and known.held:
            free = None if latent is None else np.array(latent)
            memory = self._model.initial_memory(np.array(known.held), free)
        held, path = known.held, list[Plain]()
        for command, seconds in known.sent:
            now, memory = self.moved(now, command, memory, latent, seconds)
            path.append(now)
        if memory is None:  # nothing is known of what was sent: as if this action had always been in force
            return EffectStart(state, (), state, None, 0, 1)
        if not held:  # nothing of it is felt in the first periods, and beyond them it would have to be known
            held, last = tuple(self._low), first
        at_first, near, base = memory, now, list[float]()
        for step in range(last):
            now, memory = self.moved(now, held, memory, latent, self._model.period)
            if step < first:
                near = now
                path.append(near)
            else:
                base.extend(now)
        base.extend(now)
        return EffectStart(tuple(base), tuple(path), near, at_first, first, last - first + 1)

    def moved(self, now: Plain, command: Plain, memory: Any, latent: Plain | None, seconds: float) -> tuple[Plain, Any]:
        """State and the actuators' memory after ``seconds`` with a command in force; by the straight line if there is
        one, a third of the time of arrays for the same numbers."""
        step = self._model.straight(seconds)
        if step is not None:
            with suppress(ValueError, ArithmeticError):  # the arrays answer
                free = self._model.latent.tolist() if latent is None else latent
                return tuple(step(now, command, free, self._model.clock.seconds)), memory
        free_array = None if latent is None else np.array(latent)
        after, memory = self._model.advance(np.array(now), np.array(command), memory, free_array, period=seconds)
        return tuple(after.tolist()), memory

    def after(self, begin: EffectStart, action: Sequence[float], latent: Plain | None) -> list[float]:
        """(rows * states,) after each period from ``begin.near`` on with the action (actions,) in force."""
        free, command = None if latent is None else np.array(latent), np.array(action)
        memory = self._model.initial_memory(command, free) if begin.memory is None else begin.memory
        now, found = np.array(begin.near), list[float]()
        for _ in range(begin.waits):
            memory = self._model.felt(action, memory, latent, period=self._model.period)[1]
        for _ in range(begin.rows):
            now, memory = self._model.advance(now, command, memory, free)
            found.extend(now.tolist())
        return found

    def slopes(self, begin: EffectStart, around: Sequence[float], latent: Plain | None) -> list[list[float]]:
        """d(after)/d(action) (rows * states, actions) by differences within the range of the actions."""
        columns: list[list[float]] = []
        for index, value in enumerate(around):
            nudge = _NUDGE * (self._high[index] - self._low[index])
            above, below = min(value + nudge, self._high[index]), max(value - nudge, self._low[index])
            higher, lower = (
                self.after(begin, [*around[:index], end, *around[index + 1 :]], latent) for end in (above, below)
            )
            columns.append([(one - other) / (above - below) for one, other in zip(higher, lower, strict=True)])
        return [list(entries) for entries in zip(*columns, strict=True)]

    def _responded(self, latent: Plain | None) -> DeadTime:
        """From the share of a step of every action, low to high, that is felt in the mean over each period."""
        model, period = self._model, self._model.period
        free = None if latent is None else np.array(latent)
        calm, risen = (model.initial_memory(np.array(end), free) for end in (self._low, self._high))
        rest = model.felt(self._low, calm, latent, period=period)[0]
        whole = [b - a for a, b in zip(rest, model.felt(self._high, risen, latent, period=period)[0], strict=True)]
        acting = [index for index, size in enumerate(whole) if size != 0.0]
        dead, first, memory = [0.0] * len(whole), LONGEST, calm
        for step in range(LONGEST):
            felt, memory = model.felt(self._high, memory, latent, period=period)
            shares = [(felt[index] - rest[index]) / whole[index] for index in acting]
            if step < first and any(abs(share) > NOTHING_FELT for share in shares):
                first = step
            for index, share in zip(acting, shares, strict=True):
                dead[index] += 1.0 - share
            if all(share >= _SETTLED for share in shares):
                break
        last = max((ceil(dead[index] - _AT_ONCE) for index in acting), default=0)
        return DeadTime(min(first, last), max(last, 0))
