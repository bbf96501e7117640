"""Effects on the rates of any state: resistances, limits, springs, stops, and forces on vectors of states.

``KINDS`` has the equations; ``general_effects`` declares them for a system.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, final

from safedpa.effects.effect import AbstractEffect, Context, FeltEffect, Named, RateEffect, SensorEffect, Stage
from safedpa.effects.friction import direction_of
from safedpa.effects.parameter import Parameter
from safedpa.operations import Scalar

_REST: Final = 0.02
"""Share of the usual size of a state below which its friction is smoothed."""
_STOPPING: Final = 0.63
"""Periods in which a speed approaches its limit: then a step of Runge-Kutta leaves least of the way, 27 %."""
_TINY: Final = 1e-12
"""Added to squares under a root, relative to 1: the slope of a length does not exist at 0."""


@final
@dataclass(frozen=True)
class Felt:
    """What a kind of effect on d(v)/dt reads."""

    rate: Scalar
    """d(v)/dt without the effect."""
    v: Scalar
    p: tuple[Scalar, ...]
    """Its parameters."""
    declared: tuple[Parameter, ...]
    size: float
    """Usual size of v."""
    others: tuple[Scalar, ...]
    """The position of v, or the state that it is coupled to."""
    context: Context

    def friction(self, deceleration: Scalar) -> Scalar:
        """Returns deceleration sign(v), smoothed near rest."""
        return deceleration * direction_of(self.v, deceleration, _REST * self.size, self.context)

    def within(self, value: Scalar, low: Scalar, high: Scalar, limits: tuple[Scalar, Scalar]) -> Scalar:
        """Returns value clipped to (low, high), each side only if its limit is not the neutral one."""
        operations = self.context.operations
        free = [one.neutral for one in self.declared] * 2
        above = operations.where(limits[1] >= free[1], value, operations.minimum(value, high))
        return operations.where(limits[0] >= free[0], above, operations.maximum(above, low))


def _limited_speed(f: Felt) -> Scalar:
    """Returns the rate with which v meets its limits within a fraction of a period."""
    up, down, within = f.p[0], f.p[-1], _STOPPING * f.context.period
    return f.within(f.rate, (-down - f.v) / within, (up - f.v) / within, (down, up))


def _stopped(f: Felt) -> Scalar:
    """Returns the rate with which v leads the position to its stop, critically damped, and not beyond."""
    low, high, position, h = f.p[0], f.p[1], f.others[0], f.context.period
    operations = f.context.operations
    towards = [((stop - position) / (4.0 * h) - f.v) / h for stop in (low, high)]
    free_low, free_high = (one.neutral for one in f.declared)
    below = operations.where(high >= free_high, f.rate, operations.minimum(f.rate, towards[1]))
    return operations.where(low <= free_low, below, operations.maximum(below, towards[0]))


def _weighed(f: Felt) -> Scalar:
    angle, operations = f.others[0], f.context.operations
    return f.rate - f.p[0] * operations.sin(angle) - f.p[1] * operations.cos(angle)


def _stribeck(f: Felt) -> Scalar:
    ratio = f.v / f.p[1]
    return f.rate - f.friction(f.p[0]) * f.context.operations.exp(-ratio * ratio)


@final
@dataclass(frozen=True)
class StateKind:
    """What one kind of effect makes of d(v)/dt, with its parameters p."""

    stage: Stage
    equation: str
    """Over {v}, the other state {o}, and the names of the parameters {p}, {q}."""
    rate: Callable[[Felt], Scalar]


KINDS: Mapping[str, StateKind] = {
    "drag": StateKind(Stage.RESISTANCE, "d({v})/dt -= {p} {v}", lambda f: f.rate - f.p[0] * f.v),
    "quadratic_drag": StateKind(
        Stage.RESISTANCE,
        "d({v})/dt -= {p} |{v}| {v}",
        lambda f: f.rate - f.p[0] * f.context.operations.absolute(f.v) * f.v,
    ),
    "push": StateKind(Stage.RESISTANCE, "d({v})/dt += {p}", lambda f: f.rate + f.p[0]),
    "spring": StateKind(Stage.RESISTANCE, "d({v})/dt -= {p} {o}", lambda f: f.rate - f.p[0] * f.others[0]),
    "gravity": StateKind(Stage.RESISTANCE, "d({v})/dt -= {p} sin({o}) + {q} cos({o})", _weighed),
    "coupling": StateKind(Stage.RESISTANCE, "d({v})/dt += {p} {o}", lambda f: f.rate + f.p[0] * f.others[0]),
    "acceleration_limit": StateKind(
        Stage.DRIVE, "|d({v})/dt| <= {p}", lambda f: f.within(f.rate, -f.p[0], f.p[0], (f.p[0], f.p[0]))
    ),
    "acceleration_limit_up_down": StateKind(
        Stage.DRIVE, "-{q} <= d({v})/dt <= {p}", lambda f: f.within(f.rate, -f.p[1], f.p[0], (f.p[1], f.p[0]))
    ),
    "friction": StateKind(Stage.WEIGHT, "d({v})/dt -= {p} sign({v})", lambda f: f.rate - f.friction(f.p[0])),
    "stribeck": StateKind(Stage.WEIGHT, "d({v})/dt -= {p} exp(-({v}/{q})^2) sign({v})", _stribeck),
    "load_friction": StateKind(
        Stage.OWN_MASS,
        "d({v})/dt -= {p} |d({v})/dt| sign({v})",
        lambda f: f.rate - f.friction(f.p[0] * f.context.operations.absolute(f.rate)),
    ),
    "inertia": StateKind(Stage.MASS, "(1 + {p}) d({v})/dt = that without it", lambda f: f.rate / (1.0 + f.p[0])),
    "speed_limit": StateKind(Stage.MOTION, "|{v}| <= {p}", _limited_speed),
    "speed_limit_up_down": StateKind(Stage.MOTION, "-{q} <= {v} <= {p}", _limited_speed),
    "end_stop": StateKind(Stage.SLIP, "{p} <= {o} <= {q}: {v} ends at a stop", _stopped),
}


class _Declared(AbstractEffect):
    """An effect that is declared by a table, with attributes of the instance in place of the class's."""

    def __init__(
        self, robot: str, name: str, family: str, stage: Stage, equation: str, parameters: tuple[Parameter, ...]
    ) -> None:
        self.robot: str = robot  # type: ignore[misc]
        self.name: str = name  # type: ignore[misc]
        self.family: str = family  # type: ignore[misc]
        self.stage: Stage = stage  # type: ignore[misc]
        self.equation: str = equation  # type: ignore[misc]
        self.parameters: tuple[Parameter, ...] = parameters  # type: ignore[misc]

    def described(
        self,
        signature: str,
        source: str,
        partners: tuple[str, ...] = (),
        *,
        rare: bool = False,
        by_period: Callable[[float], tuple[Parameter, ...]] | None = None,
    ) -> None:
        """Sets what reports and searches read."""
        self.signature: str = signature  # type: ignore[misc]
        self.source: str = source  # type: ignore[misc]
        self.partners, self.rare, self.by_period = partners, rare, by_period  # type: ignore[misc]


