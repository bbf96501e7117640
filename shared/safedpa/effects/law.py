"""Laws: how the parameters of an effect depend on position, time or speed.

There are two: an effect that acts in a region only, and a parameter that varies with a variable. In both, a parameter p
at an instant is a function of the effect's parameters and of one variable v:

    where  p = neutral + w (p_inside - neutral),  w = 1/2 + 1/2 tanh(depth / edge)
    varies p = clip(p_0 + rate v, low, high)

w rises from 0 to 1 over the width ``edge`` at the border of the region, so that the model has slopes there, for fits
and for the safety filter. v is the time since the start of the run, a state, an action, or the absolute value of one
(``abs_speed``).

An effect with a law keeps its name. An effect on rates is wrapped as it is. An effect on commands without memory (gain,
offset, dead zone, limit) acts on the felt command, after every delay and lag, where state and time are known. Effects
with memory and sensor effects cannot have a law: their memory, or the inverse of the measurement, would not be defined.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Self, final

from safedpa.effects.effect import (
    AbstractEffect,
    CommandEffect,
    Context,
    FeltEffect,
    Named,
    RateEffect,
    Stage,
)
from safedpa.effects.parameter import Parameter
from safedpa.errors import ModelFileError, did_you_mean
from safedpa.operations import Scalar
from safedpa.systems import System

TIME: Final = "time"
ABS: Final = "abs_"
"""Prefix of a state's or an action's name: its absolute value."""
PLACES: Final = ("circle", "strip")
"""Regions in the plane x, y."""
SHAPES: Final = ("above", "below", "between")
"""Regions of one variable."""
_LONGEST: Final = 1e7
"""s; the longest run."""


@final
@dataclass(frozen=True)
class Where:
    """The effect acts in a region only; ``edge`` is the width over which it sets in, in the variable's unit."""

    shape: str
    variable: str
    edge: float
    key: ClassVar[str] = "where"
    """The key in model files."""

    @property
    def phrase(self) -> str:
        """The law in model files and on the command line: ``x above``, ``gain with time``."""
        return self.shape if self.shape in PLACES else f"{self.variable} {self.shape}"

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of the variables that it depends on."""
        return ("x", "y") if self.shape in PLACES else (self.variable,)

    def check(self, item: AbstractEffect, system: System) -> None:
        """Raises ModelFileError if the law does not fit the effect, or the system lacks the variable."""
        known = variables_of_law(system)
        for name in self.variables:
            if name not in known:
                raise ModelFileError(f"{item.name}.where: got '{name}'; {did_you_mean(name, known)}")
        if not (math.isfinite(self.edge) and self.edge > 0.0):
            raise ModelFileError(
                f"{item.name}.edge: got {self.edge:g}, wanted a width above 0 {known[self.variables[0]].unit} over "
                "which it sets in"
            )
        if all(parameter.neutral is None for parameter in item.parameters):
            raise ModelFileError(f"effect '{item.name}' has no number at which it does nothing; leave 'where' out")

    def parameters(self, item: AbstractEffect, system: System) -> tuple[Parameter, ...]:
        """Returns the law's own parameters."""
        if self.shape == "circle":
            return (
                Parameter("at_x", "m", -1e4, 1e4, 1.0),
                Parameter("at_y", "m", -1e4, 1e4, 1.0),
                Parameter("radius", "m", 0.05, 1e3, 1.0, neutral=None),
            )
        if self.shape == "strip":
            return (
                Parameter("angle", "rad", -10.0, 10.0, 0.3),
                Parameter("offset", "m", -1e4, 1e4, 1.0),
                Parameter("half_width", "m", 0.05, 1e3, 0.5, neutral=None),
            )
        ends = ("from", "to") if self.shape == "between" else (self.shape,)
        known = variables_of_law(system)[self.variable]
        return tuple(_threshold(f"{self.variable}_{end}", known) for end in ends)

    def numbers(self, item: AbstractEffect, own: Named, context: Context) -> Named:
        """Returns the effect's parameters at an instant, by name."""
        inside, found = self.inside(own, context), dict(own)
        for parameter in item.parameters:
            at = parameter.neutral
            if at is not None:
                found[parameter.name] = at + inside * (own[parameter.name] - at)
        return found

    def inside(self, own: Named, context: Context) -> Scalar:
        """Returns w: 1 in the region, 0 outside, 1/2 on its border."""
        return 0.5 + 0.5 * context.operations.tanh(self._depth(own, context) / self.edge)

    def _depth(self, own: Named, context: Context) -> Scalar:
        """Returns the signed distance to the border of the region, positive inside."""
        operations = context.operations
        if self.shape == "circle":
            dx, dy = context.state["x"] - own["at_x"], context.state["y"] - own["at_y"]
            # + 1e-12: the slope of a distance does not exist at 0
            return own["radius"] - (dx * dx + dy * dy + 1e-12) ** 0.5
        if self.shape == "strip":
            angle, state = own["angle"], context.state
            across = state["x"] * operations.cos(angle) + state["y"] * operations.sin(angle) - own["offset"]
            return own["half_width"] - (across * across + 1e-12) ** 0.5
        value = _value(self.variable, context)
        if self.shape == "above":
            return value - own[f"{self.variable}_above"]
        if self.shape == "below":
            return own[f"{self.variable}_below"] - value
        # the nearer end counts
        return operations.minimum(value - own[f"{self.variable}_from"], own[f"{self.variable}_to"] - value)

    def sentence(self, values: Mapping[str, float], item: AbstractEffect, system: System) -> str:
        """Returns when and where the effect acts, as text for reports."""
        if self.shape == "circle":
            x, y, radius = (values[name] for name in ("at_x", "at_y", "radius"))
            return f"inside the circle of {radius:.2f} m about x = {x:.2f}, y = {y:.2f} m"
        if self.shape == "strip":
            angle, offset, half = (values[name] for name in ("angle", "offset", "half_width"))
            # the strip |n . (x, y) - offset| < half width, with its unit normal n = (cos angle, sin angle)
            text = f"where |{math.cos(angle):.2f} x + {math.sin(angle):.2f} y - {offset:.2f}| < {half:.2f} m"
            return text.replace("+ -", "- ").replace("- -", "+ ")
        unit, name = _unit(system, self.variable), _shown(self.variable)
        if self.shape == "between":
            low, high = (values[f"{self.variable}_{end}"] for end in ("from", "to"))
            return f"where {name} is between {low:.3g} and {high:.3g}{unit}"
        at = values[f"{self.variable}_{self.shape}"]
        if self.variable == TIME:
            return f"from {at:.3g} s on" if self.shape == "above" else f"until {at:.3g} s"
        if self.variable in ("x", "y") and self.shape == "above":
            return f"beyond {name} = {at:.2f}{unit}"
        return f"where {name} is {self.shape} {at:.3g}{unit}"


