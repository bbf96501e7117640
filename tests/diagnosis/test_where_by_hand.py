"""Bins, shares, biases and squares of the plane, of windows that are made one by one so that all can be worked out."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from safedpa.compare.where import Factor, cells, factors, place, window_errors, window_squares
from safedpa.compare.windows import Windows, windows_of
from safedpa.records.run import Run, Stretch
from safedpa.robots.pendulum.system import PENDULUM
from safedpa.systems import System, Variable

TOY = System(
    "toy",
    (
        Variable("x", "m", -math.inf, math.inf),
        Variable("y", "m", -math.inf, math.inf),
        Variable("yaw", "rad", -math.inf, math.inf, angle=True),
        Variable("speed", "m/s", -9.0, 9.0),
    ),
    (Variable("push", "N", -99.0, 99.0),),
)
X_ALONE = np.array([0.5, 0.0, 0.0, 0.0])
"""A scale on which x alone has changed."""


def blocks(count: int, name: str = "one", **rows: Any) -> Run:
    """One window each: stretches of five rows a quarter of a second apart, ten seconds from one to the next.

    ``rows``: of a state or the action, (blocks, 5) or what makes it; 0 where nothing is said.
    """
    t = 10.0 * np.arange(count)[:, None] + 0.25 * np.arange(5)
    columns = [
        np.broadcast_to(np.asarray(rows.get(own.name, 0.0), dtype=float), (count, 5)).reshape(-1)
        for own in (*TOY.state, *TOY.action)
    ]
    stretches = tuple(Stretch(5 * block, 5 * block + 5) for block in range(count))
    return Run(name, TOY, t.reshape(-1), np.stack(columns[:4], axis=1), np.stack(columns[4:], axis=1), stretches)


def windows(*runs: Run) -> Windows:
    found = windows_of(runs, 1.0, stride=1)
    assert set(found.steps.tolist()) == {4}
    return found


def middle(values: Any, elsewhere: float) -> Any:
    """Rows of blocks whose middle one has the value."""
    rows = np.full((len(values), 5), elsewhere)
    rows[:, 2] = values
    return rows


def in_x(values: Any) -> Any:
    errors = np.zeros((len(values), 4))
    errors[:, 0] = values
    return errors


def edges(factor: Factor) -> list[tuple[float, float, int]]:
    return [(own.low, own.high, own.samples) for own in factor.bins]


@pytest.fixture
def two_kinds() -> tuple[Windows, Any]:
    """Twenty windows that go and are pushed one way, then twenty of another; root errors 0 and 4, then 3."""
    first = np.arange(40)[:, None] < 20
    run = blocks(
        40,
        x=middle(np.where(first[:, 0], 0.5, 4.5), 9.0),
        yaw=middle(np.where(first[:, 0], 6.0 * math.pi + 0.1, -2.0 * math.pi - 0.1), 2.0),
        speed=np.where(first, [0.0, 0.0, 0.0, 0.0, 5.0], [1.0, 2.0, 3.0, 4.0, 5.0]),
        push=np.where(first, [2.0, 2.0, 2.0, 2.0, 99.0], [1.0, 3.0, 5.0, 7.0, -99.0]),
    )
    errors = in_x(0.5 * np.array([*[0.0] * 15, *[4.0] * 5, *[3.0] * 20]))
    errors[:20, 1] = np.arange(20.0)
    errors[20:, 1] = [*[-7.0] * 11, *[5.0] * 9]
    return windows(run), errors


def test_states_and_actions_count_where_their_mean_lies_angles_and_place_where_the_middle_does(two_kinds: Any) -> None:
    """Speed 1 and 3 with the last row, push 2 and 4 without it; bins of an eighth, those too small joined."""
    found = {item.variable: item for item in factors(*two_kinds, X_ALONE)}
    assert {name: (item.kind, item.unit) for name, item in found.items()} == {
        "x": ("place", "m"), "y": ("place", "m"), "yaw": ("state", "rad"), "speed": ("state", "m/s"),
        "push": ("action", "N"), "time": ("time", "s"),
    }  # fmt: skip
    assert edges(found["speed"]) == [(1.0, 1.25, 20), (1.25, 3.0, 20)]
    assert edges(found["push"]) == [(2.0, 2.25, 20), (2.25, 4.0, 20)]
    assert edges(found["x"]) == [(0.5, 1.0, 20), (1.0, 4.5, 20)]
    assert edges(found["y"]) == [(0.0, 1.0, 40)]
    assert edges(found["yaw"]) == [(-math.pi, 0.0, 20), (0.0, math.pi, 20)]
    assert edges(found["time"]) == [(0.0, 100.0, 10), (100.0, 200.0, 10), (200.0, 300.0, 10), (300.0, 400.0, 10)]
    assert {own.run for own in found["time"].bins} == {"one"}
    assert {own.run for own in found["speed"].bins} == {None}


def test_a_bin_tells_its_error_beside_that_of_all_its_share_and_the_median_of_each_state(two_kinds: Any) -> None:
    """Without the largest twentieth: of 20 one of 16, of 40 two. Squares 80 and 180 of 260."""
    low, high = next(item for item in factors(*two_kinds, X_ALONE) if item.variable == "speed").bins
    assert (low.variable, low.unit) == ("speed", "m/s")
    assert low.error == pytest.approx(8.0 / math.sqrt(19.0))
    assert high.error == pytest.approx(3.0)
    assert low.ratio == pytest.approx(8.0 / math.sqrt(19.0 * 6.0))
    assert high.ratio == pytest.approx(3.0 / math.sqrt(6.0))
    assert (low.share, high.share) == (pytest.approx(80.0 / 260.0), pytest.approx(180.0 / 260.0))
    assert low.bias == {"x": 0.0, "y": 9.5, "yaw": 0.0, "speed": 0.0}
    assert high.bias == {"x": 1.5, "y": -7.0, "yaw": 0.0, "speed": 0.0}
    back = next(item for item in factors(*two_kinds, X_ALONE) if item.variable == "yaw").bins
    assert [own.bias["y"] for own in back] == [-7.0, 9.5]


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_what_explains_most_comes_first(two_kinds: Any, size: float) -> None:
    """Roots 0, 4 and 3 about 2: 100; within both kinds 60, within the four bins of time 40."""
    found = factors(two_kinds[0], size * two_kinds[1], X_ALONE)
    explained = {item.variable: item.explained for item in found}
    two = 1.0 - 39.0 / 38.0 * 0.6
    wanted = {"time": 1.0 - 39.0 / 36.0 * 0.4, "x": two, "yaw": two, "speed": two, "push": two, "y": 0.0}
    assert explained == pytest.approx(wanted, abs=1e-12)
    assert [found[0].variable, found[-1].variable] == ["time", "y"]
    assert next(item for item in found if item.variable == "speed").bins[0].ratio == pytest.approx(8 / math.sqrt(114))


def test_without_errors_nothing_is_explained_and_no_bin_has_a_share(two_kinds: Any) -> None:
    for item in factors(two_kinds[0], np.zeros((40, 4)), X_ALONE):
        assert item.explained == 0.0
        assert [(own.error, own.share) for own in item.bins] == [(0.0, 0.0)] * len(item.bins)
        assert all(math.isnan(own.ratio) for own in item.bins)


def test_where_nothing_ever_changed_no_error_is_told(two_kinds: Any) -> None:
    for item in factors(*two_kinds, np.zeros(4)):
        assert item.explained == 0.0
        assert all(math.isnan(own.error) and math.isnan(own.ratio) and own.share == 0.0 for own in item.bins)


def test_time_is_that_of_each_run_with_windows_by_itself() -> None:
    short = replace(blocks(1, "short"), stretches=(Stretch(0, 3),))
    found = windows(blocks(20, "first"), short, blocks(40, "last"))
    errors = in_x([*[2.0] * 10, *[0.0] * 10, *[1.0] * 40])
    (time,) = (item for item in factors(found, errors, X_ALONE) if item.variable == "time")
    assert [(own.run, own.low, own.high, own.samples) for own in time.bins] == [
        ("first", 0.0, 100.0, 10), ("first", 100.0, 200.0, 10),
        *(("last", low, low + 100.0, 10) for low in (0.0, 100.0, 200.0, 300.0)),
    ]  # fmt: skip
    assert [own.error for own in time.bins] == [4.0, 0.0, 2.0, 2.0, 2.0, 2.0]
    assert time.explained == 1.0


def test_as_many_bins_as_windows_explain_nothing() -> None:
    found = windows(*(blocks(1, name) for name in ("one", "two", "three")))
    (time,) = (item for item in factors(found, in_x([1.0, 2.0, 3.0]), X_ALONE) if item.variable == "time")
    assert (time.explained, len(time.bins)) == (0.0, 3)


def test_of_many_windows_a_bin_has_a_hundredth() -> None:
    """Of 1200: twelve are enough, eleven are not; the largest value is one of the last bin."""
    speed = np.array([*[0.0] * 12, *[1.0] * 11, *[2.0] * 1177])[:, None]
    found = factors(windows(blocks(1200, speed=speed)), np.ones((1200, 4)), X_ALONE)
    assert edges(next(item for item in found if item.variable == "speed")) == [(0.0, 0.25, 12), (0.25, 2.0, 1188)]


@pytest.mark.parametrize(("few", "wanted"), [(10, [(0.0, 0.25, 10), (0.25, 2.0, 30)]), (9, [(0.0, 2.0, 40)])])
def test_ten_windows_are_a_bin_and_nine_are_none(few: int, wanted: list[tuple[float, float, int]]) -> None:
    speed = np.array([*[0.0] * few, *[2.0] * (40 - few)])[:, None]
    found = factors(windows(blocks(40, speed=speed)), np.ones((40, 4)), X_ALONE)
    assert edges(next(item for item in found if item.variable == "speed")) == wanted


def test_a_glitch_counts_as_the_square_below_which_nineteen_of_twenty_lie() -> None:
    """2 on a scale of 2 and 1 on one of a half: (1 + 4) / 2; what has no scale does not count."""
    errors = np.tile([2.0, -1.0, 7.0], (21, 1))
    errors[4, 0] = 200.0
    assert window_squares(errors, np.array([2.0, 0.5, 0.0])).tolist() == [2.5] * 21
    errors[5, 0] = -200.0
    squares = window_squares(errors, np.array([2.0, 0.5, 0.0]))
    assert squares[4:6].tolist() == [5002.0, 5002.0], "two of twenty-one are no glitch"


@pytest.mark.parametrize(("largest", "counted"), [(3.0, 9.0), (0.3, 1.0), (1.25, 1.5625)])
def test_what_is_no_number_counts_as_the_largest_and_as_one_at_least(largest: float, counted: float) -> None:
    """Also what is so large that its square would be none."""
    wrong = [math.nan, math.inf, -math.inf, 1e100, 1e200, -1e300]
    errors = np.array([*[0.1] * 30, *[largest] * 4, *wrong])[:, None]
    squares = window_squares(errors, np.ones(1))
    assert squares[-6:].tolist() == [counted] * 6
    assert squares[:34] == pytest.approx([0.01] * 30 + [largest**2] * 4)


def test_where_no_state_changed_no_window_has_an_error() -> None:
    errors = np.ones((3, 2))
    assert window_squares(errors, np.zeros(2)).tolist() == [0.0] * 3
    assert window_errors(errors, np.zeros(2)).tolist() == [0.0] * 3


def test_a_windows_error_is_the_root_of_the_mean_square_and_nothing_is_cut() -> None:
    errors = np.array([[3.0, 2.0, 7.0], [-300.0, 0.0, 0.0], *([[0.75, 0.25, 1.0]] * 30), [0.75, math.nan, 0.0],
                       [1e100, 0.0, 0.0], [-1e200, 0.0, 0.0]])  # fmt: skip
    found = window_errors(errors, np.array([1.5, 0.5, 0.0]))
    assert found[:3] == pytest.approx([math.sqrt(10.0), 200.0 / math.sqrt(2.0), 0.5])
    assert found[-3:].tolist() == [math.inf] * 3


@pytest.fixture
def in_the_plane() -> tuple[Windows, Any]:
    """Four windows at (12.5, -13), three at (41.5, -13), two at (41.5, -3): 29 m are 14 squares of 2.5 m at most."""
    run = blocks(
        9,
        x=middle([*[12.5] * 4, *[41.5] * 5], 99.0),
        y=middle([*[-13.0] * 7, *[-3.0] * 2], -99.0),
    )
    return windows(run), in_x([*[0.25] * 4, *[1.0] * 3, *[0.0] * 2])


def test_the_middle_of_a_window_is_where_it_lies(in_the_plane: Any) -> None:
    x, y = place(in_the_plane[0])
    assert x.tolist() == [12.5] * 4 + [41.5] * 5
    assert y.tolist() == [-13.0] * 7 + [-3.0] * 2


def test_squares_of_one_round_width_with_three_windows_at_least_the_worst_first(in_the_plane: Any) -> None:
    """Squared errors 4 of a quarter and 3 of 4: 13 in all."""
    worst, other = cells(*in_the_plane, X_ALONE)
    assert (worst.x_low, worst.x_high, worst.y_low, worst.y_high) == (40.0, 42.5, -15.0, -12.5)
    assert (other.x_low, other.x_high, other.y_low, other.y_high) == (12.5, 15.0, -15.0, -12.5)
    assert (worst.samples, other.samples) == (3, 4)
    assert (worst.error, other.error) == (2.0, 0.5)
    assert (worst.share, other.share) == (pytest.approx(12.0 / 13.0), pytest.approx(1.0 / 13.0))


def test_of_how_few_windows_a_square_is_told_can_be_said(in_the_plane: Any) -> None:
    assert [own.samples for own in cells(*in_the_plane, X_ALONE, 2)] == [3, 4, 2]
    assert [own.samples for own in cells(*in_the_plane, X_ALONE, 4)] == [4]
    assert cells(*in_the_plane, X_ALONE, 5) == ()


def test_squares_without_errors_have_no_share(in_the_plane: Any) -> None:
    found = cells(in_the_plane[0], np.zeros((9, 4)), X_ALONE)
    assert [(own.error, own.share) for own in found] == [(0.0, 0.0)] * 2


def test_what_stays_at_one_place_is_in_one_square_of_a_metre() -> None:
    run = blocks(3, x=0.25, y=-1.75)
    (found,) = cells(windows(run), np.ones((3, 4)), X_ALONE)
    assert (found.x_low, found.x_high, found.y_low, found.y_high, found.samples) == (0.0, 1.0, -2.0, -1.0, 3)


@pytest.mark.parametrize("names", [("angle", "rate"), ("x", "rate"), ("angle", "y")])
def test_what_has_no_place_has_no_squares(names: tuple[str, str]) -> None:
    state = tuple(replace(own, name=name) for own, name in zip(PENDULUM.state, names, strict=True))
    run = Run("one", replace(PENDULUM, state=state), np.arange(20.0), np.ones((20, 2)), np.ones((20, 1)),
              (Stretch(0, 20),))  # fmt: skip
    found = windows_of([run], 1.0, stride=1)
    assert cells(found, np.ones((len(found), 2)), np.ones(2)) == ()
