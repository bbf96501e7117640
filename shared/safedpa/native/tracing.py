"""Records a user's functions over arrays, and says which line prevents it.

A function that has a parameter ``operations`` may be recorded: it is called with the elementwise functions of NumPy, or
with functions that record themselves. It then gets arrays of symbolic numbers, so slices, sums and products with
constant matrices are recorded as well. It runs once for the recording, so it must not branch on a number.
"""

from __future__ import annotations

import inspect
import linecache
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from safedpa.equations.tape import FUNCTIONS, Line, NotRecordableError, Recorded, Tape, name_of
from safedpa.operations import NUMPY, Operations

__all__ = [
    "OverNumpy",
    "RecordedFunction",
    "array_operations",
    "record",
    "takes_operations",
    "why_not_recorded",
    "with_numpy",
]

_PACKAGE = str(Path(__file__).resolve().parents[1])


@final
@dataclass(frozen=True)
class RecordedFunction:
    """One function as straight-line operations: from the ``inputs`` (names by argument) to the ``results``."""

    inputs: tuple[tuple[str, ...], ...]
    lines: tuple[Line, ...]
    results: tuple[str, ...]


def takes_operations(function: Any) -> bool:
    """Returns whether a function has a parameter ``operations``: it may then be recorded."""
    try:
        return "operations" in inspect.signature(function).parameters
    except (TypeError, ValueError):
        return False


def with_numpy(function: Callable[..., Any]) -> Callable[..., Any]:
    """Returns the function with the elementwise functions of NumPy as ``operations``; others as they are."""
    return OverNumpy(function) if takes_operations(function) else function


@final
@dataclass(frozen=True)
class OverNumpy:
    """A function over ``operations``, called with those of NumPy. Unlike a ``partial`` it can be pickled."""

    function: Callable[..., Any]

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        """Returns what the function returns."""
        return self.function(*arguments, operations=NUMPY, **keywords)

    @property
    def __signature__(self) -> inspect.Signature:
        whole = inspect.signature(self.function)
        return whole.replace(parameters=[each for name, each in whole.parameters.items() if name != "operations"])


def record(function: Callable[..., Any], sizes: Sequence[tuple[str, int]]) -> RecordedFunction:
    """Returns the recording of ``function(*inputs, operations)``, each input an array of (name, size) symbolic numbers.

    The results are all entries of what the function returns, in order. Raises NotRecordableError for a function that
    branches on a number, or that does other operations when it runs again; any other exception is the function's own.
    """
    first, second = _recorded(function, sizes), _recorded(function, sizes)
    if first != second:
        raise NotRecordableError("two recordings differ: the function depends on more than its arguments")
    return first


def _recorded(function: Callable[..., Any], sizes: Sequence[tuple[str, int]]) -> RecordedFunction:
    tape = Tape()
    inputs = tuple(tuple(f"{letter}{index}" for index in range(size)) for letter, size in sizes)
    arrays = [_symbols(tape, names) for names in inputs]
    results = tuple(name_of(_plain(entry)) for entry in _entries(function(*arrays, operations=array_operations(tape))))
    tape.keep(results)
    return RecordedFunction(inputs, tuple(tape.lines), results)


def array_operations(tape: Tape) -> Operations:
    """Returns operations that record themselves, also entry by entry for arrays of symbolic numbers."""

    def recorder(name: str) -> Callable[..., Any]:
        def recorded(*operands: Any) -> Any:
            if not any(isinstance(operand, (np.ndarray, list, tuple)) for operand in operands):
                return tape.record(name, *map(_plain, operands))
            arrays = np.broadcast_arrays(*(np.asarray(operand, dtype=object) for operand in operands))
            found = np.empty(arrays[0].shape, dtype=object)
            for index in np.ndindex(found.shape):
                found[index] = tape.record(name, *(_plain(array[index]) for array in arrays))
            return found

        return recorded

    return Operations(**{name: recorder(name) for name in FUNCTIONS})


def why_not_recorded(error: BaseException) -> str:
    """Returns the reason in one line: the user's line that was running, and what it needed."""
    reason = str(error).splitlines()[0] if str(error) else type(error).__name__
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        file = str(Path(frame.filename).resolve()) if Path(frame.filename).exists() else frame.filename
        if not file.startswith(_PACKAGE) and "site-packages" not in file:
            line = (frame.line or linecache.getline(frame.filename, frame.lineno or 0)).strip()
            return f"{Path(frame.filename).name} line {frame.lineno}, '{line}': {reason}"
    return reason


def _symbols(tape: Tape, names: Sequence[str]) -> Any:
    array = np.empty(len(names), dtype=object)
    array[:] = [Recorded(tape, name) for name in names]
    return array


def _entries(value: Any) -> list[Any]:
    """Returns all entries of nested tuples, lists and arrays, in order."""
    if isinstance(value, (tuple, list)):
        return [entry for part in value for entry in _entries(part)]
    return value.reshape(-1).tolist() if isinstance(value, np.ndarray) else [value]


def _plain(value: Any) -> Any:
    """Returns a NumPy scalar as Python's own type: a recording has no others."""
    return value.item() if isinstance(value, (np.generic, np.ndarray)) and np.size(value) == 1 else value
