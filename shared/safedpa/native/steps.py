"""Steps of models, and rows of barriers, as compiled objects that replace their recorded Python functions."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from ctypes import CDLL, c_void_p, cast
from functools import cache, cached_property, partial
from hashlib import blake2b
from pathlib import Path
from threading import Event
from typing import Any, Final, NamedTuple, final

from safedpa import equations
from safedpa.equations.rows import RowTape, nested
from safedpa.equations.scalar_rows import (
    retained_names,
    row_slopes,
    row_terms,
    scalar_rows,
    scene_lines,
    shared_names,
    values,
)
from safedpa.equations.slopes import plain_choice
from safedpa.equations.tape import NotRecordableError
from safedpa.native.library import (
    NoKernelError,
    is_compiled,
    later,
    load,
    load_module,
    recall,
    remark,
    remember,
)
from safedpa.native.translate import Translator, function_lines

__all__ = ["CompiledRows", "LateStep", "RowsSource", "compiled_step", "rows_source", "step_source"]

_HEAD: Final = '#include <math.h>\n\n#define EXPORTED __attribute__((visibility("default"))) void\n'
_ARGUMENTS: Final = (("state", "s"), ("action", "a"), ("latent", "z"))
_STEP: Final = "const double *s, const double *a, const double *z, const double *t, const double *k, double *out"
_ROWS: Final = "const double *s, const double *kept, const double *k"
_TRANSLATING: Final = (Path(equations.__file__).parent, Path(__file__).parent)
"""The packages that translate."""
_ITEMS: Final = "const double *const *items, const int *counts"


class RowsSource(NamedTuple):
    """The C of recorded rows."""

    source: str
    constants: list[float]
    """Of the call."""
    retained: list[str]
    """Names of what is computed once for a scene."""


def step_source(step: str, tangent: str) -> tuple[str, list[float]]:
    """Returns the C of a step and its tangent from their Python source, and the constants of the call.

    Raises NotRecordableError for source that has no C.
    """
    translator = Translator()
    functions = []
    for name, text, more in (("step", step, ""), ("tangent", tangent, ", double *g")):
        lines = function_lines(text, _ARGUMENTS, translator)
        functions.append(_function(f"model_{name}", _STEP + more, ["const double time = t[0];", *lines]))
    return "\n".join([_HEAD, *functions]), translator.constants


def compiled_step(step: str, tangent: str, sizes: tuple[int, int, int]) -> Any:
    """Returns a ``Step`` for a model with so many states, actions and latents; see ``step_source``.

    Raises NoKernelError where it cannot be compiled or loaded.
    """
    return _loaded_step(*step_source(step, tangent), sizes)


def _loaded_step(source: str, constants: list[float], sizes: tuple[int, int, int]) -> Any:
    library = load(source)
    return load_module().Step(
        _address(library, "model_step"), _address(library, "model_tangent"), constants, *sizes, library
    )


@final
class LateStep:
    """The compiled step of a model: at once if it is in the cache, otherwise as soon as the compiler is done.

    A background thread compiles, because a robot that drives gets new models and must not wait for that.
    """

    def __init__(self, step: str, tangent: str, sizes: tuple[int, int, int]) -> None:
        self.compiled: Any = None
        """The ``Step``; None: Python computes."""
        self._done = Event()
        try:
            # Here and not in that thread: Python 3.11 cannot parse in two threads (SystemError: AST constructor).
            source, constants = step_source(step, tangent)
        except NotRecordableError:  # an operation without C
            self._done.set()
            return
        ready = is_compiled(source)
        make = partial(self._make, source, constants, sizes)
        if ready:
            make()
        else:
            later(make)

    def wait(self) -> None:
        """Waits until there is no compiler to wait for."""
        self._done.wait()

    def _make(self, source: str, constants: list[float], sizes: tuple[int, int, int]) -> None:
        try:
            self.compiled = _loaded_step(source, constants, sizes)
        except NoKernelError as error:
            remark(str(error))
        finally:
            self._done.set()


def rows_source(tape: RowTape) -> RowsSource:
    """Returns the C of recorded rows, from the cache if they were translated before."""
    key = _tape_key(tape)
    if (text := recall(key)) is not None:
        return RowsSource(*json.loads(text))
    found = _translated(tape)
    remember(key, json.dumps(found))
    return found


def _tape_key(tape: RowTape) -> str:
    groups = [(group.body, group.shared, group.each) for group in tape.groups]
    recorded = tape.state, tape.shared, tape.each, tape.results, tape.grad_bound, tape.lines, groups
    return blake2b(f"{_translator_digest()}{recorded}".encode(), digest_size=16).hexdigest()


@cache
def _translator_digest() -> str:
    """Of the modules that translate: what another version of them has stored is not recalled."""
    files = [file for folder in _TRANSLATING for file in sorted(folder.glob("*.py"))]
    return blake2b(b"".join(file.read_bytes() for file in files), digest_size=16).hexdigest()


def _translated(tape: RowTape) -> RowsSource:
    translator, retained = Translator(), retained_names(tape)
    shared = [f"const double {name} = p[{index}];" for index, name in enumerate(shared_names(tape))]
    kept = [f"kept[{index}] = {name};" for index, name in enumerate(retained)]
    functions = [
        _function(
            "scene",
            "const double *p, const double *k, double *kept",
            [*shared, *translator.lines(scene_lines(tape)), *kept],
        ),
        _function("h", f"{_ROWS}, {_ITEMS}, double *out", _h(tape, retained, translator)),
        _function(
            "slopes",
            f"{_ROWS}, {_ITEMS}, const int *rows, int count, double *out",
            _slopes(tape, retained, translator),
        ),
    ]
    if tape.grad_bound is not None:
        lines = nested(values(tape, "state", tape.grad_bound), tape.grad_bound)
        results = [f"out[{i}] = {translator.expression(name)};" for i, name in enumerate(tape.grad_bound)]
        body = [*_head(tape, retained), *translator.lines(lines), *results]
        functions.append(_function("bound", f"{_ROWS}, double *out", body))
    return RowsSource("\n".join([_HEAD, *functions]), translator.constants, retained)


@final
class CompiledRows:
    """Makes the rows of a scene from its numbers: compiled ones, or those of the recorded Python class, the twin.

    Both give the same results, and the twin answers for numbers that Python's math refuses. Without a file in the cache
    a background thread compiles, and the twin serves until it is done: a robot that drives must not wait for that.
    """

    def __init__(self, tape: RowTape) -> None:
        self._tape, self._done = tape, Event()
        self._made: Callable[[Any, Any], Any] = self._twin
        try:
            self._source = rows_source(tape)
            if is_compiled(self._source[0]):
                self._load()
            else:
                later(self._load)
        except NotRecordableError:
            self._done.set()

    def __call__(self, shared: Any, each: Any) -> Any:
        """Returns an object with ``h_floats``, ``grad_h_floats``, ``lie_derivative_floats`` and ``grad_bound``."""
        return self._made(shared, each)

    def prepare(self) -> None:
        """Makes the twin's class now, where nothing is compiled yet."""
        if self._made == self._twin:
            self._class  # noqa: B018 - cached

    def wait(self) -> None:
        """Waits until there is no compiler to wait for."""
        self._done.wait()

    def _load(self) -> None:
        try:
            self._made = partial(_made, load_module().Rows, self._twin, self._kind())
        except NoKernelError as error:
            remark(str(error))
        finally:
            self._done.set()

    def _kind(self) -> tuple[Any, ...]:
        """What the rows of all scenes have in common, as ``Rows`` takes it."""
        tape, (source, constants, retained) = self._tape, self._source
        library = load(source)
        functions = [_address(library, f"rows_{name}") for name in ("scene", "h", "slopes")]
        bound = 0 if tape.grad_bound is None else _address(library, "rows_bound")
        groups = tuple(
            (int(group.body < 0), group.shared, group.each, len(results))
            for group, results in zip(tape.groups, tape.results, strict=True)
        )
        return (*functions, bound, constants, len(tape.state), len(retained), groups, self._twin, library)

    def _twin(self, shared: Any, each: Any) -> Any:
        return self._class(shared, each)

    @cached_property
    def _class(self) -> Any:
        return scalar_rows(self._tape)  # ten milliseconds: only where it is needed


