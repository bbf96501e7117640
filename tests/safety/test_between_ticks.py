"""What lies between two ticks, maps of distances and of occupied cells, a point ahead, and what the check says."""

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as some

from safedpa.errors import InputError
from safedpa.safety import (
    DistanceFieldBarrier,
    FilterSettings,
    FunctionBarrier,
    LipschitzBarrier,
    LookAheadBarrier,
    SafetyFilter,
    Status,
    check_filter,
    distance_to_occupied,
)

DISC, RADIUS = np.array([0.3, 0.1]), 0.2
SEEDS = some.integers(0, 2**32 - 1)


def distance(x: Any) -> float:
    return float(np.hypot(*(np.asarray(x)[:2] - DISC))) - RADIUS


def point_filter(barrier: Any, step: float = 2.0, epsilon: float = 0.005) -> SafetyFilter:
    """A point that moves by up to ``step`` m in each direction of a tick."""
    own = FilterSettings(action_low=(-step, -step), action_high=(step, step), backup_action=(0.0, 0.0), epsilon=epsilon)
    return SafetyFilter(lambda x: (x, np.eye(2)), [barrier], own)


def hits(safe: SafetyFilter, seed: int, ticks: int = 25) -> int:
    """How many ticks under full actions lead through the disc, at 200 points of each chord."""
    random = np.random.default_rng(seed)
    x, found = random.uniform(-2, 2, 2), 0
    while distance(x) < 0.2:
        x = random.uniform(-2, 2, 2)
    for _ in range(ticks):
        towards = DISC - x
        verdict = safe.decide(x, 2.0 * towards / np.abs(towards).max() * random.uniform(0.5, 1.0))
        assert verdict.status is not Status.fallback
        chord = x + np.linspace(0, 1, 200)[:, None] * verdict.action
        found += bool((np.hypot(*(chord - DISC).T) < RADIUS - 1e-9).any())
        x = x + verdict.action
    return found


def grid_of(field: Any, cell: float = 0.05) -> tuple[Any, float, tuple[float, float]]:
    xs = np.arange(-6, 6, cell)
    return np.array([[field((x, y)) for x in xs] for y in xs]), cell, (float(xs[0]), float(xs[0]))


def occupancy_map(occupied: Any, cell: float, origin: tuple[float, float]) -> DistanceFieldBarrier:
    return DistanceFieldBarrier(distance_to_occupied(occupied, cell), cell, origin)


KINDS = {
    "truncated": lambda: LipschitzBarrier(lambda x: min(distance(x), 0.1), (1.0, 1.0)),
    "occupancy": lambda: LipschitzBarrier(lambda x: 1.0 if distance(x) > 0.0 else -1.0, (1.0, 1.0), largest_step=0.1),
    "truncated grid": lambda: DistanceFieldBarrier(*grid_of(lambda p: min(distance(p), 0.3))).bounded(2),
    "occupancy grid": lambda: occupancy_map(*grid_of(lambda p: distance(p) <= 0.0)).bounded(2),
}


@pytest.mark.parametrize("make", KINDS.values(), ids=list(KINDS))
def test_nothing_is_jumped_through_between_two_ticks_with_a_stated_bound(make: Any) -> None:
    safe = point_filter(make(), epsilon=0.02)
    assert sum(hits(safe, seed) for seed in range(6)) == 0


def test_without_a_bound_a_truncated_distance_is_jumped_through() -> None:
    safe = point_filter(FunctionBarrier(lambda x: min(distance(x), 0.1)))
    assert sum(hits(safe, seed) for seed in range(6)) > 0


@given(SEEDS)
@settings(max_examples=60, deadline=None)
def test_the_bound_is_never_above_the_least_h_of_the_chord(seed: int) -> None:
    random = np.random.default_rng(seed)
    cut, states = random.uniform(0.05, 3.0), int(random.integers(2, 5))
    lipschitz = np.zeros(states)
    lipschitz[:2] = 1.0
    barrier = LipschitzBarrier(lambda x: [min(distance(x), cut), distance(x)], lipschitz, names=("cut", "whole"))
    a, b = random.uniform(-1.5, 1.5, (2, states))
    started = barrier.starting_at(a)
    chord = np.array([[min(distance(p), cut), distance(p)] for p in a + np.linspace(0, 1, 300)[:, None] * (b - a)])
    h, gradient = started.h_and_grad(b)
    assert h[:2] == pytest.approx(chord[-1])
    assert (h[2:] <= chord.min(axis=0) + 1e-12).all()
    assert barrier.h(a) == pytest.approx(np.tile(chord[0], 2))
    assert started.h(a) == pytest.approx(barrier.h(a))
    numeric = np.array([(started.h(b + s) - started.h(b - s)) / 2e-6 for s in 1e-6 * np.eye(states)]).T
    if min(abs(distance(b) - cut), distance(b) + RADIUS) > 1e-3:
        assert gradient == pytest.approx(numeric, abs=1e-5)
        g = random.normal(size=(states, 3))
        assert started.lie_derivative(b, g) == pytest.approx(numeric @ g, abs=1e-3)


