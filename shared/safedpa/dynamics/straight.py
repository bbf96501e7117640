"""Equations recorded once and replayed as straight-line Python: the fast road for one robot.

Base and effects are written over named scalars: dictionaries, calls and contexts cost ten times what the arithmetic
costs. So their equations are run once with numbers that only write down what is done to them; what is written down
becomes one function of plain local variables. It does the same operations on the same numbers in the same order, hence
the same result to the last bit; what occurs several times (the tangent of one steering angle in four stages of an
integrator) is computed once. Equations that branch on a number cannot be recorded and keep the road of dictionaries,
which is the reference: ``PhysicsModel`` takes it wherever this one has no answer.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics.tangent import StraightTangent, compiled_tangent, tangent_text, written_key
from safedpa.dynamics.written_steps import WRITTEN
from safedpa.equations.tape import FLOAT_FORMS, FUNCTIONS, Recorded, Tape, name_of
from safedpa.operations import COMPLEX, FLOATS, NUMPY, Operations, Scalar, half_angled

__all__ = [
    "Equations",
    "Straight",
    "StraightStep",
    "StraightSteps",
    "call_function",
    "is_recorded",
    "paced",
    "rollout_held_action",
    "step_texts",
    "straight_arrays",
    "straight_sensitivity",
    "straight_step",
]

StraightStep = Callable[[Iterable[Any], Iterable[Any], Iterable[Any], float], list[Any]]
"""Entries after one period from the entries of state, felt action and latent, and the time [s]."""

Equations = Callable[[Sequence[Any], Sequence[Any], Sequence[Any], Any, Operations], Sequence[Any]]
"""The same, with the table that the equations take their functions from."""


def rollout_held_action(
    step: StraightStep,
    entries: Iterable[float],
    held: NDArray[np.float64],
    latent: NDArray[np.float64],
    seconds: float,
    period: float,
    steps: int,
) -> tuple[tuple[float, ...], ...]:
    """(steps, states) that follow under a held action (actions,) from ``seconds`` since the start on.

    Empty where a number is refused, or not finite; a model's ``held`` does the same with arrays, and answers then.
    """
    rows, action, free = list[tuple[float, ...]](), held.tolist(), latent.tolist()
    try:
        for index in range(steps):
            rows.append(entries := tuple(step(entries, action, free, seconds + index * period)))
    except (ValueError, ArithmeticError):
        return ()
    return tuple(rows) if math.isfinite(sum(map(sum, rows))) else ()


_WORTHWHILE = 200
"""Steps of one period, after which recording (a few milliseconds) pays: a fit tries thousands of models briefly."""
_MOST_PERIODS = 8
"""Services see one period; recordings with irregular sampling see any number."""

_ARRAY_FORMS = {"clip": "minimum(maximum({0}, {1}), {2})"}
"""What the table of numpy does, without a call of Python's."""

_DEEPEST = 40
"""Brackets in one expression: Python's own parser takes no more than 200 within each other."""


def call_function(function: Callable[..., Sequence[Any]], operands: Sequence[Any], count: int) -> Sequence[Any]:
    """The ``count`` results of ``function(*operands)``, among equations that may be recorded.

    For what is no arithmetic on single numbers, such as a network. It gets the same floats whenever the equations run,
    so its operands must not depend on the action.
    """
    tape = next((operand.tape for operand in operands if isinstance(operand, Recorded)), None)
    return function(*operands) if tape is None else tape.call(function, operands, count)


def is_recorded(number: Any) -> bool:
    """Whether it is not known yet, because equations are being recorded."""
    return isinstance(number, Recorded)


Straight = tuple[StraightStep, StraightStep, StraightTangent]
"""For floats, for complex numbers, and the tangent in the action."""


