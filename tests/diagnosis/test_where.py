"""Where errors are: factors, bins, places, runs and states; and which rows a comparison looks at."""

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.comparison.comparison import compare_model, residuals
from safedpa.comparison.excerpt import without_duplicates
from safedpa.comparison.rollout import predict_run
from safedpa.comparison.summary import (
    as_json,
    most_influential_factor,
    run_sentence,
    state_sentence,
    where_sentence,
    worse_sentence,
)
from safedpa.comparison.where import (
    angle_edges,
    cells,
    factors,
    merge_small_bins,
    round_edges,
    window_errors,
    window_positions,
    window_squares,
)
from safedpa.comparison.windows import windows_of
from safedpa.diagnosis.diagnose import diagnose
from safedpa.effects import effect
from safedpa.records.run import Run, Stretch
from safedpa.robots.pendulum.system import PENDULUM
from safedpa.systems import System, Variable
from safedpa_lab.hidden import Case, write_case
from safedpa_services.command_line.group import safedpa

TOY = System(
    "toy",
    (
        Variable("x", "m", -math.inf, math.inf), Variable("y", "m", -math.inf, math.inf),
        Variable("yaw", "rad", -math.inf, math.inf, angle=True), Variable("speed", "m/s", -9.0, 9.0),
    ),
    (Variable("push", "N", -99.0, 99.0),),
)  # fmt: skip
X_ALONE = np.array([0.5, 0.0, 0.0, 0.0])
"""A scale on which x alone has changed."""


def _compared(plain, drive, truth, seconds=120.0):
    return compare_model(plain, [drive(truth, seconds, seed=7), drive(truth, seconds, seed=8)])


def _factor(comparison, name):
    return next(item for item in comparison.factors if item.variable == name)


def test_hidden_drag_is_worst_at_the_fastest_speed(plain, with_effect, drive):
    comparison = _compared(plain, drive, with_effect(plain, "quadratic_drag", coefficient=0.3))
    factor = most_influential_factor(comparison)
    assert factor.variable == "speed"
    fastest = max((item for item in factor.bins), key=lambda item: abs(item.low + item.high))
    assert max(factor.bins, key=lambda item: item.error) == fastest
    assert fastest.ratio > 2.0
    # drag slows down what the model thinks runs on
    assert fastest.bias["speed"] * (fastest.low + fastest.high) > 0
    assert "The state predicted worst is speed" in state_sentence(comparison)
    assert f"speed {fastest.low:.3g} to {fastest.high:.3g} m/s" in where_sentence(comparison)


def test_hidden_steering_asymmetry_biases_both_sides_in_one_direction_but_not_straight_driving(
    plain, with_effect, drive
):
    comparison = _compared(plain, drive, with_effect(plain, "steering_asymmetry", difference=0.5))
    bins = _factor(comparison, "steer").bins
    straight = min(bins, key=lambda item: abs(item.low + item.high))
    for outer in (bins[0], bins[-1]):
        assert outer.bias["yaw"] < -0.3
        assert outer.error > 1.3 * straight.error
        assert abs(outer.bias["yaw"]) > 1.3 * abs(straight.bias["yaw"])
    physical = {item.variable: item.explained for item in comparison.factors if item.kind in ("state", "action")}
    assert max(physical, key=physical.__getitem__) in ("steer", "speed")


def test_hidden_steering_offset_biases_every_bin_of_steer_to_one_side(plain, with_effect, drive):
    comparison = _compared(plain, drive, with_effect(plain, "steering_offset", angle=0.1))
    assert "The state predicted worst is yaw" in state_sentence(comparison)
    assert "rad too low)" in state_sentence(comparison)
    for item in _factor(comparison, "steer").bins:
        assert item.bias["yaw"] < -0.1
    assert max(abs(item.bias["speed"]) for item in _factor(comparison, "steer").bins) < 1e-9


def test_an_error_at_one_time_is_attributed_to_time(plain, with_effect, drive):
    """Something that happened once: for ten seconds the throttle did nothing."""
    run = drive(plain, 120.0, seed=1)
    actions = run.actions.copy()
    actions[1000:1200, 0] = np.random.default_rng(0).uniform(-1, 1, 200)
    actions[1000:1200, 1] += 0.3
    comparison = compare_model(plain, [type(run)("faulty", run.system, run.t, run.states, actions, run.stretches)])
    assert most_influential_factor(comparison).variable == "time"
    assert "of faulty" in where_sentence(comparison)
    worst = max(most_influential_factor(comparison).bins, key=lambda item: item.error)
    assert worst.low <= 60.0 and worst.high >= 50.0  # noqa: PT018