@final
class StateEffect(_Declared, RateEffect):
    """An effect of one of the ``KINDS`` on d(``state``)/dt, called ``{state}_{kind}``.

    ``size`` is the usual size of the state in its unit; ``other`` the state that the kind reads next to it.
    """

    def __init__(
        self, robot: str, state: str, kind: str, parameters: tuple[Parameter, ...], size: float, other: str = ""
    ) -> None:
        own = KINDS[kind]
        # the kind by its name: functions cannot be pickled
        self.kind, self.state, self.size, self.others = kind, state, size, (other,) if other else ()
        names = dict(zip("pq", (parameter.name for parameter in parameters), strict=False))
        equation = own.equation.format(v=state, o=other, **names)
        name = f"{state}_by_{other}" if kind == "coupling" else f"{state}_{kind}"
        super().__init__(robot, name, kind, own.stage, equation, parameters)

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        values = tuple(parameters[declared.name] for declared in self.parameters)
        others = tuple(context.state[name] for name in self.others)
        rate, v = rates[self.state], context.state[self.state]
        felt = Felt(rate, v, values, self.parameters, self.size, others, context)
        return {**rates, self.state: KINDS[self.kind].rate(felt)}


@final
class VectorDrag(_Declared, RateEffect):
    """Drag on a vector of speeds with shared coefficients: one effect, not one for each axis.

    ``quadratic``: d(v)/dt -= coefficient |v| v with the length |v| of the vector; else d(v)/dt -= coefficient v. With a
    ``heading``, the first two axes are turned into the body's frame, where drag along and across differ.
    """

    def __init__(
        self,
        robot: str,
        name: str,
        axes: tuple[str, ...],
        parameters: tuple[Parameter, ...],
        *,
        quadratic: bool = False,
        heading: str = "",
    ) -> None:
        self.axes, self.quadratic, self.heading = axes, quadratic, heading
        family = "body_drag" if heading else "vector_quadratic_drag" if quadratic else "vector_drag"
        vector = f"({', '.join(axes)})"
        names = [parameter.name for parameter in parameters]
        terms = {
            "body_drag": f"R({heading}) diag({', '.join(names)}) R({heading})' {vector}",
            "vector_quadratic_drag": f"{names[0]} |{vector}| {vector}",
            "vector_drag": f"{names[0]} {vector}",
        }
        own, equation = f"{name}_{family.removeprefix('vector_')}", f"d{vector}/dt -= {terms[family]}"
        super().__init__(robot, own, family, Stage.RESISTANCE, equation, parameters)

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        speeds, operations = [context.state[name] for name in self.axes], context.operations
        own = [parameters[declared.name] for declared in self.parameters]
        if self.heading:
            c, s = operations.cos(context.state[self.heading]), operations.sin(context.state[self.heading])
            along, across = own[0] * (c * speeds[0] + s * speeds[1]), own[1] * (c * speeds[1] - s * speeds[0])
            losses = [c * along - s * across, s * along + c * across]
        else:
            share = own[0]
            if self.quadratic:
                total = _TINY
                for speed in speeds:
                    total = total + speed * speed
                share = share * operations.sqrt(total)
            losses = [share * speed for speed in speeds]
        return {**rates, **{name: rates[name] - loss for name, loss in zip(self.axes, losses, strict=True)}}


