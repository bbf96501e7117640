"""Effects on commands: gain, offset, dead zone, limits, lags, delays and play of any actuator channel.

``KINDS`` has the equations. Each robot declares its effects of these kinds in one table, ``EFFECTS`` in
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


_UNLIMITED = 1e300
"""More than any command moves in a period; its square root still is."""


def slewed(
    command: Scalar,
    felt: Scalar,
    up: Scalar,
    down: Scalar,
    unlimited: float,
    period: float,
    operations: Operations,
) -> tuple[Scalar, Scalar]:
    """Returns the mean of ``felt`` over one period while it moves to ``command`` with limited rates, and its end.

    -down <= d(felt)/dt <= up; from the rate ``unlimited`` on there is no limit. With the change c of the period,
    clipped to its limits, and the limit m on the side of c, the mean is felt + c - c |c| / (2 m), the end felt + c.
    """
    rise = operations.where(up >= unlimited, _UNLIMITED, up * period)
    fall = operations.where(down >= unlimited, _UNLIMITED, down * period)
    gap = command - felt
    moved = operations.clip(gap, -fall, rise)
    rising, falling = operations.maximum(moved, 0.0), operations.minimum(moved, 0.0)
    # written as command minus the rest, so that a command that is reached is met exactly
    end = command - (gap - moved)
    return end - rising * rising / (2.0 * rise) + falling * falling / (2.0 * fall), end


def oscillated(
    command: Scalar,
    memory: tuple[Scalar, Scalar],
    frequency: Scalar,
    damping: Scalar,
    fastest: float,
    period: float,
    operations: Operations,
) -> tuple[Scalar, tuple[Scalar, Scalar]]:
    """Returns the mean over one period of y'' = w^2 (command - y) - 2 z w y', and (y, y') at its end.

    Exact for a held command. With e = y - command, a = z w, b = w sqrt(1 - z^2):
    e(t) = exp(-a t) (e cos(b t) + (y' + a e) / b sin(b t)), and the mean of e follows from the equation itself. From
    the frequency ``fastest`` [rad/s] on, y = command.

    Source: Ogata, Modern Control Engineering, 5th ed., section 5-3.
    """
    felt, speed = memory
    decay, turn = damping * frequency, frequency * operations.sqrt(1.0 - damping * damping)
    shrunk = operations.exp(-decay * period)
    cosine, sine = shrunk * operations.cos(turn * period), shrunk * operations.sin(turn * period) / turn
    error = felt - command
    after = error * cosine + (speed + decay * error) * sine
    speed_after = speed * cosine - (decay * speed + frequency * frequency * error) * sine
    mean = -((speed_after - speed) + 2.0 * decay * (after - error)) / (frequency * frequency * period)
    free = frequency >= fastest
    ends = operations.where(free, command, command + after), operations.where(free, 0.0 * command, speed_after)
    return operations.where(free, command, command + mean), ends


_DRAINING_STEPS = 4
"""Implicit steps in a period: the outflow is then within 1 % of the exact one for time constants above a period."""


def drained(
    inflow: Scalar, outflow: Scalar, emptiness: Scalar, period: float, operations: Operations
) -> tuple[Scalar, Scalar]:
    """Returns the mean outflow over one period of a vessel with a hole, and the outflow at its end; both at least 0.

    The content h has h' = inflow - c sqrt(h), c^2 = 2 / emptiness, so the outflow q has emptiness q q' = inflow - q: a
    lag whose time constant is emptiness q. At emptiness 0 the outflow is the inflow. The steps are implicit, so they
    are stable for every emptiness; the mean outflow is the inflow less the change of the content.

    Source: Torricelli, 1643; Schoukens and Noel, IFAC-PapersOnLine 50, 2017 (two vessels in a row).
    """
    some = operations.maximum(emptiness, _SMALLEST_TIME_CONSTANT)
    # content and step in units in which the outflow is the root of the content: h = emptiness q^2 / 2
    root, part = operations.maximum(outflow, 0.0), period / _DRAINING_STEPS
    first = 0.5 * some * root * root
    content = first
    for _ in range(_DRAINING_STEPS):
        filled = operations.maximum(content + part * inflow, 0.0)
        # some q^2 / 2 + part q = filled, by the formula without cancellation
        root = 2.0 * filled / (part + operations.sqrt(part * part + 2.0 * some * filled))
        content = 0.5 * some * root * root
    free = emptiness <= _SMALLEST_TIME_CONSTANT
    mean = inflow - (content - first) / period
    return operations.where(free, inflow, mean), operations.where(free, inflow, root)


EVERY: tuple[str, ...] = ()
"""All commands alike."""


@final
@dataclass(frozen=True)
class ChannelKind:
    """What one kind of effect makes of a command u, with its parameters p."""

    stage: Stage
    equation: str
    """Over {u} and the names of the parameters {p}, {q}."""
    feel: Callable[[Scalar, Any, tuple[Scalar, ...], tuple[Parameter, ...], float, Operations], tuple[Scalar, Any]]
    """(u, memory, p, declarations of p, period [s], operations) -> (mean of the felt u, memory after the period)."""
    settle: Callable[[Scalar], Any] | None = None
    """The memory after u has been held for a long time; None: the kind remembers nothing."""


def _with_play(u: Scalar, felt: Scalar, width: Scalar, operations: Operations) -> tuple[Scalar, Scalar]:
    after = operations.clip(felt, u - 0.5 * width, u + 0.5 * width)
    return after, after


def _lag_up_down(
    u: Scalar, felt: Scalar, p: tuple[Scalar, ...], period: float, operations: Operations
) -> tuple[Scalar, Scalar]:
    """Returns ``follow`` with one time constant for a rising and one for a falling ``felt``, which never crosses u."""
    difference, mean, end = felt - u, u, u
    for side, time_constant in zip((operations.minimum, operations.maximum), p, strict=True):
        own = side(difference, 0.0)
        over, at_end = follow(0.0 * own, own, time_constant, period, operations)
        mean, end = mean + over, end + at_end
    return mean, end


KINDS: Mapping[str, ChannelKind] = {
    "gain": ChannelKind(Stage.COMMAND_SCALE, "{u}_felt = {p} {u}", lambda u, memory, p, *_: (u * p[0], memory)),
    "offset": ChannelKind(Stage.COMMAND_OFFSET, "{u}_felt = {u} + {p}", lambda u, memory, p, *_: (u + p[0], memory)),
    "dead_zone": ChannelKind(
        Stage.COMMAND_DEAD_ZONE,
        "{u}_felt = {u} - clip({u}, -{p}, {p})",
        lambda u, memory, p, _, __, operations: (u - operations.clip(u, -p[0], p[0]), memory),
    ),
    "curve": ChannelKind(
        Stage.COMMAND_CURVE,
        "{u}_felt = {u} + {p} |{u}| {u}",
        lambda u, memory, p, _, __, operations: (u + p[0] * operations.absolute(u) * u, memory),
    ),
    "limit": ChannelKind(
        Stage.COMMAND_STOPS,
        "{u}_felt = clip({u}, -{p}, {p})",
        lambda u, memory, p, _, __, operations: (operations.clip(u, -p[0], p[0]), memory),
    ),
    "limit_up_down": ChannelKind(
        Stage.COMMAND_STOPS,
        "{u}_felt = clip({u}, {q}, {p})",
        lambda u, memory, p, _, __, operations: (operations.clip(u, p[1], p[0]), memory),
    ),
    "backlash": ChannelKind(
        Stage.COMMAND_LINKAGE,
        "{u}_felt = clip({u}_felt, {u} - {p}/2, {u} + {p}/2)",
        lambda u, memory, p, _, __, operations: _with_play(u, memory, p[0], operations),
        settle=lambda u: u,
    ),
    "slew_limit": ChannelKind(
        Stage.COMMAND_SLEW,
        "|d({u}_felt)/dt| <= {p}",
        lambda u, memory, p, declared, period, operations: slewed(
            u, memory, p[0], p[0], declared[0].high, period, operations
        ),
        settle=lambda u: u,
    ),
    "slew_limit_up_down": ChannelKind(
        Stage.COMMAND_SLEW,
        "-{q} <= d({u}_felt)/dt <= {p}",
        lambda u, memory, p, declared, period, operations: slewed(
            u, memory, p[0], p[1], declared[0].high, period, operations
        ),
        settle=lambda u: u,
    ),
    "second_order": ChannelKind(
        Stage.COMMAND_LAG,
        "d2({u}_felt)/dt2 = {p}^2 ({u} - {u}_felt) - 2 {q} {p} d({u}_felt)/dt",
        lambda u, memory, p, declared, period, operations: oscillated(
            u, memory, p[0], p[1], declared[0].high, period, operations
        ),
        settle=lambda u: (u, 0.0 * u),
    ),
    "lag": ChannelKind(
        Stage.COMMAND_LAG,
        "{p} d({u}_felt)/dt = {u} - {u}_felt",
        lambda u, memory, p, _, period, operations: follow(u, memory, p[0], period, operations),
        settle=lambda u: u,
    ),
    "lag_up_down": ChannelKind(
        Stage.COMMAND_LAG,
        "T d({u}_felt)/dt = {u} - {u}_felt, T = {p} while it rises and {q} while it falls",
        lambda u, memory, p, _, period, operations: _lag_up_down(u, memory, p, period, operations),
        settle=lambda u: u,
    ),
    "reservoir": ChannelKind(
        Stage.COMMAND_LAG,
        "{p} {u}_felt d({u}_felt)/dt = {u} - {u}_felt",
        lambda u, memory, p, _, period, operations: drained(u, memory, p[0], period, operations),
        settle=lambda u: u,
    ),
    "delay": ChannelKind(
        Stage.COMMAND_DELAY,
        "{u}_felt(t) = {u}(t - {p})",
        # the history reaches as far back as the parameter allows: it may be fitted while the memory lives on
        lambda u, memory, p, declared, period, operations: delayed(
            u, memory, p[0], declared[0].high, period, operations
        ),
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
        parameters: Parameter | tuple[Parameter, ...],
        *,
        signature: str,
        source: str,
        called: str = "",
        needs: tuple[str, ...] = (),
        mirrored: tuple[str, ...] = (),
        partners: tuple[str, ...] = (),
        rare: bool = False,
        by_period: Callable[[float], tuple[Parameter, ...]] | None = None,
    ) -> None:
        own, declared = KINDS[kind], (parameters,) if isinstance(parameters, Parameter) else parameters
        names = dict(zip("pq", (parameter.name for parameter in declared), strict=False))
        self.kind = kind  # by its name: functions cannot be pickled
        self.channels = (channel,) if isinstance(channel, str) else channel
        self.robot: str = robot  # type: ignore[misc]
        self.name: str = name  # type: ignore[misc]
        self.stage: Stage = own.stage  # type: ignore[misc]
        self.equation: str = own.equation.format(u=called or channel, **names)  # type: ignore[misc]
        self.parameters: tuple[Parameter, ...] = declared  # type: ignore[misc]
        self.signature: str = signature  # type: ignore[misc]
        self.source: str = source  # type: ignore[misc]
        self.needs: tuple[str, ...] = needs  # type: ignore[misc]
        self.mirrored: tuple[str, ...] = mirrored  # type: ignore[misc]
        self.family, self.partners, self.rare = kind, partners, rare  # type: ignore[misc]
        self.by_period = by_period

    def commands(self, action: Mapping[str, Any]) -> list[str]:
        """The names of the commands that it acts on."""
        return [name for name in action if name in self.channels] if self.channels else list(action)

    def initial_memory(self, action: Named) -> Any:  # noqa: D102
        settle = KINDS[self.kind].settle
        return None if settle is None else {name: settle(action[name]) for name in self.commands(action)}

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        values = tuple(parameters[declared.name] for declared in self.parameters)
        feel, felt, after = KINDS[self.kind].feel, dict(action), {}
        for name in self.commands(action):
            own = None if memory is None else memory[name]
            felt[name], after[name] = feel(action[name], own, values, self.parameters, period, operations)
        return felt, None if memory is None else after
