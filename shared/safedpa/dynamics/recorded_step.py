"""Records a model's equations once and compiles them to straight-line Python: the fast step for one robot.

Base and effects are written over named scalars; their dictionaries, calls and contexts take ten times as long as the
arithmetic. So the equations run once with numbers that record each operation (a trace, as in JAX), and the recording
becomes one function of local variables. It does the same operations in the same order as the equations, so the result
is the same to the last bit. A value that occurs several times (the tangent of the steering angle in four stages of an
integrator) is computed once. Equations that branch on a number cannot be recorded: ``PhysicsModel`` then uses its
reference implementation.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics.tangent import ScalarTangent, compiled_tangent, tangent_text
from safedpa.equations.tape import FLOAT_FORMS, FUNCTIONS, Recorded, Tape, name_of
from safedpa.native.captured import Captured
from safedpa.native.steps import LateStep
from safedpa.operations import COMPLEX, FLOATS, NUMPY, Operations, Scalar, half_angled

ScalarStep = Callable[[Iterable[Any], Iterable[Any], Iterable[Any], float], list[Any]]
"""(state, felt action, latent, time [s]) -> state after one period, all as entries."""

Equations = Callable[[Sequence[Any], Sequence[Any], Sequence[Any], Any, Operations], Sequence[Any]]
"""The same arguments, and the operations to compute with."""

Names = tuple[Sequence[str], Sequence[str], Sequence[str]]
"""Names of the entries of state, action and latent; only their number matters."""


def rollout_held_action(
    step: ScalarStep,
    entries: Iterable[float],
    held: NDArray[np.float64],
    latent: NDArray[np.float64],
    seconds: float,
    period: float,
    steps: int,
) -> tuple[tuple[float, ...], ...]:
    """Returns the states (steps, states) under a held action (actions,), from ``seconds`` after the start.

    Empty if a number is rejected or not finite: the caller then uses the model's ``rollout_held``.
    """
    rows, action, free = list[tuple[float, ...]](), held.tolist(), latent.tolist()
    try:
        for index in range(steps):
            rows.append(entries := tuple(step(entries, action, free, seconds + index * period)))
    except (ValueError, ArithmeticError):
        return ()
    # one sum instead of a test for each entry: NaN and infinity survive addition
    return tuple(rows) if math.isfinite(sum(map(sum, rows))) else ()


_RECORD_AFTER = 200
"""Calls with one period after which recording (a few milliseconds) pays: a fit tries thousands of models briefly."""
_MAX_PERIODS = 8
"""Periods that are recorded: a service sees one, a log with irregular sampling any number."""

_ARRAY_FORMS = {"clip": "minimum(maximum({0}, {1}), {2})"}
"""The definition in ``NUMPY``, inlined: it saves a Python call."""

_MAX_NESTING = 40
"""Parentheses within each other in one expression: Python's parser accepts no more than 200."""


def call_function(function: Callable[..., Sequence[Any]], operands: Sequence[Any], count: int) -> Sequence[Any]:
    """Returns the ``count`` results of ``function(*operands)`` within equations that may be recorded.

    For functions that are no arithmetic on scalars, such as a network. Its operands must not depend on the action.
    """
    # the tangent knows no slope of a call: an operand that depended on the action would silently lose its slope
    tape = next((operand.tape for operand in operands if isinstance(operand, Recorded)), None)
    return function(*operands) if tape is None else tape.call(function, operands, count)


def is_recorded(number: Any) -> bool:
    """Returns whether ``number`` stands for a value that equations being recorded will compute."""
    return isinstance(number, Recorded)


RecordedStep = tuple[ScalarStep, ScalarStep, ScalarTangent]
"""The step for floats, the step for complex numbers, and the tangent in the action."""


@final
class RecordedSteps:
    """The recorded functions of one model, by period, recorded after enough calls.

    ``record(period, native)`` returns them, or None if the equations cannot be recorded. ``native``: compiled to C,
    where that is possible.
    """

    def __init__(self, record: Callable[[float, bool], RecordedStep | None] | None) -> None:
        self._record = record
        self._native = False
        self._calls: dict[float, int] = {}
        self._floats: dict[float, ScalarStep] = {}
        self._complex: dict[float, ScalarStep] = {}
        self._tangents: dict[float, ScalarTangent] = {}

    def floats(self, period: float) -> ScalarStep | None:
        """Returns the step for floats, or None before it is recorded."""
        return self._floats.get(period) or self._count(period)

    def tangent(self, period: float) -> ScalarTangent | None:
        """Returns the function of values and slopes, or None before it is recorded."""
        return self._tangents.get(period) or (self._tangents.get(period) if self._count(period) else None)

    def of(self, period: float, operations: Operations) -> ScalarStep | None:
        """Returns the step for the numbers of these operations, or None."""
        if operations is FLOATS:
            return self.floats(period)
        return self._complex.get(period) if operations is COMPLEX else None

    def record(self, period: float) -> None:
        """Records now, and compiles, which may take a second."""
        if period not in self._floats or not self._native:
            self._native = True
            self._calls[period] = _RECORD_AFTER - 1
            self._count(period)

    def _count(self, period: float) -> ScalarStep | None:
        """Counts a call, and records when there were enough of them."""
        if self._record is None or (period not in self._calls and len(self._calls) >= _MAX_PERIODS):
            return None
        calls = self._calls[period] = self._calls.get(period, 0) + 1
        if calls == _RECORD_AFTER:
            functions = self._record(period, self._native)
            if functions is None:
                self._record = None  # a branch does not depend on the period: no further attempt
                return None
            self._floats[period], self._complex[period], self._tangents[period] = functions
        return self._floats.get(period)

    def __getstate__(self) -> dict[str, Any]:
        # functions made by exec cannot be pickled: the other process records again
        return {**self.__dict__, "_calls": {}, "_floats": {}, "_complex": {}, "_tangents": {}}