@final
@dataclass(frozen=True)
class Varies:
    """One parameter of the effect changes linearly with a variable; its setting is the value at 0.

    Its members are those of ``Where``.
    """

    parameter: str
    variable: str
    key: ClassVar[str] = "varies"

    @property
    def phrase(self) -> str:  # noqa: D102
        return f"{self.parameter} with {self.variable}"

    @property
    def variables(self) -> tuple[str, ...]:  # noqa: D102
        return (self.variable,)

    @property
    def rate(self) -> str:
        """Name of the parameter for the change per unit of the variable."""
        return f"{self.parameter}_per_{self.variable}"

    def check(self, item: AbstractEffect, system: System) -> None:  # noqa: D102
        names, known = [parameter.name for parameter in item.parameters], variables_of_law(system)
        if self.parameter not in names:
            raise ModelFileError(f"{item.name}.varies: got '{self.parameter}'; {did_you_mean(self.parameter, names)}")
        if self.variable not in known:
            raise ModelFileError(f"{item.name}.varies: got '{self.variable}'; {did_you_mean(self.variable, known)}")

    def parameters(self, item: AbstractEffect, system: System) -> tuple[Parameter, ...]:  # noqa: D102
        own, known = self._varied(item), variables_of_law(system)[self.variable]
        # typical: over a quarter of the variable's range (40 s of time, at most 8 units) p changes by its typical size
        reach = 0.25 * (40.0 if self.variable == TIME else min(known.high - max(known.low, 0.0), 8.0))
        size = abs(own.typical - (own.neutral or 0.0)) or 0.05 * (own.high - own.low)
        most = 1e3 * (own.high - own.low) / max(reach, 1e-9)
        return (Parameter(self.rate, _over(own.unit, known.unit), -most, most, size / max(reach, 1e-9)),)

    def numbers(self, item: AbstractEffect, own: Named, context: Context) -> Named:  # noqa: D102
        bounds = self._varied(item)
        now = own[self.parameter] + own[self.rate] * _value(self.variable, context)
        return {**own, self.parameter: context.operations.clip(now, bounds.low, bounds.high)}

    def sentence(self, values: Mapping[str, float], item: AbstractEffect, system: System) -> str:  # noqa: D102
        own, rate, at = self._varied(item), values[self.rate], values[self.parameter]
        known = variables_of_law(system)[self.variable]
        verb = "falls" if rate * at < 0.0 else "grows"
        each = "a second" if self.variable == TIME else f"with each {_one(known.unit)} of {_shown(self.variable)}"
        if own.unit == "1" and at:
            return f"{verb} by {100.0 * abs(rate / at):.2g} % {each}"
        return f"{verb} by {abs(rate):.2g}{'' if own.unit == '1' else ' ' + own.unit} {each}"

    def begin(self, system: System) -> str:
        """Returns where the parameter has the value of its setting: ``the start``, ``|speed| 0 m/s``."""
        return "the start" if self.variable == TIME else f"{_shown(self.variable)} 0{_unit(system, self.variable)}"

    def _varied(self, item: AbstractEffect) -> Parameter:
        return next(parameter for parameter in item.parameters if parameter.name == self.parameter)