def _made(rows: Any, twin: Any, kind: tuple[Any, ...], shared: Any, each: Any) -> Any:
    try:
        return rows(kind, list(shared), list(each))
    except (ArithmeticError, TypeError, ValueError):  # odd numbers: Python answers, with its own errors
        return twin(shared, each)


def _function(name: str, arguments: str, lines: Sequence[str]) -> str:
    prefix = "" if name.startswith("model_") else "rows_"
    body = "\n    ".join(lines)
    return f"EXPORTED {prefix}{name}({arguments})\n{{\n    {body}\n}}\n"


def _address(library: CDLL, name: str) -> int:
    found = cast(getattr(library, name), c_void_p).value
    assert found is not None
    return found


def _head(tape: RowTape, retained: Sequence[str]) -> list[str]:
    state = [f"const double {name} = s[{index}];" for index, name in enumerate(tape.state)]
    return [*state, *(f"const double {name} = kept[{index}];" for index, name in enumerate(retained))]


def _item(tape: RowTape, number: int, place: str) -> list[str]:
    names = tape.each[number]
    entries = [f"const double {name} = e[{index}];" for index, name in enumerate(names)]
    return [f"const double *e = items[{number}] + {len(names)} * {place};", "(void)e;", *entries]


def _h(tape: RowTape, retained: Sequence[str], translator: Translator) -> list[str]:
    every = [name for names in tape.results for name in names]
    items = [nested(values(tape, "item", names), names) for names in tape.results]
    state = nested(values(tape, "state", every), [*every, *(line for lines in items for line in lines)])
    found = [*_head(tape, retained), *translator.lines(state)]
    for number, lines in enumerate(items):
        found.append(f"for (int i = 0; i < counts[{number}]; i++) {{")
        results = [f"*out++ = {translator.expression(name)};" for name in tape.results[number]]
        found += [f"    {one}" for one in (*_item(tape, number, "i"), *translator.lines(lines), *results)]
        found.append("}")
    return found


