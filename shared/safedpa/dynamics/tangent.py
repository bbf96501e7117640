"""The tangent of a step at an action: (f, g) with step(a) = f + g a, by the road that fits the numbers.

For one robot it is the tangent of recorded equations, as one straight-line function. Dual numbers, one real number
after the other: next to each value that depends on an entry of the action stands its slope, times 1e-30. These are the
real and the imaginary part of ``complex_step``, without complex numbers: the value is computed once for all entries,
and most slopes take one product. The slopes are those of ``complex_step``, mostly to the last bit; where a function has
no rule here, complex numbers are taken for that one line.
"""

from __future__ import annotations

import contextlib
import math
import re
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import cache
from hashlib import blake2b
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics.dynamics import Array
from safedpa.dynamics.written_steps import WRITTEN
from safedpa.operations import COMPLEX, FLOATS, Operations

__all__ = [
    "StraightTangent",
    "batched_difference",
    "compiled_tangent",
    "complex_step",
    "forward_mode",
    "intercept",
    "single_tangent",
    "tangent_text",
    "written_key",
]

StraightTangent = Callable[[Sequence[float], Sequence[float], Sequence[float], float], tuple[list[float], list[Any]]]
"""Entries after one period (states,) and their slopes in the action (states, actions), from state, felt action, latent
and the time [s]."""

Line = tuple[str, str, tuple[str, ...]]
"""Name, form and operands of one operation."""

_IMAGINARY = 1e-30
"""Imaginary part of a nudged action: its square vanishes next to every real part, so the slope is exact."""

_FUNCTIONS = tuple(field.name for field in fields(Operations))

_INLINE = {
    "absolute": "abs({0})",
    "minimum": "({1} if {1} < {0} else {0})",
    "maximum": "({1} if {1} > {0} else {0})",
    "clip": "({1} if {0} < {1} else {2} if {0} > {2} else {0})",
    "where": "({1} if {0} else {2})",
}
"""Values that take no call."""

_NAME = re.compile(r"\b[a-z]\w*\b")
_DEEPEST = 40
"""Brackets in one line: Python's own parser takes no more than 200 within each other."""

_LARGEST_COSH = 700.0
"""Beyond, 1 / cosh is nothing; a little further ``cosh`` itself is refused."""

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
"""Slopes where ``d0`` belongs to the first operand and so on, ``own`` is the value itself; 0.0 where one has none."""

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
"""By which of both operands have slopes."""

_COMPARISONS = tuple(f"{{0}} {sign} {{1}}" for sign in ("<", "<=", ">", ">=", "==", "!="))


def compiled_tangent(
    head: Sequence[str],
    tape: Sequence[Line],
    calls: Mapping[str, Callable[..., Any]],
    after: Sequence[str],
    actions: Sequence[str],
) -> StraightTangent:
    """The function for recorded lines, whose entries ``after`` one period depend on ``actions``, all by name."""
    text = tangent_text(head, tape, after, actions)
    known: StraightTangent | None = None if calls else WRITTEN.get(written_key(text))
    if known is not None:
        return known
    scope: dict[str, Any] = {"inf": math.inf, "nan": math.nan, "cosh": math.cosh, **calls}
    scope.update({name: getattr(FLOATS, name) for name in _FUNCTIONS})
    scope.update({f"complex_{name}": getattr(COMPLEX, name) for name in _FUNCTIONS})
    exec(text, scope)  # arithmetic on names of our own, nothing from outside
    tangent: StraightTangent = scope["tangent"]
    return tangent


def tangent_text(head: Sequence[str], tape: Sequence[Line], after: Sequence[str], actions: Sequence[str]) -> str:
    """The same function as Python's own text."""
    slopes = _Slopes(tape)
    columns = [slopes.of(action, index) for index, action in enumerate(actions)]
    wanted = [*after, *(named[name] for named in columns for name in after if name in named)]
    rows = [
        "[" + ", ".join(f"{named[name]} / {_IMAGINARY!r}" if name in named else "0.0" for named in columns) + "]"
        for name in after
    ]
    lines = ["def tangent(state, action, latent, time):", *head, *_nested(_needed(slopes.lines, wanted), wanted)]
    lines.append(f"return [{', '.join(after)}], [{', '.join(rows)}]")
    return "\n    ".join(lines)


