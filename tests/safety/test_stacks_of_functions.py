"""Barriers side by side are those alone, one below the other; and the margins of each kind."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from safedpa.equations import Given
from safedpa.errors import InputError
from safedpa.operations import FLOATS
from safedpa.safety import AbstractBarrier, Barriers, FunctionBarrier
from safedpa.safety.barrier import RememberingStack
from safedpa.safety.margins_in_force import Margins
from safedpa.safety.search import DecisionError
from safedpa.safety.speed_barrier import SpeedBarrier

Values = NDArray[np.float64]
AT, G, WIDTHS = [0.3, -0.2, 0.9], [[0.5, 0.0], [0.1, -2.0], [1.0, 0.3]], [4.0, 0.25]


def bowl(kind: str, count: int, shift: float = 0.0) -> FunctionBarrier:
    """h_i = i - |x - shift|^2."""
    names = tuple(f"{kind} {row}" for row in range(count))
    return FunctionBarrier(
        lambda x: np.arange(count) - ((x - shift) ** 2).sum(),
        lambda x: np.tile(-2.0 * (x - shift), (count, 1)),
        names,
        kind,
    )


class Moving(AbstractBarrier):
    """Looks from where a tick began."""

    kind, names = "moving", ("moving",)

    def __init__(self, origin: float = 0.0) -> None:
        self.origin = origin

    def values(self, state: Values) -> Values:
        return np.array([self.origin + state.sum()])

    def evaluate(self, state: Values) -> tuple[Values, Values]:
        return self.values(state), np.ones((1, len(state)))

    def since(self, state: Values) -> Moving:
        return Moving(float(state[0]))


PARTS: dict[str, list[AbstractBarrier]] = {
    "one": [bowl("a", 2)],
    "three": [bowl("a", 2), bowl("b", 1, 0.5), bowl("a", 3, -0.1)],
    "of its own slopes": [Moving(), FunctionBarrier(lambda x: [x[0] ** 2, x[1]], names=("p", "q"))],
}


@pytest.mark.parametrize("name", PARTS)
def test_a_stack_is_its_parts(name: str) -> None:
    parts, x, g = PARTS[name], np.array(AT), np.array(G)
    stack, evaluated = Barriers(parts), [part.evaluate(x) for part in parts]
    h, gradient = (np.concatenate([pair[index] for pair in evaluated]) for index in (0, 1))
    rows = range(len(h))
    assert stack.names == tuple(name for part in parts for name in part.names)
    assert stack.kinds == tuple(part.kind for part in parts for _ in part.names)
    assert stack.rows == {kind: tuple(row for row in rows if stack.kinds[row] == kind) for kind in stack.kinds}
    assert stack.of_each({"a": 0.5}, 0.1) == [0.5 if kind == "a" else 0.1 for kind in stack.kinds]
    for whole in (stack, RememberingStack(stack)):
        np.testing.assert_array_equal(whole.values(x), h)
        np.testing.assert_allclose(whole.gradient(x), gradient, atol=1e-9)
        np.testing.assert_allclose(whole.along(AT, G, WIDTHS, rows), gradient @ g, atol=1e-6)
        np.testing.assert_allclose(whole.along(AT, G, WIDTHS, [len(h) - 1]), (gradient @ g)[-1:], atol=1e-6)
        assert whole.heights(AT) == h.tolist()
        assert whole.plain(3).heights(AT) == h.tolist()
        assert whole.plain(3) is whole.plain(3)
    for part, (_, slopes) in zip(parts, evaluated, strict=True):
        np.testing.assert_allclose(part.along(x, g), slopes @ g, atol=1e-6)


def test_a_range_over_which_a_slope_is_measured_is_the_actions_whole_one() -> None:
    """A function without a gradient is differenced over a thousandth of what all of the action's range moves."""
    seen: list[float] = []

    def h(x: Values) -> float:
        seen.append(float(x[0]))
        return float(x[0])

    Barriers([FunctionBarrier(h)]).along([1.0], [[2.0]], [5.0], [0])
    assert max(seen) - min(seen) == pytest.approx(2.0 * 1e-3 * 2.0 * 5.0)


