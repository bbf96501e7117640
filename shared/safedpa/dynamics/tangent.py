"""Computes the tangent of a step at an action: (f, g) with step(a) = f + g a.

There is one method for each kind of numbers. One robot: the source of the recorded equations is differentiated line by
line; before they are recorded, complex steps or central differences. Batches: central differences (NumPy) or forward
mode (torch).

The differentiated source carries, for each value that depends on an entry of the action, its slope times 1e-30: the
real and imaginary part of ``complex_step`` as two floats. The value is computed once for all entries, and most slopes
take one product. The slopes equal those of ``complex_step``, mostly to the last bit. For a function without a rule
here, that one line computes with complex numbers.
"""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics.dynamics import Array
from safedpa.equations.rows import nested
from safedpa.equations.tape import FLOAT_FORMS, FUNCTIONS, Line
from safedpa.operations import COMPLEX, FLOATS, Operations

ScalarTangent = Callable[[Sequence[float], Sequence[float], Sequence[float], float], tuple[list[float], list[Any]]]
"""(state, felt action, latent, time [s]) -> next state (states,), its slopes in the action (states, actions)."""

_IMAGINARY = 1e-30
"""Imaginary part of a perturbed action: its square vanishes next to every real part, so the slope is exact."""

_INLINE = {form: text for form, text in FLOAT_FORMS.items() if form != "sign"}
"""Forms without a call. The sign is not listed: it has no slope."""

_LARGEST_COSH = 700.0
"""Beyond, 1 / cosh underflows to 0; from 710.5 on ``math.cosh`` raises OverflowError."""

_RULES = {
    "-{0}": "-{d0}",
    "+{0}": "{d0}",
    "tan": "{d0} * (1.0 + {own} * {own})",
    "atan": "{d0} / (1.0 + {0} * {0})",
    "exp": "{own} * {d0}",
    "sqrt": "{d0} / (2.0 * {own})",
    "absolute": "({d0} if {0} > 0.0 else -{d0} if {0} < 0.0 else 0.0)",
    "minimum": "({d1} if {1} < {0} else {d0})",
    "maximum": "({d1} if {1} > {0} else {d0})",
    "clip": "({d1} if {0} <= {1} else {d2} if {0} >= {2} else {d0})",
    "where": "({d1} if {0} else {d2})",
}
"""Slope by form: ``own`` is the value, ``{0}`` the first operand, ``d0`` its slope ("0.0" if it has none)."""
# clip: on a bound the slope is that of the bound, as complex steps have it

_PRODUCTS: dict[tuple[object, ...], str] = {
    ("{0} + {1}", True, True): "{d0} + {d1}",
    ("{0} + {1}", True, False): "{d0}",
    ("{0} + {1}", False, True): "{d1}",
    ("{0} - {1}", True, True): "{d0} - {d1}",
    ("{0} - {1}", True, False): "{d0}",
    ("{0} - {1}", False, True): "-{d1}",
    ("{0} * {1}", True, True): "{0} * {d1} + {d0} * {1}",
    ("{0} * {1}", True, False): "{d0} * {1}",
    ("{0} * {1}", False, True): "{0} * {d1}",
    ("{0} / {1}", True, True): "({d0} - {0} * ({d1} / {1})) / {1}",
    ("{0} / {1}", True, False): "{d0} / {1}",
    ("{0} / {1}", False, True): "-({0} * ({d1} / {1})) / {1}",
}
"""Slope by form and by which operands have one: terms that are 0 are not written."""

_COMPARISONS = tuple(f"{{0}} {sign} {{1}}" for sign in ("<", "<=", ">", ">=", "==", "!="))


def compiled_tangent(
    head: Sequence[str],
    tape: Sequence[Line],
    calls: Mapping[str, Callable[..., Any]],
    after: Sequence[str],
    actions: Sequence[str],
) -> ScalarTangent:
    """Returns the function of values and slopes for recorded lines; ``after`` and ``actions`` name variables."""
    text = tangent_text(head, tape, after, actions)
    # a constant that is infinite or NaN is written by its name, as repr does
    scope: dict[str, Any] = {"inf": math.inf, "nan": math.nan, "cosh": math.cosh, **calls}
    scope.update({name: getattr(FLOATS, name) for name in FUNCTIONS})
    scope.update({f"complex_{name}": getattr(COMPLEX, name) for name in FUNCTIONS})
    exec(text, scope)  # the text is arithmetic on generated names: nothing of a model file or a message is in it
    tangent: ScalarTangent = scope["tangent"]
    return tangent