Law = Where | Varies


class Conditioned(AbstractEffect):
    """Base of both kinds; two are equal if their effects, laws and systems are."""

    inner: AbstractEffect
    law: Law

    def __init__(self, inner: AbstractEffect, law: Law, system: System) -> None:
        law.check(inner, system)
        # class attributes of an effect, here of the instance: what reads effects need not know of laws
        self.inner, self.law, self.known = inner, law, system
        self.name: str = inner.name  # type: ignore[misc]
        self.robot: str = inner.robot  # type: ignore[misc]
        self.stage: Stage = inner.stage  # type: ignore[misc]
        self.equation: str = f"{inner.equation}; {law.key} {law.phrase}"  # type: ignore[misc]
        self.parameters = (*inner.parameters, *law.parameters(inner, system))  # type: ignore[misc]
        self.signature: str = inner.signature  # type: ignore[misc]
        self.source: str = inner.source  # type: ignore[misc]
        self.timed: bool = inner.timed or TIME in law.variables  # type: ignore[misc]
        self.needs = inner.needs  # type: ignore[misc]
        self.family, self.partners, self.rare = inner.family, inner.partners, inner.rare  # type: ignore[misc]
        self.mirrored = inner.mirrored  # type: ignore[misc]

    def at_period(self, period: float) -> Self:  # noqa: D102
        inner = self.inner.at_period(period)
        return self if inner is self.inner else type(self)(inner, self.law, self.known)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Conditioned) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def _key(self) -> tuple[Any, ...]:
        return type(self), type(self.inner), self.inner.name, self.law, self.known


@final
class ConditionedRate(Conditioned, RateEffect):
    """A law on an effect on rates."""

    inner: RateEffect

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        return self.inner.modify(rates, self.law.numbers(self.inner, parameters, context), context)


@final
class ConditionedCommand(Conditioned, FeltEffect):
    """A law on an effect on commands without memory."""

    inner: CommandEffect

    def feel(self, parameters: Named, context: Context) -> Named:  # noqa: D102
        own = self.law.numbers(self.inner, parameters, context)
        # None: may_have_law() admits no command effect with memory
        return self.inner.transform(context.action, None, own, context.period, context.operations)[0]