def _slopes(tape: RowTape, retained: Sequence[str], translator: Translator) -> list[str]:
    groups = [[row_slopes(tape, number, result) for result in names] for number, names in enumerate(tape.results)]
    over = {name for rows in groups for _, slopes, _ in rows for name in slopes}
    known_lines, known = tape.state_slopes(sorted(over), plain_choice)
    bodies = [[row_terms(tape, row, known) for row in rows] for rows in groups]
    wanted = [line for rows in bodies for lines, terms in rows for line in (*lines, *terms)]
    needed = [*over, *(name for name in _identifiers(wanted) if tape.level(name) == "state")]
    state = nested([*values(tape, "state", needed), *known_lines], wanted)
    found = [*_head(tape, retained), *translator.lines(state)]
    found += [f"for (int n = 0; n < count; n++, out += {len(tape.state)}) {{", "    int row = rows[n];"]
    for number, rows in enumerate(bodies):
        found.append(f"    if (row < {len(rows)} * counts[{number}]) {{")
        found += [f"        {one}" for one in _item(tape, number, f"(row / {len(rows)})")]
        for which, (lines, terms) in enumerate(rows):
            results = [f"out[{index}] = {translator.expression(term)};" for index, term in enumerate(terms)]
            found.append(f"        if (row % {len(rows)} == {which}) {{")
            found += [f"            {one}" for one in (*translator.lines(lines), *results, "continue;")]
            found.append("        }")
        found += ["    }", f"    row -= {len(rows)} * counts[{number}];"]
    return [*found, "}"]


def _identifiers(lines: Sequence[str]) -> set[str]:
    return {word for line in lines for word in re.findall(r"\b[a-z]\w*\b", line)}