def tangent_text(head: Sequence[str], tape: Sequence[Line], after: Sequence[str], actions: Sequence[str]) -> str:
    """Returns the source of that function."""
    # all values first, then the slopes: one dead-code elimination over both drops what no result needs
    slopes = _Slopes(tape)
    columns = [slopes.of(action, index) for index, action in enumerate(actions)]
    wanted = [*after, *(named[name] for named in columns for name in after if name in named)]
    rows = [
        "[" + ", ".join(f"{named[name]} / {_IMAGINARY!r}" if name in named else "0.0" for named in columns) + "]"
        for name in after
    ]
    lines = ["def tangent(state, action, latent, time):", *head, *nested(slopes.lines, wanted)]
    lines.append(f"return [{', '.join(after)}], [{', '.join(rows)}]")
    return "\n    ".join(lines)


@final
class _Slopes:
    """The lines of a tape, followed by the lines of its slopes, entry by entry of the action."""

    def __init__(self, tape: Sequence[Line]) -> None:
        self._tape = tape
        self._sines = {(form, operands): name for name, form, operands in tape if form in ("sin", "cos")}
        self._shared: set[str] = set()
        self.lines = [(name, _value(form, operands)) for name, form, operands in tape]
        """(variable, term) of each line."""

    def of(self, action: str, index: int) -> dict[str, str]:
        """Adds the lines of the slopes in one entry. Returns the slopes' variables by those of the values."""
        named = {action: repr(_IMAGINARY)}
        for name, form, operands in self._tape:
            # comparisons and the sign are constant wherever they have a slope
            if form in (*_COMPARISONS, "sign") or not any(operand in named for operand in operands):
                continue
            term = self._term(name, form, operands, named)
            if term in named.values() or term == "0.0":
                named[name] = term  # a copy of another slope needs no line of its own
            else:
                named[name] = f"{name}_{index}"
                self.lines.append((named[name], term))
        return named

    def _term(self, name: str, form: str, operands: tuple[str, ...], named: Mapping[str, str]) -> str:
        """Returns the slope of one operation's value."""
        known = {f"d{place}": named.get(operand, "0.0") for place, operand in enumerate(operands)}
        rule = _RULES.get(form) or _PRODUCTS.get((form, *(operand in named for operand in operands)))
        # the rule depends on which operands have a slope: usually one has, and the other's term is 0 and left out
        if rule is not None:
            return rule.format(*operands, own=name, **known)
        if form == "sin":
            return f"{self._alongside('cos', operands)} * {known['d0']}"
        if form == "cos":
            return f"-({self._alongside('sin', operands)} * {known['d0']})"
        if form == "tanh":
            # d(tanh x) = dx / cosh(x)^2: 1 - tanh(x)^2 would lose all digits for large x
            share = f"1.0 / cosh({operands[0]}) if abs({operands[0]}) < {_LARGEST_COSH} else 0.0"
            share = self._line(f"{name}_share", share)
            return f"{known['d0']} * {share} * {share}"
        # other powers need a logarithm: they take the complex step below
        if form == "{0} ** {1}" and operands[0] in named and operands[1] in ("(2)", "(2.0)"):
            return f"2.0 * ({operands[0]} * {known['d0']})"
        # no rule: one complex step for this line alone
        both = [f"complex({item}, {named[item]})" if item in named else item for item in operands]
        return (f"complex_{form}({', '.join(both)})" if form in FUNCTIONS else f"({form.format(*both)})") + ".imag"

    def _alongside(self, function: str, operands: tuple[str, ...]) -> str:
        """Returns the variable that holds the sine or cosine of an angle, adding its line if there is none yet."""
        known = self._sines.get((function, operands))
        return known or self._line(f"{function}_{operands[0]}", f"{function}({operands[0]})")

    def _line(self, name: str, term: str) -> str:
        if name not in self._shared:
            self._shared.add(name)
            self.lines.append((name, term))
        return name