def test_an_exact_model_is_called_exact(plain, drive):
    comparison = _compared(plain, drive, plain, 20.0)
    assert comparison.error.value < 1e-9
    assert where_sentence(comparison) == "The model predicts these runs exactly."


def test_noise_alone_gives_a_similar_error_everywhere(plain, drive):
    run = drive(plain, 200.0, seed=3)
    noise = np.random.default_rng(0).normal(size=run.states.shape) * 0.3
    noisy = type(run)("noisy", run.system, run.t, run.states + noise, run.actions, run.stretches)
    assert "similar everywhere" in where_sentence(compare_model(plain, [noisy]))


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.floats(-1e3, 1e3, allow_nan=False), min_size=1, max_size=200), st.integers(1, 12), st.integers(1, 30)
)
def test_bin_edges_are_round_ordered_and_include_all_values(numbers, most, smallest):
    values = np.array(numbers)
    edges = round_edges(values, most)
    assert (np.diff(edges) > 0).all()
    assert edges[0] <= values.min()
    assert values.max() <= edges[-1] or np.isclose(values.max(), edges[-1])
    assert len(edges) <= most + 2
    joined = merge_small_bins(values, edges, smallest)
    counts = np.histogram(values, joined)[0]
    assert len(joined) == 2 or (counts >= smallest).all()


def blocks(count, name="one", **rows):
    """One window each: stretches of five rows a quarter of a second apart, ten seconds from one to the next.

    ``rows``: of a state or the action, (blocks, 5) or what makes it; 0 by default.
    """
    t = 10.0 * np.arange(count)[:, None] + 0.25 * np.arange(5)
    columns = [
        np.broadcast_to(np.asarray(rows.get(own.name, 0.0), dtype=float), (count, 5)).reshape(-1)
        for own in (*TOY.state, *TOY.action)
    ]
    stretches = tuple(Stretch(5 * block, 5 * block + 5) for block in range(count))
    return Run(name, TOY, t.reshape(-1), np.stack(columns[:4], axis=1), np.stack(columns[4:], axis=1), stretches)


def windows(*runs):
    return windows_of(runs, 1.0, stride=1)


def middle(values, elsewhere):
    """Rows of blocks whose middle one has the value."""
    rows = np.full((len(values), 5), elsewhere)
    rows[:, 2] = values
    return rows


def in_x(values):
    return np.stack([np.asarray(values, dtype=float), *np.zeros((3, len(values)))], axis=1)


def edges_of(factor):
    return [(own.low, own.high, own.samples) for own in factor.bins]


@pytest.fixture
def two_kinds() -> tuple[Any, Any]:
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


def test_a_window_is_binned_by_its_mean_or_for_angles_position_and_time_by_its_middle(two_kinds):
    """Speed 1 and 3 with the last row, push 2 and 4 without it; bins of an eighth, those too small joined."""
    found = {item.variable: item for item in factors(*two_kinds, X_ALONE)}
    assert {name: (item.kind, item.unit, edges_of(item)) for name, item in found.items()} == {
        "x": ("position", "m", [(0.5, 1.0, 20), (1.0, 4.5, 20)]), "y": ("position", "m", [(0.0, 1.0, 40)]),
        "yaw": ("state", "rad", [(-math.pi, 0.0, 20), (0.0, math.pi, 20)]),
        "speed": ("state", "m/s", [(1.0, 1.25, 20), (1.25, 3.0, 20)]),
        "push": ("action", "N", [(2.0, 2.25, 20), (2.25, 4.0, 20)]),
        "time": ("time", "s", [(low, low + 100.0, 10) for low in (0.0, 100.0, 200.0, 300.0)]),
    }  # fmt: skip
    assert {own.run for own in found["time"].bins} == {"one"}
    assert {own.run for own in found["speed"].bins} == {None}