def test_bounds_that_are_none_are_refused() -> None:
    for wrong in (-1.0, (0.0, 0.0), (1.0, np.nan), [[1.0]]):
        with pytest.raises(InputError, match="lipschitz: got"):
            LipschitzBarrier(distance, wrong)
    for wrong in (0.0, -1.0, np.inf):
        with pytest.raises(InputError, match="largest_step: got"):
            LipschitzBarrier(distance, (1.0, 1.0), wrong)
    with pytest.raises(InputError, match="got 2 numbers for 3 states"):
        LipschitzBarrier(distance, (1.0, 1.0)).starting_at(np.zeros(3))


@given(SEEDS)
@example(0)
@settings(max_examples=40, deadline=None)
def test_a_map_is_never_more_optimistic_than_the_cells_it_was_made_of(seed: int) -> None:
    random = np.random.default_rng(seed)
    occupied, cell = random.random((12, 15)) < 0.15, 0.1
    barrier = DistanceFieldBarrier(distance_to_occupied(occupied, cell), cell, (1.0, -2.0), radius=0.05)
    blocked = np.argwhere(occupied)
    for point in random.uniform((0.8, -2.2), (2.6, -0.7), (30, 2)):
        state = np.append(point, 0.7)
        h, gradient = barrier.h_and_grad(state)
        if len(blocked):
            # Distance to the nearest point of the nearest occupied cell.
            away = np.abs(point - (np.array([1.0, -2.0]) + cell * blocked[:, ::-1])) - cell / 2
            true = float(np.hypot(*np.maximum(away, 0.0).T).min()) - 0.05
            assert h[0] <= true + 1e-9
        numeric = [(barrier.h(state + s)[0] - barrier.h(state - s)[0]) / 2e-7 for s in 1e-7 * np.eye(3)]
        # At the borders of cells the interpolation has kinks.
        share = (point - np.array([1.0, -2.0])) / cell % 1.0
        if (np.minimum(share, 1 - share) > 1e-3).all():
            assert gradient[0] == pytest.approx(numeric, abs=1e-5)
        assert np.hypot(*gradient[0, :2]) <= barrier.lipschitz_constant + 1e-9


def test_outside_the_map_nothing_is_free_and_a_map_of_another_shape_is_refused() -> None:
    field = DistanceFieldBarrier(np.full((10, 10), 5.0), 0.1)
    assert field.h(np.array([0.45, 0.45]))[0] == pytest.approx(0.5 - 0.1 / np.sqrt(2), abs=0.06), "to the map's edge"
    for outside in ((-3.0, 0.4), (0.4, 9.0), (50.0, 50.0)):
        assert field.h(np.array(outside))[0] < 0.0
    free = distance_to_occupied(np.zeros((4, 5), bool), 0.1)
    assert free.shape == (4, 5)
    assert (free > 0.0).all()
    assert (distance_to_occupied(np.ones((3, 3), bool), 0.1) < 0.0).all()
    for wrong, message in (
        (lambda: DistanceFieldBarrier(np.ones(4), 0.1), "distance: got shape"),
        (lambda: DistanceFieldBarrier(np.array([[1.0, np.nan], [1.0, 1.0]]), 0.1), "distance: got shape"),
        (lambda: DistanceFieldBarrier(np.ones((3, 3)), 0.0), "cell: got 0.0, wanted a finite number > 0"),
        (lambda: DistanceFieldBarrier(np.ones((3, 3)), 0.1, radius=-1.0), "radius: got -1.0"),
        (lambda: distance_to_occupied(np.ones((3, 3)), 0.1), "occupied: got float64"),
    ):
        with pytest.raises(InputError, match=message):
            wrong()


PERIOD = 0.05


def unicycle(barrier: Any) -> SafetyFilter:
    def affine(x: Any) -> Any:
        return x, PERIOD * np.array([[np.cos(x[2]), 0.0], [np.sin(x[2]), 0.0], [0.0, 1.0]])

    own = FilterSettings(action_low=(0.0, -2.0), action_high=(1.0, 2.0), backup_action=(0.0, 0.0), epsilon=0.005)
    return SafetyFilter(affine, [barrier], own)


