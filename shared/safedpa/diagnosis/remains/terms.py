"""A small library of terms for formulas: powers, absolute values, signs, sines of state and action, and products."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

from safedpa.compare.where import PLACE
from safedpa.effects.effect import Named
from safedpa.operations import Operations, Scalar
from safedpa.systems import System, Variable

__all__ = ["TIME", "Term", "terms_of"]

TIME = "time"
"""Name of the seconds since the run's start among a term's variables."""

_Function = Callable[[Scalar, float, Operations], Scalar]
"""(value, size near rest, operations) -> value"""

_REST = 0.02
"""Share of a variable's usual size below which its sign is rounded off: noise has no sign."""

_SHAPES: dict[str, tuple[int, _Function]] = {
    "{0}": (1, lambda v, _r, _o: v),
    "|{0}|": (1, lambda v, _r, o: o.absolute(v)),
    "sign({0})": (0, lambda v, r, o: o.tanh(v / r)),
    "{0}^2": (2, lambda v, _r, _o: v * v),
    "{0} |{0}|": (2, lambda v, _r, o: v * o.absolute(v)),
    "{0}^3": (3, lambda v, _r, _o: v * v * v),
    "sin({0})": (0, lambda v, _r, o: o.sin(v)),
    "cos({0})": (0, lambda v, _r, o: o.cos(v)),
}
"""Text and power of the unit."""

_QUANTITY = ("{0}", "|{0}|", "sign({0})", "{0}^2", "{0} |{0}|", "{0}^3")
_ANGLE = ("sin({0})", "cos({0})")
_ACTION = ("{0}", "|{0}|", "sign({0})", "{0}^2", "{0} |{0}|")
_IN_PRODUCTS = ("{0}", "|{0}|", "sign({0})", "{0}^2", "{0} |{0}|", "sin({0})", "cos({0})")
_FEW_IN_PRODUCTS = ("{0}", "|{0}|", "{0}^2")


@dataclass(frozen=True)
class _Factor:
    variable: str
    unit: str
    shape: str
    rest: float

    def value(self, named: Named, operations: Operations) -> Scalar:
        return _SHAPES[self.shape][1](named[self.variable], self.rest, operations)

    @property
    def units(self) -> list[str]:
        """The unit, as often as it counts."""
        return [self.unit] * _SHAPES[self.shape][0] if self.unit not in ("1", "rad") else []


@dataclass(frozen=True)
class Term:
    """A product of at most two factors; none: the constant 1."""

    factors: tuple[_Factor, ...]

    @property
    def text(self) -> str:
        """As in a formula."""
        return " ".join(factor.shape.format(factor.variable) for factor in self.factors) or "1"

    @property
    def variables(self) -> tuple[str, ...]:
        """What it depends on, each once."""
        return tuple(dict.fromkeys(factor.variable for factor in self.factors))

    @property
    def units(self) -> list[str]:
        """Units of its value, one by one."""
        return [unit for factor in self.factors for unit in factor.units]

    def value(self, named: Named, operations: Operations) -> Scalar:
        """Its value for named states, actions and ``time``."""
        result: Scalar = 1.0
        for factor in self.factors:
            result = result * factor.value(named, operations)
        return result


def terms_of(system: System, sizes: dict[str, float]) -> list[Term]:
    """Every term for a system; ``sizes`` are usual absolute values by variable, which say what is near rest."""

    def factors(variable: Variable, shapes: Sequence[str]) -> list[_Factor]:
        rest = max(_REST * sizes.get(variable.name, 1.0), 1e-6)
        return [_Factor(variable.name, variable.unit, shape, rest) for shape in shapes]

    place = [item for item in system.state if item.name in PLACE]
    angles = [item for item in system.state if item.angle]
    states = [item for item in system.state if not item.angle and item.name not in PLACE]
    singles = [factor for item in states for factor in factors(item, _QUANTITY)]
    singles += [factor for item in angles for factor in factors(item, _ANGLE)]
    singles += [factor for item in system.action for factor in factors(item, _ACTION)]
    singles += [factor for item in place for factor in factors(item, ("{0}",))]
    singles += [_Factor(TIME, "s", "{0}", 1.0)]
    found = [Term(()), *(Term((factor,)) for factor in singles)]
    first = [factor for item in [*states, *angles] for factor in singles if factor.variable == item.name]
    second = [factor for item in system.action for factor in singles if factor.variable == item.name]
    found += _products(first, second)
    found += _products([f for f in first if f.shape in _FEW_IN_PRODUCTS], [f for f in first if f.shape in _ANGLE])
    for index, one in enumerate(system.action):
        for other in system.action[index + 1 :]:
            found += _products(factors(one, _FEW_IN_PRODUCTS), factors(other, _FEW_IN_PRODUCTS))
    return found


def _products(ones: Sequence[_Factor], others: Sequence[_Factor]) -> list[Term]:
    return [
        Term((one, other))
        for one, other in product(ones, others)
        if one.variable != other.variable and one.shape in _IN_PRODUCTS and other.shape in (*_FEW_IN_PRODUCTS, *_ANGLE)
    ]