@final
class StraightSteps:
    """The straight-line functions of one model, by period, recorded once they are worth it.

    ``record(period)`` makes them, or None where the equations cannot be recorded.
    """

    def __init__(self, record: Callable[[float], Straight | None] | None) -> None:
        self._record = record
        self._asked: dict[float, int] = {}
        self._floats: dict[float, StraightStep] = {}
        self._complex: dict[float, StraightStep] = {}
        self._tangents: dict[float, StraightTangent] = {}

    def floats(self, period: float) -> StraightStep | None:
        """For Python floats; None: take the other road."""
        return self._floats.get(period) or self._considered(period)

    def tangent(self, period: float) -> StraightTangent | None:
        """Values and slopes in one go; None: take the other road."""
        return self._tangents.get(period) or (self._tangents.get(period) if self._considered(period) else None)

    def of(self, period: float, operations: Operations) -> StraightStep | None:
        """For the numbers that the table is made for; None: take the other road."""
        if operations is FLOATS:
            return self.floats(period)
        return self._complex.get(period) if operations is COMPLEX else None

    def write(self, period: float) -> None:
        """Records at once, for who will ask often enough."""
        if period not in self._floats:
            self._asked[period] = _WORTHWHILE - 1
            self._considered(period)

    def _considered(self, period: float) -> StraightStep | None:
        if self._record is None or (period not in self._asked and len(self._asked) >= _MOST_PERIODS):
            return None
        asked = self._asked[period] = self._asked.get(period, 0) + 1
        if asked == _WORTHWHILE:
            made = self._record(period)
            if made is None:
                self._record = None
                return None
            self._floats[period], self._complex[period], self._tangents[period] = made
        return self._floats.get(period)

    def __getstate__(self) -> dict[str, Any]:
        """Functions made here do not travel to another process; they are made there again."""
        return {**self.__dict__, "_asked": {}, "_floats": {}, "_complex": {}, "_tangents": {}}


def straight_step(
    equations: Equations, states: Sequence[str], actions: Sequence[str], latents: Sequence[str]
) -> Straight | None:
    """The equations as straight-line functions; None where they cannot be recorded.

    Of the names only the number counts.
    """
    taped = _taped(equations, states, actions, latents)
    if taped is None:
        return None
    tape, head, names = taped
    return (
        _compiled(head, tape, names, FLOAT_FORMS, FLOATS),
        _compiled(head, tape, names, {}, COMPLEX),
        compiled_tangent(head, tape.lines, tape.calls, names, [f"a{index}" for index in range(len(actions))]),
    )


def straight_arrays(
    equations: Equations, states: Sequence[str], actions: Sequence[str], latents: Sequence[str]
) -> StraightStep | None:
    """The same for numpy arrays: each entry of state, felt action and latent is one array over many robots.

    None where the equations cannot be recorded or call what is made for one robot.
    """
    taped = _taped(equations, states, actions, latents)
    if taped is None or taped[0].calls:
        return None
    tape, head, names = taped
    return _compiled(head, tape, names, _ARRAY_FORMS, NUMPY, freeing=True)


def paced(equations_of: Callable[[float], Equations]) -> Equations:
    """Equations whose last latent entry is the period, with sines and cosines from one tangent."""

    def equations(
        state: Sequence[Scalar],
        action: Sequence[Scalar],
        latent: Sequence[Scalar],
        time: Scalar,
        operations: Operations,
    ) -> Sequence[Scalar]:
        return equations_of(latent[-1])(state, action, latent[:-1], time, half_angled(operations))

    return equations


def straight_sensitivity(
    equations: Equations, states: Sequence[str], actions: Sequence[str], latents: Sequence[str]
) -> StraightTangent | None:
    """The values and their slopes in state and action (states, states + actions), as ``straight_step`` has the tangent.

    None where the equations cannot be recorded or call what is no arithmetic: the slopes of that are not known.
    """
    taped = _taped(equations, states, actions, latents)
    if taped is None or taped[0].calls:
        return None
    tape, head, names = taped
    varied = [*(f"s{index}" for index in range(len(states))), *(f"a{index}" for index in range(len(actions)))]
    return compiled_tangent(head, tape.lines, tape.calls, names, varied)


