"""General effects for a user's own system: on each action, and on the rates of the states that forces change."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import isfinite
from typing import final

from safedpa.effects.channel_effects import ChannelEffect
from safedpa.effects.effect import AbstractEffect, Context, Named, RateEffect, Stage
from safedpa.effects.friction import direction_of
from safedpa.effects.parameter import Parameter
from safedpa.errors import InputError, did_you_mean
from safedpa.operations import Scalar
from safedpa.systems import System, Variable

_REST = 0.02
"""Share of the usual size of a state below which its friction is smoothed."""


_LOSSES: Mapping[str, tuple[str, Callable[[Scalar, Scalar, float, Context], Scalar]]] = {
    "drag": ("-= coefficient v", lambda v, coefficient, _size, _context: coefficient * v),
    "quadratic_drag": (
        "-= coefficient |v| v",
        lambda v, coefficient, _size, context: coefficient * context.operations.absolute(v) * v,
    ),
    "friction": (
        "-= deceleration sign(v)",
        lambda v, deceleration, size, context: deceleration * direction_of(v, deceleration, _REST * size, context),
    ),
    "push": ("+= push", lambda _v, push, _size, _context: -push),
}
"""Equation of dv/dt and (v, parameter, usual size of v, context) -> what is subtracted from it, by kind."""


@final
class StateEffect(RateEffect):
    """An effect on d(``state``)/dt, called ``{state}_{kind}``; ``size`` is the usual size of the state, in its unit."""

    def __init__(self, robot: str, state: str, kind: str, parameter: Parameter, size: float) -> None:
        self.kind, self.state, self.size = kind, state, size  # the kind by its name: functions cannot be pickled
        self.robot: str = robot  # type: ignore[misc]
        self.name: str = f"{state}_{kind}"  # type: ignore[misc]
        self.stage: Stage = Stage.WEIGHT if kind == "friction" else Stage.RESISTANCE  # type: ignore[misc]
        # equations are written over v, the state
        self.equation: str = f"d({state})/dt {_LOSSES[kind][0].replace('v', state)}"  # type: ignore[misc]
        self.parameters: tuple[Parameter, ...] = (parameter,)  # type: ignore[misc]
        self.signature: str = _SIGNATURES[kind]  # type: ignore[misc]
        self.source: str = _SOURCES[kind]  # type: ignore[misc]

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        loss = _LOSSES[self.kind][1](context.state[self.state], parameters[self.parameters[0].name], self.size, context)
        return {**rates, self.state: rates[self.state] - loss}


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
        found += _of_state(system.name, system.state[system.state_names.index(name)], size)
    return tuple(found)


_SIGNATURES = {
    "drag": "a residual against the motion, in proportion to it",
    "quadratic_drag": "a residual against the motion that grows with its square",
    "friction": "a residual of one size against the motion, which changes sign with it",
    "push": "a residual of one size and sign, whatever the state and the action",
    "gain": "the answer to the action differs by the same share at every size",
    "offset": "a residual of one size and sign, whatever the action",
    "lag": "a residual after each change of the action, of opposite sign to the change, dying out",
    "delay": "a residual after each change of the action, as if it had not been sent yet, then none",
    "limit": "a residual beyond one size of the action only, growing with the excess",
    "dead_zone": "a residual against the action that grows with it up to a width, then of one size",
}
_SOURCES = {
    "drag": "linear damping; Khalil, Nonlinear Systems, 3rd ed., section 1.2",
    "quadratic_drag": "Hoerner, Fluid-Dynamic Drag, 1965, ch. 1",
    "friction": "Armstrong-Helouvry et al., A survey of models with friction, Automatica 30, 1994, section 2",
    "push": "a constant disturbance; Astrom and Murray, Feedback Systems, 2nd ed., ch. 7",
    "gain": "static gain of an actuator; Astrom and Murray, Feedback Systems, 2nd ed., ch. 3",
    "offset": "trim of an actuator; Astrom and Murray, Feedback Systems, 2nd ed., ch. 3",
    "lag": "first-order actuator; Astrom and Murray, Feedback Systems, 2nd ed., ch. 3",
    "delay": "dead time; Astrom and Murray, Feedback Systems, 2nd ed., ch. 9",
    "limit": "saturation; Tao and Kokotovic, Adaptive Control of Systems, 1996, ch. 1",
    "dead_zone": "Tao and Kokotovic, Adaptive Control of Systems with Actuator and Sensor Nonlinearities, 1996, ch. 2",
}


def _of_state(robot: str, state: Variable, size: float) -> list[AbstractEffect]:
    per_length = "1/m" if state.unit == "m/s" else f"1/s/({state.unit})"
    rate = f"{state.unit}2" if state.unit in ("m/s", "rad/s") else f"({state.unit})/s"
    parameters = {
        "drag": Parameter("coefficient", "1/s", 0.0, 50.0, 0.3),
        # over the usual size, so that it decelerates as the linear drag with coefficient 0.3 1/s does there
        "quadratic_drag": Parameter("coefficient", per_length, 0.0, 50.0 / size, 0.3 / size),
        "friction": Parameter("deceleration", rate, 0.0, 20.0 * size, 0.3 * size),
        "push": Parameter("push", rate, -20.0 * size, 20.0 * size, 0.2 * size),
    }
    return [StateEffect(robot, state.name, kind, parameter, size) for kind, parameter in parameters.items()]


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
