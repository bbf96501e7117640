"""Dead-time compensation: where the robot will be when an action that is chosen now takes effect.

An action takes effect late: commands sent before arrive first, actuators respond slowly, and the state itself is older
than the moment at which the action is applied. Until then no one can change what happens. So a barrier constraint is
imposed at the state where this action takes effect,

    h(x[n+1]) >= (1 - eta) h(x[n]) + epsilon,     x[n] = state after n periods if the last command stays,
                                                  x[n+1] = state one period later if this action is sent from now on,

with n the dead time of the slowest channel in whole periods. The action that continues the last plan leads to the x[n]
of the next tick, so each decision starts from what the last one promised. With a pure delay of all channels x[n] does
not depend on the action at all; a faster channel is assumed to hold the action meanwhile.

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
    "MAX_PERIODS",
    "NO_RESPONSE",
    "ActuatorModel",
    "DeadTime",
    "EffectStart",
    "InFlightCommands",
    "MultiStepBarriers",
]

Plain = tuple[float, ...]

NO_RESPONSE: Final = 1e-9
"""Share of an action's range below which its effect within a period counts as none: it is still in flight."""
_IMMEDIATE: Final = 0.25
"""Dead time in periods below which an actuator counts as immediate: 3/4 of the action then act in its own period."""
MAX_PERIODS: Final = 64
"""Periods after which any actuator counts as settled."""
_SETTLED: Final = 0.99
"""Share of the action's range at which an actuator counts as settled."""
_LATENT_DECIMALS: Final = 3
"""Decimals of the latent in the key of the cache of dead times: 1 ms, if the latent is a time constant."""
_WHOLE: Final = 1e-6
"""Share of a period by which a sum of parts may fall short of a whole one by rounding."""
_DIFFERENCE_STEP: Final = 1e-3
"""Share of an action's range for difference quotients: small against the range, large against rounding."""


class InFlightCommands(NamedTuple):
    """The commands in flight when a state was measured; may be passed to a filter as ``memory``."""

    memory: Any
    """State of the actuators at the measurement, as in the model; None: settled at ``last``."""
    last: Plain
    """(actions,) the last command sent."""
    queue: tuple[tuple[Plain, float], ...] = ()
    """Commands (actions,) that act between the measurement and the action chosen now, each with its duration [s]: the
    state's age plus the time from sensing to acting."""
    alternatives: tuple[InFlightCommands, ...] = ()
    """The commands in flight under other delays that are not ruled out: the constraints hold for each of them."""

    def periods(self, period: float) -> int:
        """Whole periods [s] between the measurement and the action chosen now."""
        return int(sum(seconds for _, seconds in self.queue) / period + _WHOLE)


class DeadTime(NamedTuple):
    """Delay of an action in whole periods from the moment at which it is applied."""

    min_periods: int
    """Periods in which no channel responds."""
    max_periods: int
    """Dead time of the slowest channel: the mean delay of its step response."""


class EffectStart(NamedTuple):
    """Where an action takes effect, and the states that are constrained."""

    state: Plain
    """(steps * states,) the constrained states if the last command stays: after each period in which only the faster
    channels respond, and finally where the slowest takes effect."""
    path: tuple[Plain, ...]
    """States from the measured one to the first that the action changes; no action can change them."""
    state_at_effect: Plain
    """(states,) the last of ``path``: from here on the action has an effect."""
    memory: Any
    """State of the actuators when the action is applied; None: settled at the action."""
    waiting_periods: int
    """Periods up to ``state_at_effect``, in which the action is in flight."""
    steps: int
    """Periods from ``state_at_effect`` to the end of the period that is constrained, 1 or more."""
    queued_periods: int = 0
    """Whole periods of commands in flight before the action: the margin of one step grows with them."""
    alternatives: tuple[EffectStart, ...] = ()
    """Where the action takes effect under other delays that are not ruled out."""

    @property
    def at_once(self) -> bool:
        """Whether the action acts within the period after ``state_at_effect``: only the state is older then."""
        return self.waiting_periods == 0 and self.steps == 1 and not self.alternatives

    @property
    def cases(self) -> tuple[EffectStart, ...]:
        """This and the alternatives: one for each delay for which the constraints are imposed."""
        return (self, *self.alternatives)