def record_step(equations: Equations, names: Names, native: bool = False) -> RecordedStep | None:
    """Returns the recorded functions, or None if the equations cannot be recorded.

    ``native``: step and tangent are compiled to C where a compiler is present, with the same results.
    """
    taped = _taped(equations, names)
    if taped is None:
        return None
    tape, head, after = taped
    # no inlined forms: comparisons of complex numbers need the functions of ``COMPLEX``
    complex_step = _compiled(head, tape, after, {}, COMPLEX)
    step, tangent = _step_and_tangent(tape, head, after, names, native)
    return step, complex_step, tangent


def _step_and_tangent(
    tape: Tape, head: list[str], after: list[str], names: Names, native: bool
) -> tuple[ScalarStep, ScalarTangent]:
    actions = _numbered("a", names[1])
    late = None
    if native and not tape.calls:
        texts = _text(head, tape, after, FLOAT_FORMS), tangent_text(head, tape.lines, after, actions)
        late = LateStep(*texts, (len(names[0]), len(names[1]), len(names[2])))
        if late.compiled is not None:
            return late.compiled.step, late.compiled.tangent
    tangent = compiled_tangent(head, tape.lines, tape.calls, after, actions)
    step = _compiled(head, tape, after, FLOAT_FORMS, FLOATS)
    step.late = late  # type: ignore[attr-defined]  # for ``compiled_step_of``
    return step, tangent


def record_own_step(
    equations: Equations, names: Names, watched: Sequence[Captured], native: bool
) -> RecordedStep | None:
    """Returns the recorded functions of a user's equations, or None if they cannot be recorded.

    They are compiled to C if ``native`` and a compiler is present. As soon as anything that the equations read besides
    their arguments changes (``watched``), the functions raise ArithmeticError, and the caller uses the equations.
    """
    try:
        first, second = _taped(equations, names), _taped(equations, names)
    except Exception:  # noqa: BLE001 - a user's equations raise anything for symbolic numbers
        return None
    # random numbers, or a counter: a recording would freeze the first run
    if first is None or second is None or first[0].lines != second[0].lines or first[2] != second[2]:
        return None
    tape, head, after = first
    step, tangent = _step_and_tangent(tape, head, after, names, native)
    complex_step = _compiled(head, tape, after, {}, COMPLEX)
    return _watched(step, watched), _watched(complex_step, watched), _watched(tangent, watched)


def _watched(function: Callable[..., Any], watched: Sequence[Captured]) -> Callable[..., Any]:
    def guarded(state: Any, action: Any, latent: Any, time: float) -> Any:
        for each in watched:
            if not each.unchanged():
                raise ArithmeticError("the equations read other values than they did while they were recorded")
        return function(state, action, latent, time)

    guarded.watched = watched  # type: ignore[attr-defined]  # for ``compiled_step_of``
    guarded.function = function  # type: ignore[attr-defined]
    return guarded


def compiled_step_of(step: Any) -> Any:
    """Returns the ``safedpa.native`` object whose method a recorded step is, if it is up to date; else None."""
    if not all(each.unchanged() for each in getattr(step, "watched", ())):
        return None
    own = getattr(step, "function", step)
    late = getattr(own, "late", None)
    owner = getattr(own, "__self__", None) if late is None else late.compiled
    return owner if hasattr(owner, "tangent") else None


def wait_for_compiler(step: Any) -> None:
    """Waits until no compiler is busy with this step."""
    late = getattr(getattr(step, "function", step), "late", None)
    if late is not None:
        late.wait()


def record_batch_step(equations: Equations, names: Names) -> ScalarStep | None:
    """Returns the step over NumPy arrays: each entry of state, felt action and latent is one array over many robots.

    None if the equations cannot be recorded, or call a function for one robot (networks).
    """
    taped = _taped(equations, names)
    if taped is None or taped[0].calls:
        return None
    tape, head, after = taped
    return _compiled(head, tape, after, _ARRAY_FORMS, NUMPY, freeing=True)


def with_period_argument(equations_of: Callable[[float], Equations]) -> Equations:
    """Returns equations whose last latent entry is the period, with sine and cosine from one tangent."""

    def equations(
        state: Sequence[Scalar],
        action: Sequence[Scalar],
        latent: Sequence[Scalar],
        time: Scalar,
        operations: Operations,
    ) -> Sequence[Scalar]:
        # a log has rows of different periods: as an argument, one recording serves all of them
        return equations_of(latent[-1])(state, action, latent[:-1], time, half_angled(operations))

    return equations