def _value(form: str, operands: tuple[str, ...]) -> str:
    if form not in FUNCTIONS:
        return form.format(*operands)
    written = _INLINE.get(form)
    return f"{form}({', '.join(operands)})" if written is None else written.format(*operands)


_PERTURBATION = 1e-5
"""Share of an actuator's range by which a central difference moves the action. The error of the method grows with its
square (curvature: 1e-10), that of rounding with its inverse (1e-16 of a position: 1e-10 at 10 m)."""


def single_tangent(
    step: Callable[[Sequence[Any], Operations], Sequence[Any]],
    action: Sequence[float],
    ranges: Sequence[float],
    takes_complex: bool,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns f (states,) and g (states, actions) for one robot: by complex steps if ``takes_complex``."""
    if takes_complex:
        # Python's cmath raises on overflow; the differences then return NaN
        with contextlib.suppress(ValueError, ArithmeticError):
            return complex_step(lambda perturbed: step(perturbed, COMPLEX), action)
    return _difference(lambda perturbed: step(perturbed, FLOATS), action, ranges)


def complex_step(
    step: Callable[[Sequence[Any]], Sequence[Any]], action: Sequence[float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns (f, g) with slopes Im step(action + i h) / h: exact, one step per entry of the action.

    Source: Squire and Trapp, Using complex variables to estimate derivatives of real functions, SIAM Review 40, 1998.
    """
    after = []
    for index, value in enumerate(action):
        perturbed: list[Any] = list(action)
        perturbed[index] = complex(value, _IMAGINARY)
        after.append(step(perturbed))
    g = [[entry.imag / _IMAGINARY for entry in row] for row in zip(*after, strict=True)]
    # the real part is the step itself: the imaginary part is too small to change a digit of it
    return intercept([entry.real for entry in after[0]], g, action), np.array(g)


def _difference(
    step: Callable[[Sequence[float]], Sequence[float]], action: Sequence[float], ranges: Sequence[float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns (f, g) by central differences: exact for an affine step, the mean of both sides at a kink."""
    slopes = []
    for index, width in enumerate(ranges):
        shift = _PERTURBATION * width
        up, down = list(action), list(action)
        up[index] += shift
        down[index] -= shift
        slopes.append([(high - low) / (2.0 * shift) for high, low in zip(step(up), step(down), strict=True)])
    g = list(zip(*slopes, strict=True))
    return intercept(step(action), g, action), np.array(g)


def intercept(value: Sequence[float], g: Sequence[Sequence[float]], action: Sequence[float]) -> NDArray[np.float64]:
    """Returns f = value - g action."""
    return np.array(
        [
            entry - sum(slope * felt for slope, felt in zip(row, action, strict=True))
            for entry, row in zip(value, g, strict=True)
        ]
    )


def batched_difference(
    step: Callable[[Array], Array], action: Array, ranges: Sequence[float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns f (..., states) and g (..., states, actions) by central differences over NumPy arrays."""
    slopes = []
    for index, width in enumerate(ranges):
        shift = np.zeros(len(ranges))
        shift[index] = _PERTURBATION * width
        slopes.append((step(action + shift) - step(action - shift)) / (2.0 * _PERTURBATION * width))
    g = np.stack(slopes, axis=-1)
    # f through the step at the action itself, not the mean of both sides: there f + g a equals the step exactly
    return step(action) - np.einsum("...sa,...a->...s", g, action), g


def forward_mode(step: Callable[[Array], Array], action: Any) -> tuple[Any, Any]:
    """Returns f (..., states) and g (..., states, actions) by forward-mode derivatives over torch tensors: exact."""
    import torch

    jvp, slopes = _forward_derivative(), []
    for index in range(action.shape[-1]):
        direction = torch.zeros_like(action)
        direction[..., index] = 1.0
        value, slope = jvp(step, (action,), (direction,))
        slopes.append(slope)
    g = torch.stack(slopes, dim=-1)
    return value - torch.einsum("...sa,...a->...s", g, action), g


@cache
def _forward_derivative() -> Callable[..., Any]:
    """Returns torch.func.jvp, called once so that its deprecation warning on the first call stays silent."""
    import torch

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.func.jvp(torch.sin, (torch.zeros(()),), (torch.ones(()),))
    return torch.func.jvp