@final
class MultiStepBarriers:
    """A scalar evaluator of barriers at several successive states as if they were one state.

    The state has ``rows * states`` entries, and h has ``rows`` times as many.
    """

    def __init__(self, barriers: Any, rows: int, states: int) -> None:
        self._barriers, self._rows, self._states = barriers, rows, states
        self._count = 0

    def h_floats(self, state: Sequence[float]) -> list[float]:
        """h (rows * m,)."""
        found: list[float] = []
        for part in self._parts(state):
            found.extend(self._barriers.h_floats(part))
        # The number of rows of one state is known only after the first evaluation.
        self._count = len(found) // self._rows
        return found

    def lie_derivative_floats(
        self, state: Sequence[float], g: list[list[float]], widths: list[float], rows: Sequence[int]
    ) -> list[list[float]]:
        """d(h)/d(action) of ``rows``, after ``h_floats``. ``g`` (rows * states, actions)."""
        parts, count, states = self._parts(state), self._count, self._states
        found: list[list[float]] = []
        for row in rows:
            part, barrier = divmod(row, count)
            own = g[part * states : (part + 1) * states]
            found.extend(self._barriers.lie_derivative_floats(parts[part], own, widths, [barrier]))
        return found

    def grad_bound(self, state: Sequence[float]) -> list[float] | None:
        """An upper bound (rows * states,) of |d(h)/d(x)|; None if not known."""
        found: list[float] = []
        for part in self._parts(state):
            grad_bound = self._barriers.grad_bound(part)
            if grad_bound is None:
                return None
            found.extend(grad_bound)
        return found

    def _parts(self, state: Sequence[float]) -> list[Plain]:
        return [tuple(state[at : at + self._states]) for at in range(0, self._rows * self._states, self._states)]


