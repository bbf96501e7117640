"""Attack: inputs and functions that no filter should be given. It must not raise, nor pass, nor believe them."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, NoReturn, final

import numpy as np

from safedpa.safety import FilterSettings, FunctionBarrier, SafetyFilter, Verdict
from safedpa_lab.experiments.adversary.attack import AbstractAttack, Result, Row


@final
class _Unreadable:
    """Raises an error for every request."""

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


def _raising(error: type[Exception]) -> Callable[..., NoReturn]:
    """A function that raises an error, whatever it is given."""

    def raises(*_: Any, **__: Any) -> NoReturn:
        raise error("as users' functions do")

    return raises


FUNCTIONS: Final[Mapping[str, Callable[..., Any]]] = {
    "raises": _raising(ZeroDivisionError),
    "stops": _raising(StopIteration),
    "too deep": _raising(RecursionError),
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
    "raises": _raising(ZeroDivisionError),
    "nothing": lambda: None,
    "NaN": lambda: float("nan"),
    "text": lambda: "now",
    "infinite": lambda: float("inf"),
}


_STATE: Final = [0.5, 0.8]
"""Here the nominal action of 1 is unsafe, so that nothing may be passed."""
_NOMINAL: Final = [1.0]
_DECISIONS: Final = 20_000
"""Of each of two threads."""


@final
@dataclass(frozen=True)
class Treated:
    """What became of one bad input."""

    name: str
    status: str
    """``raised ...`` where the filter, once built, raised; ``refused ...`` where it could not be built."""
    outside: bool
    """The action is not finite or lies beyond its limits."""
    believed: bool


def _f(x: Any) -> Any:
    """The mass on a line, as on the page on safety."""
    return np.array([x[0] + 0.05 * x[1], x[1]])


def _g(_: Any) -> Any:
    """Its action: an acceleration."""
    return np.array([[0.00125], [0.05]])


def _h(x: Any) -> Any:
    """Room less stopping distance."""
    return 1.0 - x[0] - max(x[1], 0.0) ** 2 / 1.6 - 0.1 * max(x[1], 0.0)


def cases() -> dict[str, tuple[Callable[[], Verdict], bool]]:
    """By name: a decision with something bad in it, and whether anything but a fallback believes it."""
    found: dict[str, tuple[Callable[[], Verdict], bool]] = {}

    def add(kind: str, values: Mapping[str, tuple[Any, bool]], ask: Callable[[Any], Verdict]) -> None:
        for name, (value, strict) in values.items():
            found[f"{kind}: {name}"] = partial(ask, value), strict

    add("state", vectors(_STATE), lambda value: _safe().decide(value, nominal=_NOMINAL))
    add("nominal", vectors(_NOMINAL), lambda value: _safe().decide(_STATE, nominal=value))
    add("margin", MARGINS, lambda value: _safe().decide(_STATE, nominal=_NOMINAL, epsilon=value))
    add("stale", STALE, lambda value: _safe().decide(_STATE, nominal=_NOMINAL, stale=value))
    functions = {name: (function, True) for name, function in FUNCTIONS.items()}
    add("h", functions, lambda value: _ask(_safe(barriers=[FunctionBarrier(value)])))
    add("one of two h", functions, lambda value: _ask(_safe(barriers=[FunctionBarrier(_h), FunctionBarrier(value)])))
    add("model", functions, lambda value: _ask(_safe(affine=value)))
    add("gradient", functions, lambda value: _ask(_safe(barriers=[FunctionBarrier(_h, value)])))
    harmless = {name: (function, False) for name, function in FUNCTIONS.items()}
    add("backup", harmless, lambda value: _safe(backup=value).decide([float("nan")] * 2, nominal=_NOMINAL))
    add("clock", {name: (clock, False) for name, clock in CLOCKS.items()}, lambda value: _ask(_safe(clock=value)))
    add("barriers", _SCENES, lambda value: _safe().decide(_STATE, nominal=_NOMINAL, barriers=value))
    add("writes", _WRITERS, lambda value: _ask(_safe(**value)))
    return found


@final
class BadInputs(AbstractAttack):
    """Whether anything is raised, leaves the actuators' limits, is passed, or is believed."""

    name = "inputs"
    sentence = "bad inputs, functions that raise or write, broken clocks, two threads"

    def pieces(self, seed: int, small: bool) -> Sequence[Any]:  # noqa: D102
        return [*cases(), _DECISIONS // 20 if small else _DECISIONS]

    def work(self, piece: Any) -> Any:  # noqa: D102
        return two_threads(piece) if isinstance(piece, int) else treated(piece)

    def reported(self, answers: Sequence[Any]) -> Result:  # noqa: D102
        found = [answer for answer in answers if isinstance(answer, Treated)]
        mixed, refused, count = next(answer for answer in answers if not isinstance(answer, Treated))
        raised = [item for item in found if item.status.startswith("raised")]
        outside, passed = [i for i in found if i.outside], [i for i in found if i.status == "passed"]
        believed = [item for item in found if item.believed]
        rows = [
            Row("decisions that raised", len(raised), len(found), most=0),
            Row("actions out of bounds", len(outside), len(found), most=0),
            Row("an unsafe nominal action passed", len(passed), len(found), most=0),
            Row("bad values believed", len(believed), len(found), most=0),
            Row("refused when the filter was built", sum(i.status.startswith("refused") for i in found), len(found)),
            Row("two threads: answers with the other's barriers", mixed, count, most=0),
            Row("two threads: answers refused", refused, count),
        ]
        worst = {item.name: item.status for item in (*raised, *outside, *passed, *believed)}
        return Result(rows, [{"fault": name, "status": status} for name, status in worst.items()])


def treated(name: str) -> Treated:
    """What becomes of one bad input."""
    ask, strict = cases()[name]
    with np.errstate(all="ignore"):
        try:
            verdict = ask()
        except _NotBuiltError as refusal:
            return Treated(name, f"refused {refusal}", False, False)
        except Exception as error:  # noqa: BLE001 - that nothing is raised is the question
            return Treated(name, f"raised {type(error).__name__}: {error}", False, False)
    status = verdict.status.value
    outside = not (np.isfinite(verdict.action).all() and bool((np.abs(verdict.action) <= 1.0).all()))
    return Treated(name, status, outside, strict and status != "fallback")


def two_threads(decisions: int) -> tuple[int, int, int]:
    """Answers with the other thread's barriers, answers refused, and all: one filter, two scenes, twice so many."""
    safe, near = _safe(), [FunctionBarrier(_h)]
    far = [FunctionBarrier(lambda x: 100.0 + _h(x))]
    expected = {id(scene): safe.decide(_STATE, nominal=_NOMINAL, barriers=scene) for scene in (near, far)}
    mixed, refused = [0, 0], [0, 0]

    def work(index: int, scene: list[FunctionBarrier]) -> None:
        wanted = expected[id(scene)]
        for _ in range(decisions):
            try:
                verdict = safe.decide(_STATE, nominal=_NOMINAL, barriers=scene)
            except Exception:  # noqa: BLE001 - an exception is one of two accepted answers
                refused[index] += 1
                continue
            if verdict.status.value == "fallback":
                refused[index] += 1
            elif verdict.status is not wanted.status or not np.allclose(verdict.action, wanted.action, atol=1e-9):
                mixed[index] += 1

    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        threads = [threading.Thread(target=work, args=each) for each in ((0, near), (1, far))]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(before)
    return sum(mixed), sum(refused), 2 * decisions


@final
class _NotBuiltError(Exception):
    """The filter refused to be built so."""


def _safe(
    affine: Callable[..., Any] = lambda x: (_f(x), _g(x)),
    barriers: Sequence[Any] | None = None,
    backup: Callable[..., Any] | None = None,
    **others: Any,
) -> SafetyFilter:
    settings = FilterSettings(action_low=(-1.0,), action_high=(1.0,), backup_action=(-1.0,), eta=0.1, epsilon=0.002)  # type: ignore[arg-type]
    scene = [FunctionBarrier(_h)] if barriers is None else barriers
    try:
        return SafetyFilter(affine, scene, settings, backup=backup, **others)
    except Exception as error:
        raise _NotBuiltError(str(error)) from error


def _ask(safe: SafetyFilter) -> Verdict:
    return safe.decide(_STATE, nominal=_NOMINAL)


def _writing(x: Any) -> Any:
    """Leaves a state behind that is far from the wall."""
    with suppress(ValueError):  # it is not to be written
        x[:] = (-100.0, 0.0)
    return 1.0


def _model_that_writes(x: Any) -> Any:
    motion = _f(x), _g(x)
    _writing(x)
    return motion


def _backup_that_writes(x: Any) -> Any:
    if x is not None:
        _writing(x)
    return [-1.0]


_WRITERS: Final[Mapping[str, tuple[Any, bool]]] = {
    "h before another": ({"barriers": [FunctionBarrier(_writing), FunctionBarrier(_h)]}, False),
    "gradient": (
        {"barriers": [FunctionBarrier(_writing, lambda x: (_writing(x), x * 0.0)[1]), FunctionBarrier(_h)]},
        False,
    ),
    "model": ({"affine": _model_that_writes}, False),
    "backup": ({"backup": _backup_that_writes}, False),
}
_SCENES: Final[Mapping[str, tuple[Any, bool]]] = {
    "none": ([], True),
    "of nothing": ([None], True),
    "text": ("wall", True),
    "a number": (5, True),
    "a function": ([_h], True),
    "one alone": (FunctionBarrier(_h), True),
    "a class": ([FunctionBarrier], True),
}