def written_key(text: str) -> str:
    """The name under which a recorded function is written ahead of time: BLAKE2b of its text in UTF-8, 16 bytes.

    One with this text does the same to the last bit, unless it calls what no text says.
    """
    return blake2b(text.encode(), digest_size=16).hexdigest()


@final
class _Slopes:
    """The lines of a tape, and of the slopes of its values in one entry of the action after the other."""

    def __init__(self, tape: Sequence[Line]) -> None:
        self._tape = tape
        self._sines = {(form, operands): name for name, form, operands in tape if form in ("sin", "cos")}
        self._shared: set[str] = set()
        self.lines = [(name, _value(form, operands)) for name, form, operands in tape]
        """Terms by the variable that they set."""

    def of(self, action: str, index: int) -> dict[str, str]:
        """Adds the slopes in one entry; the variables that hold them, by those that hold the values."""
        named = {action: repr(_IMAGINARY)}
        for name, form, operands in self._tape:
            if form in (*_COMPARISONS, "sign") or not any(operand in named for operand in operands):
                continue
            term = self._term(name, form, operands, named)
            if term in named.values() or term == "0.0":
                named[name] = term
            else:
                named[name] = f"{name}_{index}"
                self.lines.append((named[name], term))
        return named

    def _term(self, name: str, form: str, operands: tuple[str, ...], named: Mapping[str, str]) -> str:
        """The slope of one operation's value."""
        known = {f"d{place}": named.get(operand, "0.0") for place, operand in enumerate(operands)}
        rule = _RULES.get(form) or _PRODUCTS.get((form, *(operand in named for operand in operands)))
        if rule is not None:
            return rule.format(*operands, own=name, **known)
        if form == "sin":
            return f"{self._alongside('cos', operands)} * {known['d0']}"
        if form == "cos":
            return f"-({self._alongside('sin', operands)} * {known['d0']})"
        if form == "tanh":
            share = f"1.0 / cosh({operands[0]}) if abs({operands[0]}) < {_LARGEST_COSH} else 0.0"
            share = self._line(f"{name}_share", share)
            return f"{known['d0']} * {share} * {share}"
        if form == "{0} ** {1}" and operands[0] in named and operands[1] in ("(2)", "(2.0)"):
            return f"2.0 * ({operands[0]} * {known['d0']})"
        both = [f"complex({item}, {named[item]})" if item in named else item for item in operands]
        return (f"complex_{form}({', '.join(both)})" if form in _FUNCTIONS else f"({form.format(*both)})") + ".imag"

    def _alongside(self, function: str, operands: tuple[str, ...]) -> str:
        """The variable that holds the sine or cosine of an angle."""
        known = self._sines.get((function, operands))
        return known or self._line(f"{function}_{operands[0]}", f"{function}({operands[0]})")

    def _line(self, name: str, term: str) -> str:
        if name not in self._shared:
            self._shared.add(name)
            self.lines.append((name, term))
        return name


def _value(form: str, operands: tuple[str, ...]) -> str:
    if form not in _FUNCTIONS:
        return form.format(*operands)
    written = _INLINE.get(form)
    return f"{form}({', '.join(operands)})" if written is None else written.format(*operands)


def _needed(lines: Sequence[tuple[str, str]], wanted: Sequence[str]) -> list[tuple[str, str]]:
    """Of terms by the variable that they set, those that the wanted variables depend on, in the same order."""
    alive, retained = set(wanted), []
    for name, term in reversed(lines):
        if name in alive:
            retained.append((name, term))
            alive.update(_NAME.findall(term))
    return retained[::-1]