@final
class ActuatorModel:
    """The actuators of one model: when actions take effect, and where the robot is then.

    Without actuator memory and without pending commands that is the measured state itself.
    """

    def __init__(self, model: PhysicsModel) -> None:
        self._model = model
        self._low, self._high = model.system.action_low.tolist(), model.system.action_high.tolist()
        self.has_memory = bool(model.initial_memory(np.array(self._low)))
        """Whether the model has actuators with memory."""
        self._known: dict[Plain, DeadTime] = {}

    def dead_time_periods(self, latent: Plain | None) -> DeadTime:
        """Dead time at the latent (latents,), from the model's response to a step of every action."""
        if not self.has_memory:
            return DeadTime(0, 0)
        key = () if latent is None else tuple([round(value, _LATENT_DECIMALS) for value in latent])
        known = self._known.get(key)
        if known is None:
            # A bounded cache: an estimated latent drifts, and each value would otherwise stay in memory.
            if len(self._known) >= MAX_PERIODS:
                self._known.clear()
            known = self._known[key] = self._measure_dead_time(latent)
        return known

    def dead_time(self, latent: Plain | None) -> float:
        """Time [s] from applying an action until the slowest channel responds."""
        return self.dead_time_periods(latent).max_periods * self._model.period

    def effect_start(self, state: Plain, latent: Plain | None, pending: Any) -> EffectStart | None:
        """Where an action chosen at ``state`` (states,) takes effect; ``pending`` is the filter's ``memory``.

        None: immediately, at ``state``.
        """
        if isinstance(pending, InFlightCommands) and pending.alternatives:
            found = [self._effect_start(state, latent, one) for one in (pending, *pending.alternatives)]
            # Immediately: the case of the measured state itself, to which the others are added.
            main = EffectStart(state, (), state, pending.memory, 0, 1) if found[0] is None else found[0]
            return main._replace(alternatives=tuple([one for one in found[1:] if one is not None]))
        return self._effect_start(state, latent, pending)

    def _effect_start(self, state: Plain, latent: Plain | None, pending: Any) -> EffectStart | None:
        """Where an action takes effect under one delay; None: immediately, at ``state``."""
        first, last = self.dead_time_periods(latent)
        if last == 0 and not (isinstance(pending, InFlightCommands) and pending.queue):
            return None
        known = pending if isinstance(pending, InFlightCommands) else InFlightCommands(pending, ())
        queued = known.periods(self._model.period)
        memory, now = known.memory, state
        if memory is None and known.last:
            free = None if latent is None else np.array(latent)
            memory = self._model.initial_memory(np.array(known.last), free)
        last_command, path = known.last, list[Plain]()
        for command, seconds in known.queue:
            now, memory = self.advance(now, command, memory, latent, seconds)
            path.append(now)
        if memory is None:  # no command is known: as if this action had always been applied
            return EffectStart(state, (), state, None, 0, 1)
        # Without a last command only the first periods can be predicted: in them no command has an effect.
        if not last_command:
            last_command, last = tuple(self._low), first
        memory_at_start, state_at_effect, constrained = memory, now, list[float]()
        for step in range(last):
            now, memory = self.advance(now, last_command, memory, latent, self._model.period)
            if step < first:
                state_at_effect = now
                path.append(state_at_effect)
            else:
                constrained.extend(now)
        # x[n] of the module's equation: the slowest channel responds here, and only then is the whole action felt.
        constrained.extend(now)
        return EffectStart(
            tuple(constrained), tuple(path), state_at_effect, memory_at_start, first, last - first + 1, queued
        )

    def advance(
        self, now: Plain, command: Plain, memory: Any, latent: Plain | None, seconds: float
    ) -> tuple[Plain, Any]:
        """State and actuator memory after ``seconds`` of a command.

        Uses the generated step in Python floats if there is one: a third of the time of arrays.
        """
        step = self._model.scalar_step(seconds)
        if step is not None:
            with suppress(ValueError, ArithmeticError):  # values that math functions refuse: the arrays return NaN
                free = self._model.latent.tolist() if latent is None else latent
                return tuple(step(now, command, free, self._model.clock.seconds)), memory
        free_array = None if latent is None else np.array(latent)
        after, memory = self._model.advance(np.array(now), np.array(command), memory, free_array, period=seconds)
        return tuple(after.tolist()), memory

    def rollout(self, effect: EffectStart, action: Sequence[float], latent: Plain | None) -> list[float]:
        """(steps * states,) after each period from ``effect.state_at_effect`` on under the action (actions,)."""
        free, command = None if latent is None else np.array(latent), np.array(action)
        # Unknown memory: the actuators are assumed to have settled at this very action.
        memory = self._model.initial_memory(command, free) if effect.memory is None else effect.memory
        now, found = np.array(effect.state_at_effect), list[float]()
        # Until the action takes effect only the actuators' memory changes; ``path`` already has the states.
        for _ in range(effect.waiting_periods):
            memory = self._model.felt(action, memory, latent, period=self._model.period)[1]
        for _ in range(effect.steps):
            now, memory = self._model.advance(now, command, memory, free)
            found.extend(now.tolist())
        return found

    def control_matrix(self, effect: EffectStart, around: Sequence[float], latent: Plain | None) -> list[list[float]]:
        """d(rollout)/d(action) (steps * states, actions) by differences within the action range."""
        columns: list[list[float]] = []
        for index, value in enumerate(around):
            nudge = _DIFFERENCE_STEP * (self._high[index] - self._low[index])
            # One-sided at a bound: the model need not be defined beyond the actuator's range.
            above, below = min(value + nudge, self._high[index]), max(value - nudge, self._low[index])
            above_states, below_states = (
                self.rollout(effect, [*around[:index], end, *around[index + 1 :]], latent) for end in (above, below)
            )
            columns.append(
                [(one - other) / (above - below) for one, other in zip(above_states, below_states, strict=True)]
            )
        return [list(entries) for entries in zip(*columns, strict=True)]

    def _measure_dead_time(self, latent: Plain | None) -> DeadTime:
        """Dead times from the mean effect, in each period, of a step of every action from low to high."""
        model, period = self._model, self._model.period
        free = None if latent is None else np.array(latent)
        low_memory, high_memory = (model.initial_memory(np.array(end), free) for end in (self._low, self._high))
        rest = model.felt(self._low, low_memory, latent, period=period)[0]
        full_change = [
            b - a for a, b in zip(rest, model.felt(self._high, high_memory, latent, period=period)[0], strict=True)
        ]
        # A channel that the actions do not reach has no delay, and its share would be 0 / 0.
        channels = [index for index, size in enumerate(full_change) if size != 0.0]
        delays, first, memory = [0.0] * len(full_change), MAX_PERIODS, low_memory
        for step in range(MAX_PERIODS):
            felt, memory = model.felt(self._high, memory, latent, period=period)
            shares = [(felt[index] - rest[index]) / full_change[index] for index in channels]
            if step < first and any(abs(share) > NO_RESPONSE for share in shares):
                first = step
            for index, share in zip(channels, shares, strict=True):
                # The mean delay of a step response is the sum of what is missing in each period (for a first-order lag
                # its time constant).
                delays[index] += 1.0 - share
            if all(share >= _SETTLED for share in shares):
                break
        last = max((ceil(delays[index] - _IMMEDIATE) for index in channels), default=0)
        # If no channel responds, ``first`` still has its start value.
        return DeadTime(min(first, last), max(last, 0))