def may_have_law(item: AbstractEffect, system: System) -> bool:
    """Returns whether an effect acts on rates, or on commands without memory."""
    if isinstance(item, CommandEffect):
        return item.initial_memory(dict.fromkeys(system.action_names, 0.0)) is None
    return isinstance(item, RateEffect) and not isinstance(item, Conditioned)


def conditioned(item: AbstractEffect, law: Law, system: System) -> ConditionedRate | ConditionedCommand:
    """Returns the effect with a law. Raises ModelFileError if effect, law and system do not fit."""
    if not may_have_law(item, system):
        raise ModelFileError(
            f"effect '{item.name}': got '{law.key}', but what remembers commands or changes the sensor cannot depend "
            "on where and when; leave it out"
        )
    if isinstance(item, CommandEffect):
        return ConditionedCommand(item, law, system)
    assert isinstance(item, RateEffect)
    return ConditionedRate(item, law, system)


def plain(item: AbstractEffect) -> AbstractEffect:
    """Returns the effect without its law."""
    return item.inner if isinstance(item, Conditioned) else item


def law_behind(item: AbstractEffect) -> Law | None:
    """Returns the law of an effect, or None."""
    return item.law if isinstance(item, Conditioned) else None


def law_of(key: str, phrase: str, edge: float | None, owner: str) -> Law:
    """Returns the law that a model file or the command line names. Raises ModelFileError with what is wanted."""
    parts = phrase.split() if isinstance(phrase, str) else []
    if key == Varies.key:
        if len(parts) == 3 and parts[1] == "with":
            return Varies(parts[0], parts[2])
        raise ModelFileError(f"{owner}.varies: got {phrase!r}, wanted 'PARAMETER with VARIABLE', say 'gain with time'")
    shape = parts[-1] if parts else ""
    if (len(parts) == 1 and shape in PLACES) or (len(parts) == 2 and shape in SHAPES):
        if edge is None:
            raise ModelFileError(f"{owner}.edge: missing; give the width over which it sets in, in the variable's unit")
        return Where(shape, "" if shape in PLACES else parts[0], edge)
    wanted = f"'VARIABLE {'|'.join(SHAPES)}', say 'x above', or one of {', '.join(PLACES)}"
    raise ModelFileError(f"{owner}.where: got {phrase!r}, wanted {wanted}")


@dataclass(frozen=True)
class _Range:
    unit: str
    low: float
    high: float


def variables_of_law(system: System) -> dict[str, _Range]:
    """Returns the variables of laws by name: time, states except angles, actions, and the absolute values of both."""
    found = {TIME: _Range("s", 0.0, _LONGEST)}
    for item in (*system.state, *system.action):
        if not item.angle:  # a wrapped angle jumps, so no threshold or slope over it means anything
            found[item.name] = _Range(item.unit, item.low, item.high)
            if item.low < 0.0 and item.name not in ("x", "y"):
                found[ABS + item.name] = _Range(item.unit, 0.0, max(abs(item.low), abs(item.high)))
    return found


def _value(variable: str, context: Context) -> Scalar:
    if variable == TIME:
        return context.time
    for named in (context.state, context.action):
        if variable in named:
            return named[variable]
        if variable.startswith(ABS) and variable[len(ABS) :] in named:
            return context.operations.absolute(named[variable[len(ABS) :]])
    raise KeyError(variable)  # refused when the model was made


def _threshold(name: str, known: _Range) -> Parameter:
    typical = 10.0 if known.unit == "s" else min(1.0, 0.25 * min(known.high - known.low, 1e6))
    return Parameter(name, known.unit, known.low, known.high, min(max(typical, known.low), known.high), neutral=None)


def _unit(system: System, variable: str) -> str:
    unit = variables_of_law(system)[variable].unit
    return "" if unit == "1" else f" {unit}"


def _over(unit: str, other: str) -> str:
    """Returns the unit of a quotient, such as ``m/s2/(m/s)``."""
    if other == "1":
        return unit
    below = f"({other})" if "/" in other else other
    return f"{unit}/{below}"


def _one(unit: str) -> str:
    return "unit" if unit == "1" else unit


def _shown(variable: str) -> str:
    return f"|{variable[len(ABS) :]}|" if variable.startswith(ABS) else variable
