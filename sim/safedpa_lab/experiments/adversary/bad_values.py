"""Values that no filter should be given: for states and nominal actions, for margins, and functions that misbehave."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, NoReturn, final

import numpy as np

__all__ = ["CLOCKS", "FUNCTIONS", "MARGINS", "STALE", "vectors"]


@final
class _Unreadable:
    """Raises whatever is asked of it."""

    def __array__(self, *_: Any, **__: Any) -> NoReturn:
        raise OSError("cannot be read")

    def __len__(self) -> NoReturn:
        raise OSError("has no length")

    def __iter__(self) -> NoReturn:
        raise OSError("cannot be walked")


def vectors(good: list[float]) -> Mapping[str, tuple[Any, bool]]:
    """By name: a value in place of ``good``, and whether anything but a fallback would mean that it is believed."""
    bad, many = good.copy(), [*good, 0.0]
    masked: Any = np.ma.array(good, mask=[True] + [False] * (len(good) - 1))
    return {
        "missing": (None, True),
        "NaN": ([float("nan"), *bad[1:]], True),
        "infinite": ([float("inf"), *bad[1:]], True),
        "minus infinity, as an array": (np.array([-np.inf, *bad[1:]]), True),
        "of 1e308": ([1e308, *bad[1:]], False),
        "masked": (masked, True),
        "text": ("left", True),
        "numbers as text": ([str(value) for value in good], True),
        "bytes": (b"\x00\x01", True),
        "complex": (np.array(good) + 0.5j, True),
        "too long": (many, True),
        "empty": ([], True),
        "one number": (good[0], True),
        "a column": ([[value] for value in good], True),
        "ragged": ([good, [good]], True),
        "a table": ({"x": 1.0}, True),
        "a set": ({1.0, 2.0}, True),
        "none within": ([None, *bad[1:]], True),
        "a generator": ((value for value in good), True),
        "a date": (np.array(["2026-01-01"] * len(good), dtype="datetime64[s]"), True),
        "true and false": (np.array([True] * len(good)), False),
        "objects": (np.array([object()] * len(good), dtype=object), True),
        "unreadable": (_Unreadable(), True),
        "a class": (_Unreadable, True),
        "halves of a float": (np.array(good, dtype=np.float16), False),
    }


MARGINS: Final[Mapping[str, tuple[Any, bool]]] = {
    "an array": (np.array([0.1, 0.2]), True),
    "a number": (0.1, True),
    "text": ("function", True),
    "NaN": ({"function": float("nan")}, True),
    "infinite": ({"function": float("inf")}, True),
    "negative": ({"function": -10.0}, True),
    "text within": ({"function": "x"}, True),
    "number as text": ({"function": "0.1"}, True),
    "missing within": ({"function": None}, True),
    "an array within": ({"function": np.array([0.1, 0.2])}, True),
    "unreadable": (_Unreadable(), True),
}
"""In place of margins by kind."""

STALE: Final[Mapping[str, tuple[Any, bool]]] = {
    "missing": (None, False),
    "a number": (5, True),
    "text": ("state", True),
    "of nothing": ([None], True),
    "unreadable": (_Unreadable(), True),
    "true": (True, True),
}
"""In place of the names of stale inputs."""


def _raises(*_: Any, **__: Any) -> NoReturn:
    raise ZeroDivisionError("as users' functions do")


def _stops(*_: Any, **__: Any) -> NoReturn:
    raise StopIteration


def _recursion(*_: Any, **__: Any) -> NoReturn:
    raise RecursionError("too deep")


FUNCTIONS: Final[Mapping[str, Callable[..., Any]]] = {
    "raises": _raises,
    "stops": _stops,
    "too deep": _recursion,
    "NaN": lambda *_: float("nan"),
    "infinite": lambda *_: float("inf"),
    "nothing": lambda *_: None,
    "text": lambda *_: "1.0",
    "text in a list": lambda *_: ["1.0"],
    "complex": lambda *_: 1.0 + 2.0j,
    "masked": lambda *_: np.ma.array([1.0], mask=[True]),
    "true": lambda *_: True,
    "too many": lambda *_: [1.0, 1.0, 1.0],
    "a table": lambda *_: {"h": 1.0},
    "unreadable": lambda *_: _Unreadable(),
}
"""In place of h, of its gradient, of the model and of the backup."""

CLOCKS: Final[Mapping[str, Callable[[], Any]]] = {
    "raises": _raises,
    "nothing": lambda: None,
    "NaN": lambda: float("nan"),
    "text": lambda: "now",
    "infinite": lambda: float("inf"),
}
