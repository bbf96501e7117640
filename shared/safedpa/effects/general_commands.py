"""Effects on any one action of any system: what the library has for a car's drive and steer, for a channel by name."""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.effect import CommandEffect, Named, Stage
from safedpa.effects.memory import delayed, follow, settled
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations

__all__ = [
    "ChannelDeadZone", "ChannelDelay", "ChannelEffect", "ChannelGain", "ChannelLag", "ChannelLimit", "ChannelOffset",
]  # fmt: skip


class ChannelEffect(CommandEffect):
    """An effect on the action ``channel`` of a robot, called ``{channel}_{kind}``."""

    def __init__(self, robot: str, channel: str, kind: str, equation: str, parameter: Parameter) -> None:
        self.robot: str = robot  # type: ignore[misc]
        self.channel = channel
        self.name: str = f"{channel}_{kind}"  # type: ignore[misc]
        self.equation: str = equation.replace("u", channel)  # type: ignore[misc]
        self.parameters: tuple[Parameter, ...] = (parameter,)  # type: ignore[misc]
        self.needs: tuple[str, ...] = (channel,)  # type: ignore[misc]


@final
class ChannelGain(ChannelEffect):
    """felt u = gain u."""

    stage = Stage.COMMAND_SCALE
    signature = "the answer to the action differs by the same share at every size"
    source = "static gain of an actuator; Astrom and Murray, Feedback Systems, 2nd ed., ch. 3"

    def __init__(self, robot: str, channel: str) -> None:
        super().__init__(
            robot, channel, "gain", "u_felt = gain u", Parameter("gain", "1", 0.05, 5.0, 0.85, neutral=1.0)
        )

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        return {**action, self.channel: action[self.channel] * parameters["gain"]}, memory


@final
class ChannelOffset(ChannelEffect):
    """felt u = u + offset."""

    stage = Stage.COMMAND_OFFSET
    signature = "a residual of one size and sign, whatever the action"
    source = "trim of an actuator; Astrom and Murray, Feedback Systems, 2nd ed., ch. 3"

    def __init__(self, robot: str, channel: str, unit: str, size: float) -> None:
        parameter = Parameter("offset", unit, -size, size, 0.05 * size)
        super().__init__(robot, channel, "offset", "u_felt = u + offset", parameter)

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        return {**action, self.channel: action[self.channel] + parameters["offset"]}, memory


@final
class ChannelDeadZone(ChannelEffect):
    """felt u = u - clip(u, -width, width)."""

    stage = Stage.COMMAND_SCALE
    signature = "a residual against the action that grows with it up to a width, then of one size"
    source = "Tao and Kokotovic, Adaptive Control of Systems with Actuator and Sensor Nonlinearities, 1996, ch. 2"

    def __init__(self, robot: str, channel: str, unit: str, size: float) -> None:
        parameter = Parameter("width", unit, 0.0, 0.9 * size, 0.1 * size)
        super().__init__(robot, channel, "dead_zone", "u_felt = u - clip(u, -width, width)", parameter)

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        command, width = action[self.channel], parameters["width"]
        return {**action, self.channel: command - operations.clip(command, -width, width)}, memory


@final
class ChannelLimit(ChannelEffect):
    """felt u = clip(u, -limit, limit)."""

    stage = Stage.COMMAND_STOPS
    signature = "a residual beyond one size of the action only, growing with the excess"
    source = "saturation; Tao and Kokotovic, Adaptive Control of Systems, 1996, ch. 1"

    def __init__(self, robot: str, channel: str, unit: str, size: float) -> None:
        parameter = Parameter("limit", unit, 0.02 * size, size, 0.6 * size, neutral=size)
        super().__init__(robot, channel, "limit", "u_felt = clip(u, -limit, limit)", parameter)

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        limit = parameters["limit"]
        return {**action, self.channel: operations.clip(action[self.channel], -limit, limit)}, memory


@final
class ChannelLag(ChannelEffect):
    """time_constant d(felt u)/dt = u - felt u; the memory is the felt u."""

    stage = Stage.COMMAND_LAG
    signature = "a residual after each change of the action, of opposite sign to the change, dying out"
    source = "first-order actuator; Astrom and Murray, Feedback Systems, 2nd ed., ch. 3"

    def __init__(self, robot: str, channel: str) -> None:
        parameter = Parameter("time_constant", "s", 0.0, 2.0, 0.15)
        super().__init__(robot, channel, "lag", "time_constant d(u_felt)/dt = u - u_felt", parameter)

    def initial_memory(self, action: Named) -> Any:  # noqa: D102
        return action[self.channel]

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        mean, memory = follow(action[self.channel], memory, parameters["time_constant"], period, operations)
        return {**action, self.channel: mean}, memory


@final
class ChannelDelay(ChannelEffect):
    """felt u(t) = u(t - seconds); the memory is the history of the action."""

    stage = Stage.COMMAND_DELAY
    signature = "a residual after each change of the action, as if it had not been sent yet, then none"
    source = "dead time; Astrom and Murray, Feedback Systems, 2nd ed., ch. 9"

    def __init__(self, robot: str, channel: str) -> None:
        super().__init__(
            robot, channel, "delay", "u_felt(t) = u(t - seconds)", Parameter("seconds", "s", 0.0, 1.0, 0.1)
        )

    def initial_memory(self, action: Named) -> Any:  # noqa: D102
        return settled(action[self.channel])

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        longest = self.parameters[0].high
        felt, memory = delayed(action[self.channel], memory, parameters["seconds"], longest, period, operations)
        return {**action, self.channel: felt}, memory