def test_a_bin_has_its_error_ratio_share_and_median_error_of_each_state(two_kinds):
    """Without the largest twentieth: of 20 one of 16, of 40 two. Squares 80 and 180 of 260."""
    found = {item.variable: item.bins for item in factors(*two_kinds, X_ALONE)}
    low, high = found["speed"]
    assert [low.error, high.error] == pytest.approx([8.0 / math.sqrt(19.0), 3.0])
    assert [low.ratio, high.ratio] == pytest.approx([8.0 / math.sqrt(19.0 * 6.0), 3.0 / math.sqrt(6.0)])
    assert [low.share, high.share] == pytest.approx([80.0 / 260.0, 180.0 / 260.0])
    assert low.bias == {"x": 0.0, "y": 9.5, "yaw": 0.0, "speed": 0.0}
    assert high.bias == {"x": 1.5, "y": -7.0, "yaw": 0.0, "speed": 0.0}
    assert [own.bias["y"] for own in found["yaw"]] == [-7.0, 9.5]


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_factors_are_sorted_by_the_adjusted_share_of_variance_that_they_explain(two_kinds, size):
    """Roots 0, 4 and 3 about 2: 100; within both kinds 60, within the four bins of time 40."""
    found = factors(two_kinds[0], size * two_kinds[1], X_ALONE)
    two = 1.0 - 39.0 / 38.0 * 0.6
    wanted = {"time": 1.0 - 39.0 / 36.0 * 0.4, "x": two, "yaw": two, "speed": two, "push": two, "y": 0.0}
    assert {item.variable: item.explained for item in found} == pytest.approx(wanted, abs=1e-12)
    assert [found[0].variable, found[-1].variable] == ["time", "y"]


def test_without_errors_or_without_change_nothing_is_explained(two_kinds):
    for item in factors(two_kinds[0], np.zeros((40, 4)), X_ALONE):
        assert item.explained == 0.0
        assert [(own.error, own.share) for own in item.bins] == [(0.0, 0.0)] * len(item.bins)
        assert all(math.isnan(own.ratio) for own in item.bins)
    for item in factors(*two_kinds, np.zeros(4)):
        assert item.explained == 0.0
        assert all(math.isnan(own.error) and math.isnan(own.ratio) and own.share == 0.0 for own in item.bins)


def test_time_is_binned_for_each_run_with_windows_by_itself():
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
    few = windows(*(blocks(1, name) for name in ("one", "two", "three")))
    (time,) = (item for item in factors(few, in_x([1.0, 2.0, 3.0]), X_ALONE) if item.variable == "time")
    assert (time.explained, len(time.bins)) == (0.0, 3), "as many bins as windows explain nothing"


@pytest.mark.parametrize(
    ("counts", "wanted"),
    [
        ((12, 11, 1177), [(0.0, 0.25, 12), (0.25, 2.0, 1188)]),  # a hundredth of 1200 is enough, 11 are not
        ((10, 0, 30), [(0.0, 0.25, 10), (0.25, 2.0, 30)]), ((9, 0, 31), [(0.0, 2.0, 40)]),
    ],
)  # fmt: skip
def test_a_bin_has_ten_windows_and_a_hundredth_of_all_at_least(counts, wanted):
    speed = np.repeat([0.0, 1.0, 2.0], counts)[:, None]
    found = factors(windows(blocks(sum(counts), speed=speed)), np.ones((sum(counts), 4)), X_ALONE)
    assert edges_of(next(item for item in found if item.variable == "speed")) == wanted


def test_squares_are_capped_at_their_95_percent_quantile():
    """2 on a scale of 2 and 1 on one of a half: (1 + 4) / 2; a state without scale does not count."""
    errors, scale = np.tile([2.0, -1.0, 7.0], (21, 1)), np.array([2.0, 0.5, 0.0])
    errors[4, 0] = 200.0
    assert window_squares(errors, scale).tolist() == [2.5] * 21
    errors[5, 0] = -200.0
    assert window_squares(errors, scale)[4:6].tolist() == [5002.0, 5002.0], "two of twenty-one are no glitch"
    assert window_squares(errors, np.zeros(3)).tolist() == [0.0] * 21
    assert window_errors(errors, np.zeros(3)).tolist() == [0.0] * 21


@pytest.mark.parametrize(("largest", "counted"), [(3.0, 9.0), (0.3, 1.0), (1.25, 1.5625)])
def test_an_infinite_or_missing_error_counts_as_the_largest_but_at_least_one(largest, counted):
    wrong = [math.nan, math.inf, -math.inf, 1e100, 1e200, -1e300]
    errors = np.array([*[0.1] * 30, *[largest] * 4, *wrong])[:, None]
    assert window_squares(errors, np.ones(1)) == pytest.approx([0.01] * 30 + [largest**2] * 4 + [counted] * 6)


