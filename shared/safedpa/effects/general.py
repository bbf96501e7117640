"""The library for a system of one's own: every general effect on its actions and on the rates of its states."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import final

from safedpa.effects.effect import AbstractEffect, Context, Named, RateEffect, Stage
from safedpa.effects.friction import direction_of
from safedpa.effects.general_commands import (
    ChannelDeadZone,
    ChannelDelay,
    ChannelGain,
    ChannelLag,
    ChannelLimit,
    ChannelOffset,
)
from safedpa.effects.parameter import Parameter
from safedpa.errors import InputError, did_you_mean
from safedpa.systems import System, Variable

__all__ = ["StateDrag", "StateEffect", "StateFriction", "StatePush", "StateQuadraticDrag", "general_effects"]

_REST = 0.02
"""Of what is usual: below it a state counts as nearly at rest."""


class StateEffect(RateEffect):
    """An effect on d(``state``)/dt, called ``{state}_{kind}``; ``size`` is what is usual of the state, in its unit."""

    stage = Stage.RESISTANCE

    def __init__(self, robot: str, state: str, kind: str, equation: str, parameter: Parameter, size: float) -> None:
        self.robot: str = robot  # type: ignore[misc]
        self.state, self.size = state, size
        self.name: str = f"{state}_{kind}"  # type: ignore[misc]
        self.equation: str = f"d({state})/dt {equation.replace('v', state)}"  # type: ignore[misc]
        self.parameters: tuple[Parameter, ...] = (parameter,)  # type: ignore[misc]

    def _less(self, rates: Named, loss: object) -> Named:
        return {**rates, self.state: rates[self.state] - loss}


@final
class StateDrag(StateEffect):
    """dv/dt -= coefficient v."""

    signature = "a residual against the motion, in proportion to it"
    source = "linear damping; Khalil, Nonlinear Systems, 3rd ed., section 1.2"

    def __init__(self, robot: str, state: str, size: float) -> None:
        super().__init__(
            robot, state, "drag", "-= coefficient v", Parameter("coefficient", "1/s", 0.0, 50.0, 0.3), size
        )

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        return self._less(rates, parameters["coefficient"] * context.state[self.state])


@final
class StateQuadraticDrag(StateEffect):
    """dv/dt -= coefficient |v| v."""

    signature = "a residual against the motion that grows with its square"
    source = "Hoerner, Fluid-Dynamic Drag, 1965, ch. 1"

    def __init__(self, robot: str, state: str, unit: str, size: float) -> None:
        each = "1/m" if unit == "m/s" else f"1/s/({unit})"
        parameter = Parameter("coefficient", each, 0.0, 50.0 / size, 0.3 / size)
        super().__init__(robot, state, "quadratic_drag", "-= coefficient |v| v", parameter, size)

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        value = context.state[self.state]
        return self._less(rates, parameters["coefficient"] * context.operations.absolute(value) * value)


@final
class StateFriction(StateEffect):
    """dv/dt -= deceleration sign(v), the sign rounded off near rest."""

    stage = Stage.WEIGHT
    signature = "a residual of one size against the motion, which changes sign with it"
    source = "Armstrong-Helouvry et al., A survey of models with friction, Automatica 30, 1994, section 2"

    def __init__(self, robot: str, state: str, unit: str, size: float) -> None:
        each = "m/s2" if unit == "m/s" else "rad/s2" if unit == "rad/s" else f"({unit})/s"
        parameter = Parameter("deceleration", each, 0.0, 20.0 * size, 0.3 * size)
        super().__init__(robot, state, "friction", "-= deceleration sign(v)", parameter, size)

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        deceleration = parameters["deceleration"]
        direction = direction_of(context.state[self.state], deceleration, _REST * self.size, context)
        return self._less(rates, deceleration * direction)


@final
class StatePush(StateEffect):
    """dv/dt += push."""

    signature = "a residual of one size and sign, whatever the state and the action"
    source = "a constant disturbance; Astrom and Murray, Feedback Systems, 2nd ed., ch. 7"

    def __init__(self, robot: str, state: str, unit: str, size: float) -> None:
        each = "m/s2" if unit == "m/s" else "rad/s2" if unit == "rad/s" else f"({unit})/s"
        super().__init__(
            robot, state, "push", "+= push", Parameter("push", each, -20.0 * size, 20.0 * size, 0.2 * size), size
        )

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        return {**rates, self.state: rates[self.state] + parameters["push"]}


def general_effects(system: System, moving: Mapping[str, float] | None = None) -> tuple[AbstractEffect, ...]:
    """Gain, offset, dead zone, limit, lag and delay of every action; drag, quadratic drag, friction and push of states.

    ``moving``: the states that forces change (speeds, rates), each with what is usual of it in its unit. Actions
    without finite bounds count as up to 1 of their unit. Raises InputError for a state that the system lacks.
    """
    found: list[AbstractEffect] = []
    for action in system.action:
        found += _of_action(system.name, action)
    for name, size in (moving or {}).items():
        if name not in system.state_names:
            raise InputError(f"moving: got '{name}'; {did_you_mean(name, system.state_names)}")
        if not (isfinite(size) and size > 0.0):
            raise InputError(f"moving: {name}: got {size!r}, wanted what is usual of it, above 0")
        unit = system.state[system.state_names.index(name)].unit
        found += [
            StateDrag(system.name, name, size),
            StateQuadraticDrag(system.name, name, unit, size),
            StateFriction(system.name, name, unit, size),
            StatePush(system.name, name, unit, size),
        ]
    return tuple(found)


def _of_action(robot: str, action: Variable) -> list[AbstractEffect]:
    size = max(abs(action.low), abs(action.high))
    size = size if isfinite(size) else 1.0
    found: list[AbstractEffect] = [
        ChannelGain(robot, action.name),
        ChannelOffset(robot, action.name, action.unit, size),
        ChannelLag(robot, action.name),
        ChannelDelay(robot, action.name),
        ChannelLimit(robot, action.name, action.unit, size),
    ]
    return [*found, ChannelDeadZone(robot, action.name, action.unit, size)] if action.low < 0.0 else found
