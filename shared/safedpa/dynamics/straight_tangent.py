"""The tangent of recorded equations in the action, as one straight-line function.

Complex steps, as in ``complex_step``: every entry of the action gets an infinitesimal imaginary part in turn. What does
not depend on that entry stays a plain float, which is computed once for all of them; it is the real part of what the
complex functions give, so that the slopes are those of ``complex_step`` to the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Any

from safedpa.operations import COMPLEX, Operations

__all__ = ["IMAGINARY", "StraightTangent", "compiled_tangent"]

StraightTangent = Callable[[Sequence[float], Sequence[float], Sequence[float], float], tuple[list[float], list[Any]]]
"""Entries after one period (states,) and their slopes in the action (states, actions), from state, felt action, latent
and the time [s]."""

Line = tuple[str, str, tuple[str, ...]]
"""Name, form and operands of one operation."""

IMAGINARY = 1e-30
"""Imaginary part of a nudged action: its square vanishes beside every real part, so the slope is exact."""

_FUNCTIONS = tuple(field.name for field in fields(Operations))


def compiled_tangent(
    head: Sequence[str],
    tape: Sequence[Line],
    calls: Mapping[str, Callable[..., Any]],
    after: Sequence[str],
    actions: Sequence[str],
) -> StraightTangent:
    """The function for recorded lines, whose entries ``after`` one period depend on ``actions``, all by name."""
    bodies = [_nudged(tape, action, index) for index, action in enumerate(actions)]
    shared = [(name, _line(name, form, operands, real=True)) for name, form, operands in tape]
    wanted = [named.get(name, name) for _, named in bodies for name in after]
    lines = _needed([*shared, *(line for body, _ in bodies for line in body)], wanted)
    nudges = [f"{action}_{index} = complex({action}, {IMAGINARY!r})" for index, action in enumerate(actions)]
    first = bodies[0][1]
    values = [f"{first[name]}.real" if name in first else name for name in after]
    rows = [
        "[" + ", ".join(f"{named[name]}.imag / {IMAGINARY!r}" if name in named else "0.0" for _, named in bodies) + "]"
        for name in after
    ]
    text = ["def tangent(state, action, latent, time):", *head, *nudges, *lines]
    text.append(f"return [{', '.join(values)}], [{', '.join(rows)}]")
    scope: dict[str, Any] = {"inf": math.inf, "nan": math.nan, **calls}
    scope.update({name: getattr(COMPLEX, name) for name in _FUNCTIONS})
    exec("\n    ".join(text), scope)  # arithmetic on names of our own, nothing from outside
    tangent: StraightTangent = scope["tangent"]
    return tangent


def _nudged(tape: Sequence[Line], action: str, index: int) -> tuple[list[tuple[str, str]], dict[str, str]]:
    """The lines that depend on one entry of the action, by name, and what their variables are called then."""
    named, lines = {action: f"{action}_{index}"}, []
    for name, form, operands in tape:
        if any(operand in named for operand in operands):
            own = f"{name}_{index}"
            lines.append((own, _line(own, form, tuple(named.get(item, item) for item in operands), real=False)))
            named[name] = own
    return lines, named


def _line(name: str, form: str, operands: tuple[str, ...], *, real: bool) -> str:
    if form not in _FUNCTIONS:
        return f"{name} = {form.format(*operands)}"
    return f"{name} = {form}({', '.join(operands)})" + (".real" if real else "")


def _needed(lines: Sequence[tuple[str, str]], wanted: Sequence[str]) -> list[str]:
    """Of lines by the variable that they set, those that the wanted variables depend on, in the same order."""
    alive, kept = set(wanted), []
    for name, line in reversed(lines):
        if name in alive:
            kept.append(line)
            alive.update(_variables(line))
    return kept[::-1]


def _variables(line: str) -> list[str]:
    """Words of a line's right-hand side; that functions are among them does no harm."""
    _, _, right = line.partition(" = ")
    return "".join(letter if letter.isalnum() or letter == "_" else " " for letter in right).split()