def test_the_error_of_a_window_is_the_root_of_its_mean_square_without_a_cap():
    errors = np.array([[3.0, 2.0, 7.0], [-300.0, 0.0, 0.0], *([[0.75, 0.25, 1.0]] * 30), [0.75, math.nan, 0.0],
                       [1e100, 0.0, 0.0], [-1e200, 0.0, 0.0]])  # fmt: skip
    found = window_errors(errors, np.array([1.5, 0.5, 0.0]))
    assert found[:3] == pytest.approx([math.sqrt(10.0), 200.0 / math.sqrt(2.0), 0.5])
    assert found[-3:].tolist() == [math.inf] * 3


def test_the_plane_is_cut_into_squares_of_one_round_width_the_worst_first():
    """Four windows at (12.5, -13), three at (41.5, -13), two at (41.5, -3): 29 m are 14 squares of 2.5 m at most.

    Squared errors: 4 of a quarter and 3 of 4, 13 in all.
    """
    x, y = middle([*[12.5] * 4, *[41.5] * 5], 99.0), middle([*[-13.0] * 7, *[-3.0] * 2], -99.0)
    made, errors = windows(blocks(9, x=x, y=y)), in_x([*[0.25] * 4, *[1.0] * 3, *[0.0] * 2])
    assert [column.tolist() for column in window_positions(made)] == [x[:, 2].tolist(), y[:, 2].tolist()]
    found = [tuple(vars(own).values()) for own in cells(made, errors, X_ALONE)]
    assert found == [
        (40.0, 42.5, -15.0, -12.5, 2.0, pytest.approx(12.0 / 13.0), 3),
        (12.5, 15.0, -15.0, -12.5, 0.5, pytest.approx(1.0 / 13.0), 4),
    ]
    for fewest, samples in ((2, [3, 4, 2]), (4, [4]), (5, [])):
        assert [own.samples for own in cells(made, errors, X_ALONE, fewest)] == samples
    assert [(own.error, own.share) for own in cells(made, np.zeros((9, 4)), X_ALONE)] == [(0.0, 0.0)] * 2
    (one,) = cells(windows(blocks(3, x=0.25, y=-1.75)), np.ones((3, 4)), X_ALONE)
    assert (one.x_low, one.x_high, one.y_low, one.y_high, one.samples) == (0.0, 1.0, -2.0, -1.0, 3)


@pytest.mark.parametrize("names", [("angle", "rate"), ("x", "rate"), ("angle", "y")])
def test_a_system_without_a_position_has_no_squares(names):
    state = tuple(replace(own, name=name) for own, name in zip(PENDULUM.state, names, strict=True))
    system = replace(PENDULUM, state=state)
    run = Run("one", system, np.arange(20.0), np.ones((20, 2)), np.ones((20, 1)), (Stretch(0, 20),))
    found = windows_of([run], 1.0, stride=1)
    assert cells(found, np.ones((len(found), 2)), np.ones(2)) == ()


def round_table(*bins):
    """``bins``: (low, high, how many values evenly between)."""
    return np.concatenate([np.linspace(low, high, count) for low, high, count in bins])


@pytest.mark.parametrize(
    ("low", "high", "width"),
    [
        (0.0, 8.0, 1.0), (0.0, 8.08, 2.0), (0.0, 16.0, 2.0), (0.0, 16.2, 2.5), (0.0, 20.0, 2.5), (0.0, 20.3, 5.0),
        (0.0, 40.0, 5.0), (0.0, 40.5, 10.0), (0.0, 80.0, 10.0), (0.0, 0.8, 0.1), (-4.0, 4.0, 1.0), (0.0, 800.0, 100.0),
        (0.0, 8e-6, 1e-6),
    ],
)  # fmt: skip
def test_bin_width_is_the_smallest_round_one_with_which_eight_bins_cover_the_range(low, high, width):
    edges = round_edges(round_table((low, low, 50), (low, high, 200), (high, high, 50)))
    assert np.diff(edges) == pytest.approx(np.full(len(edges) - 1, width))
    assert edges[0] == pytest.approx(width * math.floor(low / width + 1e-9), abs=1e-12)
    assert edges[-1] == pytest.approx(width * math.ceil(high / width - 1e-9), abs=1e-12)


