"""What each operation hands on of a slope: the one table from which slopes of recorded equations are written.

With own = form(a, b, ...) the slope of a result r reaches the operand a as d(r)/d(own) d(own)/d(a). Going from the
result to the operands, this is how often d(r)/d(own) has to be passed on; going from the operands to the result, what
d(a)/d(x) adds to d(own)/d(x): the same product.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import final

__all__ = ["ARRAYS", "PLAIN", "Style", "handed_on", "negative", "product", "sum_of"]


class Style(ABC):
    """How a choice between two numbers is written."""

    @abstractmethod
    def choice(self, condition: str, yes: str, no: str) -> str:
        """``yes`` where the condition holds, else ``no``."""


@final
class _Plain(Style):
    def choice(self, condition: str, yes: str, no: str) -> str:
        return f"({yes} if {condition} else {no})"


@final
class _Arrays(Style):
    def choice(self, condition: str, yes: str, no: str) -> str:
        return f"where({condition}, {yes}, {no})"


PLAIN: Style = _Plain()
ARRAYS: Style = _Arrays()

Rule = Callable[[str, str, Sequence[str], Style], Sequence[str]]
"""(slope, own, operands, style) -> what each operand gets; "0.0" for none."""

_NONE = "0.0"
_SILENT = (*(f"{{0}} {sign} {{1}}" for sign in ("<", "<=", ">", ">=", "==", "!=")), "sign")
"""Forms whose result is level wherever it has a slope."""


def product(first: str, second: str) -> str:
    """The text of a product, without the factors that are 1 or -1."""
    for one, other in ((first, second), (second, first)):
        if one == _NONE:
            return _NONE
        if one == "1.0":
            return other
        if one == "-1.0":
            return negative(other)
    return f"{first} * {second}"


def negative(term: str) -> str:
    """The text of -term, where term is a name, a number or a product of such."""
    if term == _NONE:
        return _NONE
    return term[1:] if term.startswith("-") else f"-{term}"


def sum_of(terms: Sequence[str]) -> str:
    """The text of a sum of products; "0.0" of none."""
    retained = [term for term in terms if term != _NONE]
    if not retained:
        return _NONE
    text = retained[0]
    for term in retained[1:]:
        text += f" - {term[1:]}" if term.startswith("-") else f" + {term}"
    return text


def handed_on(form: str, slope: str, own: str, operands: Sequence[str], style: Style) -> Sequence[str]:
    """Of ``slope`` over the result ``own`` of a form what is over each of its operands.

    Raises KeyError for a form without a rule.
    """
    if form in _SILENT:
        return [_NONE] * len(operands)
    if form == "{0} ** {1}":
        if operands[1] not in ("(2)", "(2.0)"):
            raise KeyError(f"{form} with the exponent {operands[1]}")
        return product(slope, f"2.0 * {operands[0]}"), _NONE
    return _RULES[form](slope, own, operands, style)


def _quotient(slope: str, own: str, operands: Sequence[str], style: Style) -> Sequence[str]:
    return f"{slope} / {operands[1]}", negative(f"{product(slope, own)} / {operands[1]}")


def _absolute(slope: str, own: str, operands: Sequence[str], style: Style) -> Sequence[str]:
    down = style.choice(f"{operands[0]} < 0.0", negative(slope), _NONE)
    return (style.choice(f"{operands[0]} > 0.0", slope, down),)


def _minimum(slope: str, own: str, operands: Sequence[str], style: Style) -> Sequence[str]:
    second = f"{operands[1]} < {operands[0]}"
    return style.choice(second, _NONE, slope), style.choice(second, slope, _NONE)


def _maximum(slope: str, own: str, operands: Sequence[str], style: Style) -> Sequence[str]:
    second = f"{operands[1]} > {operands[0]}"
    return style.choice(second, _NONE, slope), style.choice(second, slope, _NONE)


def _clip(slope: str, own: str, operands: Sequence[str], style: Style) -> Sequence[str]:
    low, high = f"{operands[0]} <= {operands[1]}", f"{operands[0]} >= {operands[2]}"
    inside = style.choice(low, _NONE, style.choice(high, _NONE, slope))
    return inside, style.choice(low, slope, _NONE), style.choice(low, _NONE, style.choice(high, slope, _NONE))


def _where(slope: str, own: str, operands: Sequence[str], style: Style) -> Sequence[str]:
    return _NONE, style.choice(operands[0], slope, _NONE), style.choice(operands[0], _NONE, slope)


def _hypot(slope: str, own: str, operands: Sequence[str], style: Style) -> Sequence[str]:
    """Where both are 0 there is no direction: the second one is taken for it."""
    some = f"{own} > 0.0"
    first, second = (product(slope, f"{operand} / {own}") for operand in operands)
    return style.choice(some, first, _NONE), style.choice(some, second, slope)


_RULES: dict[str, Rule] = {
    "-{0}": lambda d, own, o, s: (negative(d),),
    "+{0}": lambda d, own, o, s: (d,),
    "abs({0})": _absolute,
    "{0} + {1}": lambda d, own, o, s: (d, d),
    "{0} - {1}": lambda d, own, o, s: (d, negative(d)),
    "{0} * {1}": lambda d, own, o, s: (product(d, o[1]), product(d, o[0])),
    "{0} / {1}": _quotient,
    "sin": lambda d, own, o, s: (product(d, f"cos({o[0]})"),),
    "cos": lambda d, own, o, s: (negative(product(d, f"sin({o[0]})")),),
    "tan": lambda d, own, o, s: (product(d, f"(1.0 + {own} * {own})"),),
    "atan": lambda d, own, o, s: (f"{d} / (1.0 + {o[0]} * {o[0]})",),
    "tanh": lambda d, own, o, s: (product(d, f"(1.0 - {own} * {own})"),),
    "exp": lambda d, own, o, s: (product(d, own),),
    "sqrt": lambda d, own, o, s: (f"{d} / (2.0 * {own})",),
    "absolute": _absolute,
    "minimum": _minimum,
    "maximum": _maximum,
    "clip": _clip,
    "where": _where,
    "hypot": _hypot,
}