def record_sensitivity(equations: Equations, names: Names) -> ScalarTangent | None:
    """Returns the function of values and slopes in state and action (states, states + actions).

    None if the equations cannot be recorded, or call a function whose slopes are not known (networks).
    """
    taped = _taped(equations, names)
    if taped is None or taped[0].calls:
        return None
    tape, head, after = taped
    varied = [*_numbered("s", names[0]), *_numbered("a", names[1])]
    return compiled_tangent(head, tape.lines, tape.calls, after, varied)


def _taped(equations: Equations, names: Names) -> tuple[Tape, list[str], list[str]] | None:
    """Returns the recording, the lines that unpack the arguments, and the names of the results; None as callers say."""
    tape = Tape()
    state, action, latent = (
        [Recorded(tape, name) for name in _numbered(letter, own)] for letter, own in zip("saz", names, strict=True)
    )
    try:
        # fixed parameters enter as constants, so models with other values have another digest
        results = equations(state, action, latent, Recorded(tape, "time"), tape.operations())
        after = [name_of(entry) for entry in results]
    except TypeError:  # a NotRecordableError, or an operation that a recorded number lacks
        return None
    head = [
        f"[{', '.join(number.name for number in numbers)}] = {whole}"
        for whole, numbers in (("state", state), ("action", action), ("latent", latent))
    ]
    tape.keep(after)  # positions enter no rate of a car: their intermediate values are dropped
    return tape, head, after


def _numbered(letter: str, names: Sequence[str]) -> list[str]:
    return [f"{letter}{index}" for index in range(len(names))]


def step_texts(equations: Equations, names: Names) -> tuple[str, str] | None:
    """Returns the source that ``record_step`` compiles for floats: the step, and its tangent in the action.

    None if the equations cannot be recorded, or call a function (networks): source cannot name it.
    """
    taped = _taped(equations, names)
    if taped is None or taped[0].calls:
        return None
    tape, head, after = taped
    varied = _numbered("a", names[1])
    return _text(head, tape, after, FLOAT_FORMS), tangent_text(head, tape.lines, after, varied)


def _compiled(
    head: Sequence[str],
    tape: Tape,
    after: Sequence[str],
    forms: Mapping[str, str],
    table: Operations,
    *,
    freeing: bool = False,
) -> ScalarStep:
    """Returns the compiled function; ``freeing`` deletes each variable after its last use."""
    # freeing is for arrays over many robots: NumPy reuses the memory, which then stays in the processor's cache
    text = _text(head, tape, after, forms, freeing=freeing)
    # functions as globals of the text, not as attributes of the table: one lookup less in every operation
    scope: dict[str, Any] = {"inf": math.inf, "nan": math.nan, **tape.calls}
    scope.update({name: getattr(table, name) for name in FUNCTIONS})
    exec(text, scope)  # the text is arithmetic on generated names: nothing of a model file or a message is in it
    step: ScalarStep = scope["step"]
    return step


def _text(
    head: Sequence[str], tape: Tape, after: Sequence[str], forms: Mapping[str, str], *, freeing: bool = False
) -> str:
    # for freeing: the line after which a variable is not read any more
    last_use = {name: index for index, (_, _, operands) in enumerate(tape.lines) for name in operands}
    computed = {name for name, _, _ in tape.lines}
    lines = ["def step(state, action, latent, time):", *head]
    nested = set[str]() if freeing else _used_once(tape, after)
    terms: dict[str, str] = {}
    for index, (name, form, operands) in enumerate(tape.lines):
        term = _term(form, [terms.get(operand, operand) for operand in operands], forms)
        if name in nested and term.count("(") <= _MAX_NESTING:
            terms[name] = f"({term})"
            continue
        lines.append(f"{name} = {term}")
        spent = {other for other in operands if other in computed and last_use[other] == index and other not in after}
        if freeing and spent:
            lines.append(f"del {', '.join(sorted(spent))}")
    lines.append(f"return [{', '.join(after)}]")
    return "\n    ".join(lines)


def _term(form: str, operands: Sequence[str], forms: Mapping[str, str]) -> str:
    """Returns one operation as Python source."""
    written = forms.get(form) if form in FUNCTIONS else form
    return f"{form}({', '.join(operands)})" if written is None else written.format(*operands)


def _used_once(tape: Tape, after: Sequence[str]) -> set[str]:
    """Returns the variables that exactly one line uses, exactly once: their operation is written into that line."""
    # storing and loading such values took a quarter of the time; a form with a branch in it may use its operand twice
    # or never, and so may the sign: those stay variables
    uses = Counter(operand for _, _, operands in tape.lines for operand in operands)
    branching = {
        operand for _, form, operands in tape.lines if " if " in FLOAT_FORMS.get(form, form) for operand in operands
    }
    twice = {operand for _, form, operands in tape.lines if form == "sign" for operand in operands}
    return {name for name, count in uses.items() if count == 1} - branching - twice - set(after)