TEN = round_table((0.0, 0.0, 50), (0.0, 10.0, 200), (10.0, 10.0, 50))


@pytest.mark.parametrize(
    ("values", "most", "wanted"),
    [
        (TEN, 2, [0.0, 5.0, 10.0]), (TEN, 4, [0.0, 2.5, 5.0, 7.5, 10.0]),
        (round_table((0, 0, 500), (0, 8, 2000), (8, 8, 500), (-7.4, 93.2, 2)), 8, [-8.0, *range(1, 8), 94.0]),
        (round_table((0, 0, 500), (0, 20, 2000), (20, 20, 500), (-7.4, 93.2, 2)), 8,
         [-7.5, *np.arange(2.5, 20.0, 2.5), 95.0]),
        (np.full(30, 0.3), 8, [0.0, 1.0]), (np.full(30, -0.3), 8, [-1.0, 0.0]), (np.full(30, 2.0), 8, [2.0, 3.0]),
    ],
)  # fmt: skip
def test_outliers_move_the_outer_edges_alone_and_one_value_has_one_bin(values, most, wanted):
    assert round_edges(values, most=most).tolist() == wanted


@pytest.mark.parametrize(("outliers", "width"), [((4, 80.0), 1.0), ((8, 80.0), 10.0), ((8, -72.0), 10.0)])
def test_the_middle_99_percent_decide_the_width(outliers, width):
    edges = round_edges(np.concatenate([np.linspace(0.0, 8.0, 1001), np.full(*outliers)]))
    assert np.diff(edges)[len(edges) // 2 - 1] == width


def test_angles_are_binned_in_sectors_of_one_turn():
    assert angle_edges() == pytest.approx([math.pi * part / 4.0 for part in range(-4, 5)])
    assert angle_edges(2) == pytest.approx([-math.pi, 0.0, math.pi])


@pytest.mark.parametrize(
    ("smallest", "wanted"),
    [(1, [0, 1, 2, 3, 4]), (2, [0, 2, 3, 4]), (3, [0, 2, 4]), (4, [0, 4]), (7, [0, 4]), (9, [0, 4])],
)
def test_a_bin_with_too_few_values_joins_its_right_neighbour_and_the_last_its_left_one(smallest, wanted):
    """One, two, two and two values in bins of width 1."""
    assert merge_small_bins(np.array([0.5, 1.2, 1.4, 2.2, 2.4, 3.2, 3.4]), np.arange(5.0), smallest).tolist() == wanted


def test_each_part_of_the_horizon_has_the_change_of_its_own_time(plain: Any, drive: Any) -> None:
    """The scale is the spread of x(t + h) - x(t) over all starts."""
    run = drive(plain, 30.0)
    found = compare_model(plain, [run], 1.0)
    assert [part.seconds for part in found.horizons] == pytest.approx(np.arange(1, 11) / 10.0)
    for part in found.horizons:
        rows = round(part.seconds / 0.05)
        starts = np.arange(0, len(run.t) - 20, 2)
        speed = run.states[starts + rows, 3] - run.states[starts, 3]
        assert part.errors["no_change"].scale[3] == pytest.approx(speed.std(), rel=1e-6)
        assert part.errors["model"].value == pytest.approx(0.0, abs=1e-9)
        assert min(part.errors[name].value for name in ("no_change", "constant_velocity")) > 0.1


@pytest.mark.parametrize("odd", range(3))
def test_the_error_of_a_run_is_that_of_its_own_windows(plain: Any, drive: Any, with_effect: Any, odd: int) -> None:
    """One of three runs is driven by another car: it alone has an error."""
    other = with_effect(plain, "viscous_drag", coefficient=0.4)
    runs = [drive(other if n == odd else plain, 8.0, n, name=f"run {n}") for n in range(3)]
    found = compare_model(plain, runs, 1.0)
    assert [run.name for run in found.runs] == ["run 0", "run 1", "run 2"]
    assert [run.error > 0.01 for run in found.runs] == [n == odd for n in range(3)]
    assert [run.rows for run in found.runs] == [160] * 3


@pytest.mark.parametrize(("parts", "near"), [((0.1, 0.2, 0.5, 1.0), 1), ((0.25, 0.5, 1.0), 0)])
def test_rates_are_those_of_the_rows_nearest_to_0_2_s(plain: Any, drive: Any, parts: Any, near: int) -> None:
    """(measured - predicted) by the time between: 0.3 m/s in 0.2 s are 1.5 m/s2."""
    windows = windows_of([drive(plain, 10.0)], 1.0)
    rows = [windows.rows_after(seconds) for seconds in parts]
    predicted = np.stack([windows.states[at] for at in rows])
    predicted[..., 3] += np.where(np.arange(len(parts)) == near, -0.3, 7.0)[:, None]
    found = residuals(windows, rows, predicted)
    assert found.seconds == pytest.approx(parts[near])
    assert found.rates[:, 3] == pytest.approx(0.3 / parts[near])
    np.testing.assert_array_equal(found.values[:, :4], windows.states[windows.start])
    np.testing.assert_array_equal(found.values[:, 4:], windows.actions[windows.start])


def test_a_table_of_predictions_has_a_row_for_each_measured_one_up_to_the_horizon(plain: Any, drive: Any) -> None:
    """0.3 s at 20 Hz, from every eighth trusted row: six rows each, but for the last, after which its stretch ends."""
    run = drive(plain, 2.0, stretches=[(0, 25), (28, 40)])
    spans = ((0, 6), (8, 14), (16, 22), (35, 39))
    expected = [(start, row) for start, last in spans for row in range(start + 1, last + 1)]
    found = predict_run(plain, run, 0.3, stride=8)
    assert set(found) == {"start_t", "t", "x", "y", "yaw", "speed"}
    starts, rows = (np.array(column) for column in zip(*expected, strict=True))
    np.testing.assert_allclose(found["start_t"], run.t[starts])
    np.testing.assert_allclose(found["t"], run.t[rows])
    for index, name in enumerate(run.system.state_names):
        np.testing.assert_allclose(found[name], run.states[rows, index], atol=1e-9)
    assert np.abs(run.states[rows] - run.states[rows - 1]).max(axis=1).min() > 1e-3, "a row late would show"


@pytest.mark.parametrize("most", [100, 1000])
def test_windows_of_long_logs_start_farther_apart_and_a_finding_says_so(plain, drive, most, monkeypatch):
    """Three runs of ten seconds: a hundred windows lie 0.3 s apart; a thousand would be nearer than requested."""
    monkeypatch.setattr("safedpa.comparison.comparison.MOST_WINDOWS", most)
    found = compare_model(plain, [drive(plain, 10.0, seed, name=f"run {seed}") for seed in range(3)], 1.0)
    apart = np.diff(found.windows.t[found.windows.start])
    assert np.median(apart) == pytest.approx(0.3 if most == 100 else 0.1)
    received = [finding.message for name, finding in found.findings if finding.kind == "thinned"]
    assert len(received) == (most == 100)
    assert all("start every 0.29" in text and "instead of every 0.1 s" in text for text in received)


@pytest.mark.parametrize(
    ("rows", "shared", "copy"), [(40, 40, True), (40, 21, True), (40, 20, False), (19, 19, False), (20, 20, True)]
)
def test_a_recording_of_20_rows_is_a_copy_if_more_than_half_of_them_are_in_another(plain, drive, rows, shared, copy):
    whole, other = drive(plain, 10.0, 1, name="whole"), drive(plain, 10.0, 2, name="other")
    states = np.concatenate([whole.states[50 : 50 + shared], other.states[: rows - shared]])
    actions = np.concatenate([whole.actions[50 : 50 + shared], other.actions[: rows - shared]])
    own = {"t": other.t[:rows], "states": states, "actions": actions, "stretches": (Stretch(0, rows),)}
    piece = replace(other, name="piece", **own)
    for runs in ([piece, whole], [whole, piece]):
        retained, findings = without_duplicates(runs)
        assert [run.name for run in retained] == [run.name for run in runs if not (copy and run.name == "piece")]
        assert [(name, finding.count) for name, finding in findings] == ([("piece", shared)] if copy else [])


@pytest.mark.parametrize(("jitter", "reported"), [(0.15, False), (0.25, True)])
@pytest.mark.parametrize("faster", [1.0, 20.0])
def test_periods_that_vary_by_more_than_a_fifth_are_reported(plain, drive, jitter, reported, faster):
    """A tenth of the periods is longer by so much."""
    run = drive(plain, 10.0)
    steps = np.full(len(run.t) - 1, 0.05)
    steps[::10] *= 1.0 + jitter
    found = compare_model(plain, [replace(run, t=np.concatenate([[0.0], np.cumsum(steps)]) * faster)], faster)
    messages = [item.message for _, item in found.findings if item.kind == "irregular_sampling"]
    assert [" differ by more than 25%" in message for message in messages] == [True] * reported


def test_only_the_used_rows_of_a_run_are_compared(plain: Any, drive: Any) -> None:
    run = drive(plain, 10.0, stretches=[(0, 60), (80, 200)])
    found = compare_model(plain, [run], 1.0)
    (own,) = found.runs
    assert (own.rows, own.stretches, own.windows) == (180, 2, 20 + 50)


@pytest.fixture
def runs(plain, drive):
    return [drive(plain, 20.0, seed, name=f"drive_{seed}") for seed in range(3)]


def turned(run):
    """The same, with a heading that drifts away."""
    states = run.states.copy()
    states[:, 2] += 0.3 * run.t
    return replace(run, states=states)


def test_the_error_of_each_run_and_state_is_reported(plain, runs):
    comparison = compare_model(plain, [*runs[:2], turned(runs[2])], 1.0)
    document = as_json(comparison)
    assert list(document["explained"]) == [factor.variable for factor in comparison.factors]
    assert len(document["explained"]) > 1
    errors = {run["name"]: run["per_state"] for run in document["runs"]}
    assert errors["drive_2"]["yaw"] > 10.0 * errors["drive_0"]["yaw"]
    assert set(errors["drive_0"]) == {"x", "y", "yaw", "speed"}
    assert "far worse in drive_2" in run_sentence(comparison)
    assert run_sentence(comparison) in document["summary"]
    assert [row["seconds"] for row in document["horizons"]] == [item.seconds for item in comparison.horizons]
    for row, item in zip(document["horizons"], comparison.horizons, strict=True):
        assert {name: row[name]["error"] for name in item.errors} == pytest.approx(
            {name: error.value for name, error in item.errors.items()}
        )


def test_a_state_that_becomes_worse_in_one_run_is_named(plain, runs, with_effect):
    """A model whose steering is a little off: better on the run that has it, worse on the others."""
    biased = with_effect(plain, "steering_offset", angle=0.05)
    before, after = (compare_model(model, runs, 1.0) for model in (plain, biased))
    assert "yaw in drive_0" in worse_sentence(before, after)
    assert "no state gets worse in any run" in worse_sentence(after, before)


def test_the_command_compares_with_an_earlier_model(tmp_path, capsys):
    log = write_case(Case("test", 3, {"quadratic_drag": {"coefficient": 0.12}}, runs=2, seconds=10.0), tmp_path)
    later = tmp_path / "later.toml"
    extra = '\n[[effects]]\nname = "steering_offset"\nangle = 0.2\n'
    later.write_text(log.model.read_text(encoding="utf-8") + extra, encoding="utf-8")
    arguments = ["compare", str(later), *map(str, log.runs), "--before", str(log.model), "--out", str(tmp_path / "out")]
    assert safedpa.run(arguments) == 0
    received = " ".join(capsys.readouterr().out.split())
    assert "; worse: " in received
    assert "Error by run and state" in received
    assert safedpa.run([*arguments, "--json", "--force"]) == 0
    assert "; worse: " in json.loads(capsys.readouterr().out)["change"]


@pytest.mark.long
def test_a_diagnosis_reports_states_that_got_worse(plain, runs, with_effect, drive, monkeypatch):
    """Two runs with an offset of the steer and one with the opposite: the mean falls, the third run's yaw suffers."""
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", "steering_offset")])
    offset, other = (with_effect(plain, "steering_offset", angle=angle) for angle in (0.06, -0.01))
    random = np.random.default_rng(1)
    mixed = [drive(offset, 25.0, seed, name=f"drive_{seed}") for seed in range(5)]
    mixed.append(drive(other, 25.0, 9, name="other"))
    noise = (0.002, 0.002, 0.003, 0.015)
    noisy = [replace(run, states=run.states + random.normal(0.0, noise, run.states.shape)) for run in mixed]
    report = diagnose(plain, noisy)
    assert report.added == ("steering_offset",)
    assert {(item.run, item.state) for item in report.worse} >= {("other", "yaw")}
    assert report.worse[0].after > report.worse[0].before
