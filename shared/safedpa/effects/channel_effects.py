"""Effects on commands: gain, offset, dead zone, limit, lag and delay of any actuator channel.

``KINDS`` has the six equations. Each robot declares its effects of these kinds in one table, ``EFFECTS`` in
``effects`` of its package; ``general_effects`` declares them for a system of the user's own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import inf
from typing import Any, final

from safedpa.effects.effect import CommandEffect, Named, Stage
from safedpa.effects.parameter import Parameter
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


EVERY: tuple[str, ...] = ()
"""All commands alike."""


@final
@dataclass(frozen=True)
class ChannelKind:
    """What one kind of effect makes of a command u, with its parameter p."""

    stage: Stage
    equation: str
    feel: Callable[[Scalar, Any, Scalar, Parameter, float, Operations], tuple[Scalar, Any]]
    """(u, memory, p, declaration of p, period [s], operations) -> (mean of the felt u, memory after the period)."""
    settle: Callable[[Scalar], Any] | None = None
    """The memory after u has been held for a long time; None: the kind remembers nothing."""


KINDS: Mapping[str, ChannelKind] = {
    "gain": ChannelKind(Stage.COMMAND_SCALE, "{u}_felt = {p} {u}", lambda u, memory, p, *_: (u * p, memory)),
    "offset": ChannelKind(Stage.COMMAND_OFFSET, "{u}_felt = {u} + {p}", lambda u, memory, p, *_: (u + p, memory)),
    "dead_zone": ChannelKind(
        Stage.COMMAND_SCALE,
        "{u}_felt = {u} - clip({u}, -{p}, {p})",
        lambda u, memory, p, _, __, operations: (u - operations.clip(u, -p, p), memory),
    ),
    "limit": ChannelKind(
        Stage.COMMAND_STOPS,
        "{u}_felt = clip({u}, -{p}, {p})",
        lambda u, memory, p, _, __, operations: (operations.clip(u, -p, p), memory),
    ),
    "lag": ChannelKind(
        Stage.COMMAND_LAG,
        "{p} d({u}_felt)/dt = {u} - {u}_felt",
        lambda u, memory, p, _, period, operations: follow(u, memory, p, period, operations),
        settle=lambda u: u,
    ),
    "delay": ChannelKind(
        Stage.COMMAND_DELAY,
        "{u}_felt(t) = {u}(t - {p})",
        # the history reaches as far back as the parameter allows: it may be fitted while the memory lives on
        lambda u, memory, p, declared, period, operations: delayed(u, memory, p, declared.high, period, operations),
        settle=settled,
    ),
}


@final
class ChannelEffect(CommandEffect):
    """An effect of one of the ``KINDS``: on one command, on ``EVERY`` one, or on those of several that the robot has.

    ``called`` is the command's name in the equation. The memory is one entry for each command, by name.
    """

    def __init__(
        self,
        robot: str,
        name: str,
        channel: str | tuple[str, ...],
        kind: str,
        parameter: Parameter,
        *,
        signature: str,
        source: str,
        called: str = "",
        needs: tuple[str, ...] = (),
        mirrored: tuple[str, ...] = (),
    ) -> None:
        own = KINDS[kind]
        self.kind = kind  # by its name: functions cannot be pickled
        self.channels = (channel,) if isinstance(channel, str) else channel
        self.robot: str = robot  # type: ignore[misc]
        self.name: str = name  # type: ignore[misc]
        self.stage: Stage = own.stage  # type: ignore[misc]
        self.equation: str = own.equation.format(u=called or channel, p=parameter.name)  # type: ignore[misc]
        self.parameters: tuple[Parameter, ...] = (parameter,)  # type: ignore[misc]
        self.signature: str = signature  # type: ignore[misc]
        self.source: str = source  # type: ignore[misc]
        self.needs: tuple[str, ...] = needs  # type: ignore[misc]
        self.mirrored: tuple[str, ...] = mirrored  # type: ignore[misc]

    def commands(self, action: Mapping[str, Any]) -> list[str]:
        """The names of the commands that it acts on."""
        return [name for name in action if name in self.channels] if self.channels else list(action)

    def initial_memory(self, action: Named) -> Any:  # noqa: D102
        settle = KINDS[self.kind].settle
        return None if settle is None else {name: settle(action[name]) for name in self.commands(action)}

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        (declared,) = self.parameters
        feel, value, felt, after = KINDS[self.kind].feel, parameters[declared.name], dict(action), {}
        for name in self.commands(action):
            own = None if memory is None else memory[name]
            felt[name], after[name] = feel(action[name], own, value, declared, period, operations)
        return felt, None if memory is None else after