def test_a_stack_looks_from_where_the_tick_began_if_any_part_does() -> None:
    fixed = Barriers([bowl("a", 2), bowl("b", 1)])
    assert fixed.since([3.0, 0.0, 0.0]) is fixed
    mixed = Barriers([bowl("a", 1), Moving(), bowl("b", 1)])
    for whole in (mixed, RememberingStack(mixed)):
        moved = whole.since([3.0, 0.0, 0.0])
        assert moved is not whole
        np.testing.assert_allclose(moved.values(np.ones(3)) - whole.values(np.ones(3)), [0.0, 3.0, 0.0])
    remembering = RememberingStack(fixed)
    assert remembering.since([3.0, 0.0, 0.0]) is remembering


def test_no_part_writes_into_what_the_next_one_sees_and_a_wrong_shape_is_named() -> None:
    class Writing(Moving):
        def values(self, state: Values) -> Values:
            state[0] = 7.0
            return state[:1]

    with pytest.raises(ValueError, match="read-only"):
        Barriers([Writing()]).heights(AT)
    with pytest.raises(InputError, match=r"h: got shape \(3,\), wanted \(1,\)"):
        Barriers([type("Wide", (Moving,), {"values": lambda self, state: state})()]).heights(AT)


@pytest.mark.parametrize("index", [None, 0, 2])
def test_a_speed_s_slope_is_one_over_its_own_entry(index: int | None) -> None:
    part, entry = SpeedBarrier(-1.0, 2.0, index), 3 if index is None else index
    assert part.reads == (("x", "y", "yaw", "speed") if index is None else ())
    state = [0.1, 0.2, 0.3, 0.4, 0.5]
    told = part.steepest(Given(state, part.shared, part.each[0], part.form), FLOATS)
    assert list(told) == [float(at == entry) for at in range(5)]
    np.testing.assert_array_equal(np.abs(part.evaluate(np.array(state[:4]))[1]), [told[:4]] * 2)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ([("a", 0.1)], "is no table by kind of barrier, but list"),
        (None, "is no table by kind of barrier, but NoneType"),
        ({"a": True}, "is not a finite number"),
        ({"a": "0.1"}, "is not a finite number"),
        ({"a": None}, "is not a finite number"),
        ({"aa": 0.1}, "for 'aa', which no barrier is: did you mean 'a'"),
        ({3: 0.1}, "for '3', which no barrier is: known: a, b"),
    ],
)
def test_margins_that_are_none_are_refused_with_the_reason(asked: Any, message: str) -> None:
    with pytest.raises(DecisionError, match=message):
        Margins({"a": 0.02}).of(Barriers([bowl("a", 1), bowl("b", 1)]), asked)


def test_without_a_margin_there_is_none() -> None:
    stack = Barriers([bowl("a", 1), bowl("b", 1)])
    assert Margins({"a": 0.02}).of(stack, {}) == ([0.02, 0.0], 0.02)
    assert Margins({"a": 0.02, "default": 0.01}).of(stack, {}) == ([0.02, 0.01], 0.02)
    for asked in ({"b": 2}, MappingProxyType({"b": 2})):
        assert Margins({}).of(stack, asked) == ([0.0, 2.0], 2.0)


def test_a_function_without_a_gradient_is_differenced_over_little_and_along_each_direction() -> None:
    part, at = FunctionBarrier(lambda x: x[0] ** 3 + x[1] * x[2]), np.array([0.5, 2.0, -1.0])
    slopes = np.array([0.75, -1.0, 2.0])
    np.testing.assert_allclose(part.along(at, np.eye(3)), [slopes], atol=1e-5)
    np.testing.assert_array_equal(part.along(at, np.zeros((3, 2))), np.zeros((1, 2)))


@pytest.mark.parametrize("later", [0, 1, 2, 3, 4])
def test_a_function_cannot_write_into_what_it_is_differenced_at(later: int) -> None:
    """Neither at the state, nor above and below of each entry."""
    asked = 0

    def h(x: Values) -> float:
        nonlocal asked
        asked += 1
        if asked == later + 1:
            x[0] = 9.0
        return float(x[0])

    with pytest.raises(ValueError, match="read-only"):
        FunctionBarrier(h).evaluate(np.array([1.0, 2.0]))