@final
class TorqueSpeed(_Declared, FeltEffect):
    """A drive whose force falls with the speed: felt = u - slope |u| v, so that 1 / slope is the no-load speed."""

    def __init__(self, robot: str, action: str, state: str, parameters: tuple[Parameter, ...]) -> None:
        self.action, self.state = action, state
        equation = f"{action}_felt = {action} - {parameters[0].name} |{action}| {state}"
        super().__init__(robot, f"{action}_torque_speed", "torque_speed", Stage.DRIVE, equation, parameters)
        self.needs = (action,)  # type: ignore[misc]

    def feel(self, parameters: Named, context: Context) -> Named:  # noqa: D102
        u, slope = context.action[self.action], parameters[self.parameters[0].name]
        lost = slope * context.operations.absolute(u) * context.state[self.state]
        return {**context.action, self.action: u - lost}


@final
class Mixed(_Declared, FeltEffect):
    """A command that depends on another input: a share of another axis' command, or the measured supply voltage.

    ``nominal`` None: felt = u + share o; else felt = u (1 + share (o / nominal - 1)).
    """

    def __init__(
        self, robot: str, action: str, other: str, parameters: tuple[Parameter, ...], nominal: float | None = None
    ) -> None:
        self.action, self.other, self.nominal = action, other, nominal
        share = parameters[0].name
        name, family = (f"{action}_by_{other}", "coupling") if nominal is None else (f"{action}_supply", "supply")
        term = f"+ {share} {other}" if nominal is None else f"(1 + {share} ({other} / {nominal:g} - 1))"
        stage = Stage.COMMAND_LINKAGE if nominal is None else Stage.SUPPLY
        super().__init__(robot, name, family, stage, f"{action}_felt = {action} {term}", parameters)
        self.needs = (action, other)  # type: ignore[misc]

    def feel(self, parameters: Named, context: Context) -> Named:  # noqa: D102
        u, other, share = context.action[self.action], context.action[self.other], parameters[self.parameters[0].name]
        felt = u + share * other if self.nominal is None else u * (1.0 + share * (other / self.nominal - 1.0))
        return {**context.action, self.action: felt}


@final
class StateSensor(_Declared, SensorEffect):
    """A sensor that is off: ``bias`` measured = v + p, ``scale`` measured = p v, ``sensor_delay`` measured = v - p o.

    Of a state o = d(v)/dt that is measured too, the last is v one time p ago, to first order: a delay or a lag.
    """

    def __init__(self, robot: str, state: str, kind: str, parameters: tuple[Parameter, ...], rate: str = "") -> None:
        self.state, self.kind, self.rate = state, kind, rate
        p = parameters[0].name
        terms = {"bias": f"{state} + {p}", "scale": f"{p} {state}", "sensor_delay": f"{state} - {p} {rate}"}
        stage = {"bias": Stage.SENSOR, "scale": Stage.SENSOR_SCALE, "sensor_delay": Stage.SENSOR_DELAY}[kind]
        super().__init__(robot, f"{state}_{kind}", kind, stage, f"measured {state} = {terms[kind]}", parameters)

    def measure(self, state: Named, parameters: Named) -> Named:  # noqa: D102
        own = parameters[self.parameters[0].name]
        if self.kind == "scale":
            return {**state, self.state: own * state[self.state]}
        return {**state, self.state: state[self.state] + (own if self.kind == "bias" else -own * state[self.rate])}

    def restore(self, state: Named, parameters: Named) -> Named:  # noqa: D102
        own = parameters[self.parameters[0].name]
        if self.kind == "scale":
            return {**state, self.state: state[self.state] / own}
        return {**state, self.state: state[self.state] - (own if self.kind == "bias" else -own * state[self.rate])}
