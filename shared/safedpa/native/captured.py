"""What a function reads besides its arguments: a recording is valid as long as that stays the same."""

from __future__ import annotations

import dis
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache, partial
from types import CellType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any, Final, final

import numpy as np

__all__ = ["Captured"]

_DEPTH: Final = 6
"""Objects within objects that are followed."""
_PLAIN: Final = (bool, int, float, complex, str, bytes, type(None))
_TRUSTED: Final = (
    "numpy",
    "safedpa",
    "math",
    "typing",
    "functools",
    "operator",
    "collections",
    "dataclasses",
    "builtins",
)
"""Packages whose functions read nothing that changes."""
_WRITES: Final = {
    **dict.fromkeys(("STORE_GLOBAL", "STORE_ATTR", "DELETE_ATTR", "DELETE_GLOBAL"), "writes"),
    "IMPORT_NAME": "imports",
    "STORE_DEREF": "nonlocal",
}
"""Instructions that a pure function has not, and what they do."""
_INPUTS: Final = ("open", "input", "eval", "exec", "globals", "setattr", "__import__")
"""Built-in functions that read or write what is not an argument."""


@final
class Captured:
    """The values that ``function`` reads from closures, globals, defaults and its object.

    Functions that it calls by name are followed. ``impure`` is the reason why it must not be recorded, if it has one:
    it writes outside of itself, or calls a module of which nothing is known (files, random numbers, the time).
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.impure = ""
        self._readers: list[tuple[Callable[[], Any], Any]] = []
        self._seen: set[int] = set()
        self._alive = [function]  # identities in ``_seen`` stay valid as long as their objects exist
        self._follow(function, _DEPTH)

    def unchanged(self) -> bool:
        """Whether everything that is read still has the same value."""
        for read, value in self._readers:
            try:
                now = read()
            except Exception:  # noqa: BLE001 - whatever was removed has changed
                return False
            if now is not value and not (type(now) is type(value) and isinstance(now, _CONTENTS) and now == value):
                return False
        return True

    @property
    def values(self) -> tuple[Any, ...]:
        """The values, to be compared with those of another time; objects by their identity."""
        return tuple(_hashable(value) for _, value in self._readers)

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy reads again."""
        return Captured, (self._alive[0],)

    def _follow(self, value: Any, depth: int) -> None:
        if isinstance(value, (*_PLAIN, type)) or id(value) in self._seen or not depth:
            return
        self._seen.add(id(value))
        self._alive.append(value)
        if isinstance(value, ModuleType):
            if not _trusted(value.__name__):
                self.impure = self.impure or f"it uses the module '{value.__name__}'"
        elif isinstance(value, (np.ndarray, np.generic)):
            # an array of objects has no contents in its bytes
            self._readers.append((_contents_of(value), _contents_of(value)()))
        else:
            for read in _readers_of(value, self):
                found = read()
                self._readers.append((read, found))
                self._follow(found, depth - 1)


_CONTENTS: Final = (*_PLAIN, tuple)


def _hashable(value: Any) -> Any:
    """Returns the value, or the identity of an object or of a tuple of such, whose entries are followed one by one."""
    try:
        hash(value)
    except TypeError:
        return id(value)
    return value if isinstance(value, _CONTENTS) else id(value)


def _contents_of(array: Any) -> Callable[[], Any]:
    return lambda: (array.shape, tuple(map(id, array.flat)) if array.dtype == object else array.tobytes())


def _readers_of(value: Any, whole: Captured) -> Iterator[Callable[[], Any]]:
    if isinstance(value, FunctionType):
        yield from _read_by(value, whole)
    elif isinstance(value, MethodType):
        yield from (lambda: value.__func__, lambda: value.__self__)
        # attributes of the class, such as constants and the methods that it calls
        kind, code = type(value.__self__), getattr(value.__func__, "__code__", None)
        names = [] if code is None else [name for each in _codes(code) for name in each.co_names]
        yield from (partial(getattr, kind, name, None) for name in dict.fromkeys(names) if hasattr(kind, name))
    elif isinstance(value, partial):
        yield from (lambda: value.func, lambda: value.args, lambda: value.keywords)
    elif isinstance(value, Mapping):
        yield lambda: tuple(value)
        yield from (partial(value.get, key) for key in value)
    elif isinstance(value, (list, tuple)):
        yield lambda: len(value)
        yield from (partial(value.__getitem__, index) for index in range(len(value)))
    elif isinstance(value, (set, frozenset)):
        yield lambda: tuple(sorted(map(repr, value)))
    elif not _trusted(type(value).__module__):
        own = getattr(value, "__dict__", {})
        yield from (partial(own.get, key) for key in list(own))
        method = type(value).__dict__.get("__call__")
        if method is not None:
            yield lambda: type(value).__dict__.get("__call__")


def _read_by(function: FunctionType, whole: Captured) -> Iterator[Callable[[], Any]]:
    if _trusted(function.__module__ or ""):
        return
    yield lambda: function.__code__
    cells = dict(zip(function.__code__.co_freevars, function.__closure__ or (), strict=True))
    yield from (partial(_cell, cell) for cell in cells.values())
    yield from (lambda: function.__defaults__, lambda: function.__kwdefaults__)
    names, suspicions = _facts(function.__code__)
    for kind, name, place in suspicions:
        # a local variable of an outer function may be stored, unless this one shares it
        if kind != "nonlocal" or name in cells:
            whole.impure = whole.impure or f"{place}: it {'writes' if kind == 'nonlocal' else kind} '{name}'"
    space = function.__globals__
    yield from (partial(space.get, name) for name in names if name in space)


@lru_cache(maxsize=256)
def _facts(code: CodeType) -> tuple[tuple[str, ...], tuple[tuple[str, str, str], ...]]:
    """Returns the names that a function reads, and the instructions that a pure function has not: verb, name, line."""
    names, found = list[str](), list[tuple[str, str, str]]()
    for each in _codes(code):
        names += each.co_names
        for instruction in dis.get_instructions(each):
            verb = _WRITES.get(instruction.opname, "")
            if instruction.opname == "LOAD_GLOBAL" and instruction.argval in _INPUTS:
                verb = "calls"
            if verb:
                place = f"{each.co_filename.rpartition('/')[2]} line {_line(instruction, each)}"
                found.append((verb, str(instruction.argval), place))
    return tuple(dict.fromkeys(names)), tuple(found)


def _line(instruction: dis.Instruction, code: CodeType) -> int:
    positions = instruction.positions
    return (positions.lineno if positions is not None else None) or code.co_firstlineno


def _trusted(module: str) -> bool:
    return module.partition(".")[0] in _TRUSTED


def _cell(cell: CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # not assigned yet
        return None


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)
