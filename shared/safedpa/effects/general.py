"""General effects for a user's own system: on each action, and on the rates of the states that forces change."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import final

from safedpa.effects.channel_effects import ChannelEffect
from safedpa.effects.effect import AbstractEffect, Context, Named, RateEffect, Stage
from safedpa.effects.friction import direction_of
from safedpa.effects.parameter import Parameter
from safedpa.errors import InputError, did_you_mean
from safedpa.systems import System, Variable

_REST = 0.02
"""Share of the usual size of a state below which its friction is smoothed."""


class StateEffect(RateEffect):
    """An effect on d(``state``)/dt, called ``{state}_{kind}``; ``size`` is the usual size of the state, in its unit."""

    stage = Stage.RESISTANCE

    def __init__(self, robot: str, state: str, kind: str, equation: str, parameter: Parameter, size: float) -> None:
        self.robot: str = robot  # type: ignore[misc]
        self.state, self.size = state, size
        self.name: str = f"{state}_{kind}"  # type: ignore[misc]
        # equations are written over v, the state
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
        # over the usual size, so that it decelerates as the linear drag with coefficient 0.3 1/s does there
        parameter = Parameter("coefficient", each, 0.0, 50.0 / size, 0.3 / size)
        super().__init__(robot, state, "quadratic_drag", "-= coefficient |v| v", parameter, size)

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        value = context.state[self.state]
        return self._less(rates, parameters["coefficient"] * context.operations.absolute(value) * value)


@final
class StateFriction(StateEffect):
    """dv/dt -= deceleration sign(v), smoothed near rest."""

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
    """Returns gain, offset, dead zone, limit, lag and delay of each action; drags, friction and push of states.

    ``moving``: the states that forces change (speeds, rates), each with its usual size in its unit. Actions without
    finite bounds are taken to reach 1 of their unit. Raises InputError for a state that the system lacks.
    """
    found: list[AbstractEffect] = []
    for action in system.action:
        found += _of_action(system.name, action)
    for name, size in (moving or {}).items():
        if name not in system.state_names:
            raise InputError(f"moving: got '{name}'; {did_you_mean(name, system.state_names)}")
        if not (isfinite(size) and size > 0.0):
            raise InputError(f"moving: {name}: got {size!r}, wanted its usual size, above 0")
        unit = system.state[system.state_names.index(name)].unit
        found += [
            StateDrag(system.name, name, size),
            StateQuadraticDrag(system.name, name, unit, size),
            StateFriction(system.name, name, unit, size),
            StatePush(system.name, name, unit, size),
        ]
    return tuple(found)


_SIGNATURES = {
    "gain": "the answer to the action differs by the same share at every size",
    "offset": "a residual of one size and sign, whatever the action",
    "lag": "a residual after each change of the action, of opposite sign to the change, dying out",
    "delay": "a residual after each change of the action, as if it had not been sent yet, then none",
    "limit": "a residual beyond one size of the action only, growing with the excess",
    "dead_zone": "a residual against the action that grows with it up to a width, then of one size",
}
_SOURCES = {
    "gain": "static gain of an actuator; Astrom and Murray, Feedback Systems, 2nd ed., ch. 3",
    "offset": "trim of an actuator; Astrom and Murray, Feedback Systems, 2nd ed., ch. 3",
    "lag": "first-order actuator; Astrom and Murray, Feedback Systems, 2nd ed., ch. 3",
    "delay": "dead time; Astrom and Murray, Feedback Systems, 2nd ed., ch. 9",
    "limit": "saturation; Tao and Kokotovic, Adaptive Control of Systems, 1996, ch. 1",
    "dead_zone": "Tao and Kokotovic, Adaptive Control of Systems with Actuator and Sensor Nonlinearities, 1996, ch. 2",
}


def _of_action(robot: str, action: Variable) -> list[AbstractEffect]:
    size = max(abs(action.low), abs(action.high))
    size = size if isfinite(size) else 1.0  # the scale of offsets, limits and dead zones
    parameters = {
        "gain": Parameter("gain", "1", 0.05, 5.0, 0.85, neutral=1.0),
        "offset": Parameter("offset", action.unit, -size, size, 0.05 * size),
        "lag": Parameter("time_constant", "s", 0.0, 2.0, 0.15),
        "delay": Parameter("seconds", "s", 0.0, 1.0, 0.1),
        "limit": Parameter("limit", action.unit, 0.02 * size, size, 0.6 * size, neutral=size),
    }
    if action.low < 0.0:  # an action that cannot be negative starts at its own dead zone: an offset says the same
        parameters["dead_zone"] = Parameter("width", action.unit, 0.0, 0.9 * size, 0.1 * size)
    return [
        ChannelEffect(
            robot,
            f"{action.name}_{kind}",
            action.name,
            kind,
            parameter,
            signature=_SIGNATURES[kind],
            source=_SOURCES[kind],
            needs=(action.name,),
        )
        for kind, parameter in parameters.items()
    ]
