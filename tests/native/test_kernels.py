"""Kernels in C give the results of NumPy, and a user's functions change them only where they are recorded again."""

import math
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from safedpa.equations import NotRecordableError
from safedpa.native.captured import Captured
from safedpa.native.step import StepKernel
from safedpa.native.tracing import record, why_not_recorded
from safedpa.operations import COMPLEX, NUMPY

if shutil.which("cc") is None:
    pytest.skip("no C compiler", allow_module_level=True)

NUMBERS = st.floats(allow_nan=True, allow_infinity=True, allow_subnormal=True)


def exact(x: Any, operations: Any) -> list[Any]:
    """Operations that IEEE 754 rounds correctly; a fused a * b + c would show."""
    (a, b, c), o = x, operations
    chosen = [o.minimum(a, b), o.maximum(a, b), o.clip(a, b, c), o.where(a < b, a, c), o.where(a >= c, b, 0.25)]
    root = [o.sqrt(a), o.absolute(a), o.sign(a), abs(b), -a, a**2, a != b]
    return [a + b, a - b, a * b, a * b + c, a / b, (a + b) * (a - c) / (b * b + c), 0.1 * a - 3.0, *root, *chosen]


def of_the_library(x: Any, operations: Any) -> list[Any]:
    a, o = x[0], operations
    return [o.sin(a), o.cos(a), o.tan(a), o.atan(a), o.tanh(a), o.exp(a), o.hypot(a, x[1])]


def kernel(function: Callable[..., Any], states: int = 3, actions: int = 0) -> StepKernel:
    def step(s: Any, a: Any, z: Any, t: Any, operations: Any) -> Any:
        return function([*s, *a], operations)

    return StepKernel.compiled(record(step, [("s", states), ("a", actions), ("z", 0), ("t", 1)]))


EXACT, LIBRARY = kernel(exact), kernel(of_the_library)


@given(st.tuples(NUMBERS, NUMBERS, NUMBERS))
@hypothesis_settings(max_examples=300, deadline=None)
def test_arithmetic_and_choices_are_numpys_to_the_last_bit(x: tuple[float, ...]) -> None:
    with np.errstate(all="ignore"):
        wanted = [float(each) for each in exact(np.array(x), NUMPY)]
    np.testing.assert_array_equal(EXACT.step(x, (), (), 0.0), wanted)


@given(st.tuples(NUMBERS, NUMBERS, NUMBERS))
@hypothesis_settings(max_examples=300, deadline=None)
def test_functions_of_the_c_library_are_those_of_math_and_close_to_numpys(x: tuple[float, ...]) -> None:
    found = LIBRARY.step(x, (), (), 0.0)
    with np.errstate(all="ignore"):
        np.testing.assert_array_max_ulp(np.array(found), np.array(of_the_library(np.array(x), NUMPY)), maxulp=4)
    if math.isfinite(x[0]) and x[0] < 700.0:
        same = [math.sin, math.cos, math.tan, math.atan, math.tanh, math.exp]
        assert found[:6] == [function(x[0]) for function in same]


@given(st.tuples(*[st.floats(-3.0, 3.0).filter(lambda value: abs(value) > 0.01)] * 3))
@hypothesis_settings(max_examples=100, deadline=None)
def test_slopes_in_the_action_are_those_of_complex_steps(x: tuple[float, ...]) -> None:
    def smooth(x: Any, operations: Any) -> list[Any]:
        (a, b, c), o = x, operations
        return [o.sin(a * b) * o.exp(-c * c), a / (1.0 + b**2) + o.tanh(c), o.atan(a) - o.sqrt(2.0 + o.cos(c * a))]

    _, slopes = kernel(smooth, 1, 2).tangent(x[:1], x[1:], (), 0.0)
    for column, entry in enumerate((1, 2)):
        nudged = [complex(value, 1e-30 * (place == entry)) for place, value in enumerate(x)]
        wanted = [each.imag / 1e-30 for each in smooth(nudged, COMPLEX)]
        np.testing.assert_allclose([row[column] for row in slopes], wanted, rtol=1e-12, atol=1e-14)


def test_threads_may_share_a_kernel() -> None:
    def run(seed: int) -> bool:
        points = np.random.default_rng(seed).normal(size=(2000, 3)).tolist()
        return all(EXACT.step(x, (), (), 0.0)[3] == x[0] * x[1] + x[2] for x in points)

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(run, range(4)))


def branching(x: Any, operations: Any) -> Any:
    if x[0] > 0.0:
        return [x[0]]
    return [operations.sin(x[0])]


def rounding(x: Any, operations: Any) -> Any:
    return [math.sin(x[0])]


@pytest.mark.parametrize(("function", "line"), [(branching, "if x[0] > 0.0:"), (rounding, "return [math.sin(x[0])]")])
def test_the_line_that_cannot_be_recorded_is_named(function: Callable[..., Any], line: str) -> None:
    with pytest.raises(NotRecordableError) as caught:
        record(function, [("x", 1)])
    assert "test_kernels.py line" in why_not_recorded(caught.value)
    assert line in why_not_recorded(caught.value)


def test_arrays_of_symbols_are_recorded_entry_by_entry() -> None:
    matrix = np.array([[0.0, 1.0, 2.0], [1.0, 0.5, 0.0]])

    def function(x: Any, operations: Any) -> Any:
        return operations.clip(matrix @ np.array(x), -1.0, [1.0, 2.0]) + np.sin(x[0])

    x = [0.3, 0.4, 0.9]
    np.testing.assert_allclose(kernel(function).step(x, (), (), 0.0), function(x, NUMPY), rtol=1e-15)


DISCS, FACTOR = [1.0, 2.0], 2.0


def reading(x: Any) -> Any:
    return [FACTOR * each * x for each in DISCS]


class Robot:
    mass = 1.0

    def __init__(self) -> None:
        self.drag = np.array([0.1, 0.2])

    def force(self, x: float) -> Any:
        return self.drag * x / self.mass


def test_whatever_a_function_reads_is_watched(monkeypatch: pytest.MonkeyPatch) -> None:
    robot, offset = Robot(), [0.5]
    cases: list[tuple[Callable[..., Any], Callable[[], None]]] = [
        (reading, lambda: DISCS.append(3.0)),
        (reading, lambda: monkeypatch.setitem(reading.__globals__, "FACTOR", 3.0)),
        (robot.force, lambda: robot.drag.__setitem__(0, 0.3)),
        (robot.force, lambda: setattr(robot, "drag", np.zeros(2))),
        (robot.force, lambda: monkeypatch.setattr(Robot, "mass", 2.0)),
        (lambda x: x + offset[0], lambda: offset.__setitem__(0, 0.6)),
    ]
    for function, change in cases:
        watched = Captured(function)
        assert watched.unchanged()
        assert not watched.impure
        change()
        assert not watched.unchanged()
    DISCS.pop()


def test_functions_that_write_or_read_files_are_recognised() -> None:
    count = [0]

    def counting(x: Any) -> Any:
        nonlocal count
        count = [1]
        return x

    def reading_a_file(x: Any) -> Any:
        return x + len(open("numbers").read())

    class Filter:
        def step(self, x: Any) -> Any:
            self.last = x
            return x

    for function, verb in ((counting, "writes"), (reading_a_file, "calls"), (Filter().step, "writes")):
        assert verb in Captured(function).impure
