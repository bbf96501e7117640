"""The derivative rules of all operations, as source: one table for forward and reverse mode.

For own = form(a, b, ...) and a slope s, a rule gives s d(own)/d(a) for each operand a. In reverse mode s is
d(r)/d(own), and the product a term of d(r)/d(a); in forward mode s is d(a)/d(x), and the product a term of d(own)/d(x).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

Style = Callable[[str, str, str], str]
"""(condition, yes, no) -> the source of ``yes`` if the condition holds, else ``no``."""


def plain_choice(condition: str, yes: str, no: str) -> str:
    """Returns the choice as an expression over floats."""
    return f"({yes} if {condition} else {no})"


def array_choice(condition: str, yes: str, no: str) -> str:
    """Returns the choice as ``where`` over arrays."""
    return f"where({condition}, {yes}, {no})"


Rule = Callable[[str, str, Sequence[str], Style], Sequence[str]]
"""(slope, own, operands, style) -> slope times the derivative by each operand; "0.0" where that is 0."""

_NONE = "0.0"
_SILENT = (*(f"{{0}} {sign} {{1}}" for sign in ("<", "<=", ">", ">=", "==", "!=")), "sign")
"""Forms whose derivative is 0 wherever it exists."""


def product(first: str, second: str) -> str:
    """Returns the source of a product, without factors 1 and -1."""
    for one, other in ((first, second), (second, first)):
        if one == _NONE:
            return _NONE
        if one == "1.0":
            return other
        if one == "-1.0":
            return negative(other)
    return f"{first} * {second}"


def negative(term: str) -> str:
    """Returns the source of -term, for a name, a number or a product of these."""
    if term == _NONE:
        return _NONE
    return term[1:] if term.startswith("-") else f"-{term}"


def sum_of(terms: Sequence[str]) -> str:
    """Returns the source of a sum of products; "0.0" for an empty sum."""
    retained = [term for term in terms if term != _NONE]
    if not retained:
        return _NONE
    text = retained[0]
    for term in retained[1:]:
        text += f" - {term[1:]}" if term.startswith("-") else f" + {term}"
    return text


def operand_slopes(form: str, slope: str, own: str, operands: Sequence[str], style: Style) -> Sequence[str]:
    """Returns ``slope`` times the derivative of ``own`` = form(operands) by each operand.

    Raises KeyError for a form without a rule.
    """
    if form in _SILENT:
        return [_NONE] * len(operands)
    if form == "{0} ** {1}":
        # only squares have a rule: another exponent would need a case of its own at the base 0
        if operands[1] not in ("(2)", "(2.0)"):
            raise KeyError(f"{form} with the exponent {operands[1]}")
        return product(slope, f"2.0 * {operands[0]}"), _NONE
    return _RULES[form](slope, own, operands, style)


def _quotient(slope: str, own: str, operands: Sequence[str], style: Style) -> Sequence[str]:
    return f"{slope} / {operands[1]}", negative(f"{product(slope, own)} / {operands[1]}")


def _absolute(slope: str, own: str, operands: Sequence[str], style: Style) -> Sequence[str]:
    down = style(f"{operands[0]} < 0.0", negative(slope), _NONE)
    return (style(f"{operands[0]} > 0.0", slope, down),)


def _minimum(slope: str, own: str, operands: Sequence[str], style: Style) -> Sequence[str]:
    second = f"{operands[1]} < {operands[0]}"
    return style(second, _NONE, slope), style(second, slope, _NONE)


def _maximum(slope: str, own: str, operands: Sequence[str], style: Style) -> Sequence[str]:
    second = f"{operands[1]} > {operands[0]}"
    return style(second, _NONE, slope), style(second, slope, _NONE)


def _clip(slope: str, own: str, operands: Sequence[str], style: Style) -> Sequence[str]:
    low, high = f"{operands[0]} <= {operands[1]}", f"{operands[0]} >= {operands[2]}"
    inside = style(low, _NONE, style(high, _NONE, slope))
    return inside, style(low, slope, _NONE), style(low, _NONE, style(high, slope, _NONE))


def _where(slope: str, own: str, operands: Sequence[str], style: Style) -> Sequence[str]:
    return _NONE, style(operands[0], slope, _NONE), style(operands[0], _NONE, slope)


def _hypot(slope: str, own: str, operands: Sequence[str], style: Style) -> Sequence[str]:
    # at (0, 0) the derivative does not exist: that along the second operand is taken, which is a subgradient
    some = f"{own} > 0.0"
    first, second = (product(slope, f"{operand} / {own}") for operand in operands)
    return style(some, first, _NONE), style(some, second, slope)


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