def _taped(
    equations: Equations, states: Sequence[str], actions: Sequence[str], latents: Sequence[str]
) -> tuple[Tape, list[str], list[str]] | None:
    """What the equations do, the lines that name their arguments, and the names of what comes out."""
    tape = Tape()
    state, action, latent = (
        [Recorded(tape, f"{letter}{index}") for index in range(len(names))]
        for letter, names in (("s", states), ("a", actions), ("z", latents))
    )
    try:
        after = equations(state, action, latent, Recorded(tape, "time"), tape.operations())
        names = [name_of(entry) for entry in after]
    except TypeError:  # among them what a recorded number cannot do
        return None
    head = [
        f"[{', '.join(number.name for number in numbers)}] = {whole}"
        for whole, numbers in (("state", state), ("action", action), ("latent", latent))
    ]
    tape.keep(names)
    return tape, head, names


def step_texts(
    equations: Equations, states: Sequence[str], actions: Sequence[str], latents: Sequence[str]
) -> tuple[str, str] | None:
    """What ``straight_step`` makes of the equations for floats: the step, and its tangent in the action, as text.

    None where they cannot be recorded, or call what no text says.
    """
    taped = _taped(equations, states, actions, latents)
    if taped is None or taped[0].calls:
        return None
    tape, head, names = taped
    varied = [f"a{index}" for index in range(len(actions))]
    return _text(head, tape, names, FLOAT_FORMS), tangent_text(head, tape.lines, names, varied)


def _compiled(
    head: Sequence[str],
    tape: Tape,
    after: Sequence[str],
    forms: Mapping[str, str],
    table: Operations,
    *,
    freeing: bool = False,
) -> StraightStep:
    """``freeing`` gives each variable's memory back after its last use: for arrays, which then stay in the cache."""
    text = _text(head, tape, after, forms, freeing=freeing)
    known: StraightStep | None = WRITTEN.get(written_key(text)) if table is FLOATS and not tape.calls else None
    if known is not None:
        return known
    scope: dict[str, Any] = {"inf": math.inf, "nan": math.nan, **tape.calls}
    scope.update({name: getattr(table, name) for name in FUNCTIONS})
    exec(text, scope)  # arithmetic on names of our own, nothing from outside
    step: StraightStep = scope["step"]
    return step


def _text(
    head: Sequence[str], tape: Tape, after: Sequence[str], forms: Mapping[str, str], *, freeing: bool = False
) -> str:
    last_use = {name: index for index, (_, _, operands) in enumerate(tape.lines) for name in operands}
    computed = {name for name, _, _ in tape.lines}
    lines = ["def step(state, action, latent, time):", *head]
    nested = set[str]() if freeing else _used_once(tape, after)
    terms: dict[str, str] = {}
    for index, (name, form, operands) in enumerate(tape.lines):
        term = _term(form, [terms.get(operand, operand) for operand in operands], forms)
        if name in nested and term.count("(") <= _DEEPEST:
            terms[name] = f"({term})"
            continue
        lines.append(f"{name} = {term}")
        spent = {other for other in operands if other in computed and last_use[other] == index and other not in after}
        if freeing and spent:
            lines.append(f"del {', '.join(sorted(spent))}")
    lines.append(f"return [{', '.join(after)}]")
    return "\n    ".join(lines)


def _term(form: str, operands: Sequence[str], forms: Mapping[str, str]) -> str:
    """One operation as Python has it."""
    written = forms.get(form) if form in FUNCTIONS else form
    return f"{form}({', '.join(operands)})" if written is None else written.format(*operands)


def _used_once(tape: Tape, after: Sequence[str]) -> set[str]:
    """Variables that one line alone needs, and always: that line may hold the operation itself.

    A quarter of the time was storing such numbers and loading them again. A form with a branch in it may need an
    operand twice or never: such a one stays a variable.
    """
    uses = Counter(operand for _, _, operands in tape.lines for operand in operands)
    branching = {
        operand for _, form, operands in tape.lines if " if " in FLOAT_FORMS.get(form, form) for operand in operands
    }
    twice = {operand for _, form, operands in tape.lines if form == "sign" for operand in operands}
    return {name for name, count in uses.items() if count == 1} - branching - twice - set(after)