def drive(safe: SafetyFilter, ticks: int = 600) -> tuple[float, float]:
    """The last x, and the least distance to the disc, of a pursuit of the point (3, 0)."""
    x, least = np.array([-2.0, 0.05, 0.0]), 9.0
    for _ in range(ticks):
        turn = np.arctan2(-x[1], 3.0 - x[0]) - x[2]
        verdict = safe.decide(x, [1.0, float(np.clip(2.0 * (np.mod(turn + np.pi, 2 * np.pi) - np.pi), -2.0, 2.0))])
        x = x + PERIOD * np.array([np.cos(x[2]), np.sin(x[2]), 0.0]) * verdict.action[0]
        x[2] += PERIOD * verdict.action[1]
        least = min(least, distance(x))
    return float(x[0]), least


def test_a_unicycle_stalls_at_a_plain_distance_and_drives_around_with_a_point_ahead() -> None:
    plain = FunctionBarrier(distance, names=("disc",), kind="obstacle")
    stalled, _ = drive(unicycle(plain))
    assert stalled < 0.2
    reached, least = drive(unicycle(LookAheadBarrier(plain, 0.15)))
    assert reached > 2.5
    assert least >= 0.0


@given(SEEDS)
@settings(max_examples=40, deadline=None)
def test_a_point_ahead_is_safe_only_where_the_robot_is(seed: int) -> None:
    random = np.random.default_rng(seed)
    state, ahead = random.uniform(-2, 2, 4), random.uniform(0.01, 1.0)
    barrier = LookAheadBarrier(FunctionBarrier(distance), ahead, x=1, y=3, yaw=0)
    moved = LookAheadBarrier(FunctionBarrier(lambda s: distance((s[1], s[3]))), ahead, x=1, y=3, yaw=0)
    assert moved.h(state)[0] <= distance((state[1], state[3])) + 1e-12
    numeric = [(moved.h(state + s)[0] - moved.h(state - s)[0]) / 2e-6 for s in 1e-6 * np.eye(4)]
    assert moved.h_and_grad(state)[1][0] == pytest.approx(numeric, abs=1e-4)
    assert barrier.names == ("h",)
    for wrong in (0.0, -0.1, np.nan):
        with pytest.raises(InputError, match="ahead: got"):
            LookAheadBarrier(FunctionBarrier(distance), wrong)
    with pytest.raises(InputError, match="barrier: got function"):
        LookAheadBarrier(distance, 0.1)


POSES = np.column_stack([np.linspace(-3, -0.5, 12), np.linspace(-1, 1, 12), np.linspace(-0.5, 0.5, 12)])


def test_the_check_reports_an_action_that_moves_no_barrier_and_accepts_the_remedy() -> None:
    plain = FunctionBarrier(distance, names=("disc",), kind="obstacle")
    (issue,) = check_filter(unicycle(plain), POSES)
    assert issue.subject == "stall"
    assert "entry 1" in issue.sentence
    assert "LookAheadBarrier" in issue.sentence
    assert not check_filter(unicycle(LookAheadBarrier(plain, 0.15)), POSES)


def test_the_check_reports_a_flat_h_and_accepts_the_remedy() -> None:
    states = np.random.default_rng(0).uniform(-2, 2, (30, 2))
    states = states[[distance(x) > 0.2 for x in states]]
    for flat in (lambda x: min(distance(x), 0.1), lambda x: 1.0 if distance(x) > 0 else -1.0):
        found = check_filter(point_filter(FunctionBarrier(flat), step=0.05), states)
        assert "flat" in found.subjects
        assert "LipschitzBarrier" in str(found)
    bounded = point_filter(LipschitzBarrier(lambda x: min(distance(x), 0.1), (1.0, 1.0)), step=0.05)
    assert "flat" not in check_filter(bounded, states).subjects
    assert "flat" not in check_filter(point_filter(FunctionBarrier(distance), step=0.05), states).subjects


def test_the_check_reports_decisions_longer_than_the_period() -> None:
    safe = point_filter(FunctionBarrier(distance), step=0.05)
    states = np.array([[2.0, 2.0], [1.0, -1.0]])
    (issue,) = check_filter(safe, states, period=1e-6)
    assert issue.subject == "time"
    assert "wanted at most the period of 0.001 ms" in issue.sentence
    assert not check_filter(safe, states, period=5.0)
    for wrong in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(InputError, match="period: got"):
            check_filter(safe, states, period=wrong)