def _nested(lines: Sequence[tuple[str, str]], wanted: Sequence[str]) -> list[str]:
    """The lines, where a variable that one other alone needs stands in that one's line: not stored and loaded again."""
    uses = Counter(word for _, term in lines for word in _NAME.findall(term)) + Counter(2 * list(wanted))
    terms: dict[str, str] = {}
    written = []
    for name, term in lines:
        whole = _NAME.sub(lambda found: terms.pop(found[0], found[0]), term)
        if uses[name] == 1 and whole.count("(") < _DEEPEST:
            terms[name] = f"({whole})"
        else:
            written.append(f"{name} = {whole}")
    return written


_NUDGE = 1e-5
"""Share of an actuator's range by which the action is moved for a central difference. The error grows with its square
(curvature: 1e-10) and with its inverse (rounding: 1e-16 of a position, 1e-10 at 10 m)."""


def single_tangent(
    step: Callable[[Sequence[Any], Operations], Sequence[Any]],
    action: Sequence[float],
    ranges: Sequence[float],
    takes_complex: bool,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """f (states,) and g (states, actions) for one robot: by complex steps where all equations take complex numbers."""
    if takes_complex:
        # Python's cmath refuses numbers that overflow; the differences answer them with NaN
        with contextlib.suppress(ValueError, ArithmeticError):
            return complex_step(lambda nudged: step(nudged, COMPLEX), action)
    return _difference(lambda nudged: step(nudged, FLOATS), action, ranges)


def complex_step(
    step: Callable[[Sequence[Any]], Sequence[Any]], action: Sequence[float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """slope = Im step(action + i h) / h: exact tangents, one step per action.

    Source: Squire and Trapp, Using complex variables to estimate derivatives of real functions, SIAM Review 40, 1998.
    """
    after = []
    for index, value in enumerate(action):
        nudged: list[Any] = list(action)
        nudged[index] = complex(value, _IMAGINARY)
        after.append(step(nudged))
    g = [[entry.imag / _IMAGINARY for entry in row] for row in zip(*after, strict=True)]
    return intercept([entry.real for entry in after[0]], g, action), np.array(g)


def _difference(
    step: Callable[[Sequence[float]], Sequence[float]], action: Sequence[float], ranges: Sequence[float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Central differences; exact where the step is affine, the mean of both sides at a kink."""
    slopes = []
    for index, width in enumerate(ranges):
        nudge = _NUDGE * width
        up, down = list(action), list(action)
        up[index] += nudge
        down[index] -= nudge
        slopes.append([(high - low) / (2.0 * nudge) for high, low in zip(step(up), step(down), strict=True)])
    g = list(zip(*slopes, strict=True))
    return intercept(step(action), g, action), np.array(g)


def intercept(value: Sequence[float], g: Sequence[Sequence[float]], action: Sequence[float]) -> NDArray[np.float64]:
    """f = value - g action."""
    return np.array(
        [
            entry - sum(slope * felt for slope, felt in zip(row, action, strict=True))
            for entry, row in zip(value, g, strict=True)
        ]
    )


def batched_difference(
    step: Callable[[Array], Array], action: Array, ranges: Sequence[float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Central differences over numpy arrays: f (..., states), g (..., states, actions)."""
    slopes = []
    for index, width in enumerate(ranges):
        nudge = np.zeros(len(ranges))
        nudge[index] = _NUDGE * width
        slopes.append((step(action + nudge) - step(action - nudge)) / (2.0 * _NUDGE * width))
    g = np.stack(slopes, axis=-1)
    return step(action) - np.einsum("...sa,...a->...s", g, action), g


def forward_mode(step: Callable[[Array], Array], action: Any) -> tuple[Any, Any]:
    """Forward-mode derivatives over torch tensors: f (..., states), g (..., states, actions), exact tangents."""
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
    """torch.func.jvp, called once so that torch's own deprecation warning from the first call stays silent."""
    import torch

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.func.jvp(torch.sin, (torch.zeros(()),), (torch.ones(()),))
    return torch.func.jvp
