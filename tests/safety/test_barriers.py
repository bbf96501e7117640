"""Barriers against finite differences, plain geometry, and the braking argument."""

import math
from math import inf, nan, nextafter
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.safety.dual_numbers import DUALS, Dual, dual

from safedpa.errors import InputError
from safedpa.robots.car.barriers.obstacles import FieldBarrier, ObstacleBarrier
from safedpa.safety import (
    AbstractBarrier,
    Barriers,
    CorridorBarrier,
    FilterSettings,
    FunctionBarrier,
    HigherOrderBarrier,
    SafetyFilter,
    SpeedBarrier,
    Status,
)
from safedpa.safety.barriers.stopping import Braking, stopping_distance

FOOTPRINT = (0.08, 0.40, 0.12)
BRAKING = Braking(2.0, 2.5)
FIELD = (-4.0, 4.0, -3.0, 5.0)
RANDOM = np.random.default_rng(3)
OBSTACLES = np.column_stack([RANDOM.uniform(-3, 3, (32, 2)), RANDOM.uniform(0.1, 0.5, 32)])
ALL = [
    ObstacleBarrier(OBSTACLES, FOOTPRINT, BRAKING, 0.05),
    FieldBarrier(FIELD, FOOTPRINT, BRAKING, 0.05),
    SpeedBarrier(-0.8, 2.2),
    FunctionBarrier(lambda x: [x[0] ** 2 - x[3], math.sin(x[2])], names=("a", "b")),
]
states = st.tuples(
    st.floats(-3, 3), st.floats(-3, 3), st.floats(-7, 7), st.floats(-1, 3).filter(lambda v: abs(v) > 1e-4)
).map(np.array)
exact = settings(derandomize=True, deadline=None, database=None, max_examples=150)


def swept_segment(state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    heading = np.array([math.cos(state[2]), math.sin(state[2])])
    stretch = BRAKING.distance(state[3])
    ends = (-0.08 + min(stretch, 0.0), 0.40 + max(stretch, 0.0))
    return state[:2] + ends[0] * heading, state[:2] + ends[1] * heading


@pytest.mark.long
@exact
@given(states)
@pytest.mark.parametrize("barrier", ALL, ids=lambda barrier: type(barrier).__name__)
def test_gradient_is_the_derivative(barrier: AbstractBarrier, state: np.ndarray) -> None:
    h, gradient = barrier.h_and_grad(state)
    np.testing.assert_array_equal(h, barrier.h(state))
    assert gradient.shape == (len(barrier.names), 4)
    for index in range(4):
        step = np.zeros(4)
        step[index] = 1e-6
        up, down = barrier.h(state + step), barrier.h(state - step)
        both = np.stack([(up - h) / 1e-6, (h - down) / 1e-6])
        low, high = both.min(axis=0), both.max(axis=0)  # differ only at a kink: nearest point leaves an end
        assert (gradient[:, index] >= low - 2e-4).all()
        assert (gradient[:, index] <= high + 2e-4).all()


@exact
@given(states)
def test_obstacle_height_is_the_distance_to_the_swept_segment(state: np.ndarray) -> None:
    rear, front = swept_segment(state)
    points = rear + np.linspace(0.0, 1.0, 1001)[:, None] * (front - rear)
    nearest = np.linalg.norm(points[None] - OBSTACLES[:, None, :2], axis=2).min(axis=1)
    expected = nearest - OBSTACLES[:, 2] - 0.12 - 0.05
    np.testing.assert_allclose(ALL[0].h(state), expected, atol=3e-4)


@exact
@given(states)
def test_field_height_is_the_room_of_the_nearer_end(state: np.ndarray) -> None:
    rear, front = swept_segment(state)
    expected = []
    for end in (front, rear):
        expected += [end[0] + 4.0, 4.0 - end[0], end[1] + 3.0, 5.0 - end[1]]
    np.testing.assert_allclose(ALL[1].h(state), np.array(expected) - 0.17, atol=1e-12)


def test_field_names_say_wall_and_end() -> None:
    assert FieldBarrier.names[0] == "left wall, front end"
    assert FieldBarrier.names[7] == "upper wall, rear end"


@pytest.mark.long
@exact
@given(states, st.floats(1.0, 3.0), st.floats(1.0, 3.0))
def test_braking_straight_never_lowers_h(state: np.ndarray, harder: float, quicker: float) -> None:
    """A brake at least as good as guaranteed: the swept segment shrinks into itself.

    For a wall that is the nearer end's business: the other end may come closer, up to where the nearer one was.
    """
    for barrier, ends in ((ALL[0], 1), (ALL[1], 2)):
        before, current = barrier.h(state).reshape(ends, -1).min(axis=0), state.copy()
        for _ in range(60):
            size = min(BRAKING.gain * quicker * abs(current[3]), BRAKING.deceleration * harder)
            speed = math.copysign(max(0.0, abs(current[3]) - 0.01 * size), current[3])
            current[:2] += 0.01 * speed * np.array([math.cos(current[2]), math.sin(current[2])])
            current[3] = speed
            now = barrier.h(current).reshape(ends, -1).min(axis=0)
            assert (now >= before - 1e-9).all()
            before = now


def test_standing_still_looks_both_ways_and_in_motion_only_the_end_ahead_is_stretched() -> None:
    """At speed 0 both ends count as stretched: driving off towards an obstacle is no surprise either way."""
    ahead = ObstacleBarrier([(1.0, 0.0, 0.2), (-1.0, 0.0, 0.2)], FOOTPRINT, BRAKING).h_and_grad(np.zeros(4))[1]
    np.testing.assert_allclose(ahead[:, 3], [-0.4, 0.4])
    walls = FieldBarrier(FIELD, FOOTPRINT, BRAKING).h_and_grad(np.zeros(4))[1]
    np.testing.assert_allclose(walls[:, 3], [0.4, -0.4, 0, 0, 0.4, -0.4, 0, 0])
    for speed, expected in ((1.0, [-0.5, 0.0]), (-1.0, [0.0, 0.5])):
        barrier = ObstacleBarrier([(3.0, 0.0, 0.2), (-3.0, 0.0, 0.2)], FOOTPRINT, BRAKING)
        np.testing.assert_allclose(barrier.h_and_grad(np.array([0, 0, 0, speed]))[1][:, 3], expected)


def test_a_centre_on_the_segment_has_a_finite_gradient_and_one_almost_on_it_a_unit_gradient() -> None:
    barrier = ObstacleBarrier([(0.2, 0.0, 0.3)], FOOTPRINT, BRAKING)
    h, gradient = barrier.h_and_grad(np.zeros(4))
    assert h[0] == pytest.approx(-0.42)
    np.testing.assert_allclose(gradient[0], [0.0, -1.0, -0.2, 0.0])
    gradient = ObstacleBarrier([(0.2, 1e-9, 0.3)], FOOTPRINT, BRAKING).h_and_grad(np.zeros(4))[1]
    assert np.linalg.norm(gradient[0, :2]) == pytest.approx(1.0)


def test_no_obstacle_is_no_condition() -> None:
    barrier = ObstacleBarrier([], FOOTPRINT, BRAKING)
    h, gradient = barrier.h_and_grad(np.zeros(4))
    assert h.shape == (0,)
    assert gradient.shape == (0, 4)
    assert barrier.names == ()


def test_states_may_have_more_entries_than_the_four() -> None:
    for barrier in ALL[:3]:
        assert barrier.h_and_grad(np.array([0.1, 0.2, 0.3, 0.4, 9.0]))[1][:, 4].tolist() == [0.0] * len(barrier.names)


def test_stack_keeps_order_names_and_margins() -> None:
    parts = [ObstacleBarrier([(1, 1, 0.2), (2, 2, 0.2)], FOOTPRINT, BRAKING), SpeedBarrier(-1.0, 2.0)]
    stack, state = Barriers(parts), np.array([0.0, 0.0, 0.0, 0.5])
    assert list(stack) == parts
    assert (stack[1], stack[:1]) == (parts[1], (parts[0],))
    assert stack.kinds == ("obstacle", "obstacle", "speed", "speed")
    assert stack.names == ("obstacle 0", "obstacle 1", "highest speed", "lowest speed")
    h, gradient = stack.h(state), stack.grad_h(state)
    np.testing.assert_array_equal(h[2:], [1.5, 1.5])
    np.testing.assert_array_equal(gradient[2:, 3], [-1.0, 1.0])
    np.testing.assert_array_equal(stack.per_row({"speed": 0.3}, 0.1), [0.1, 0.1, 0.3, 0.3])


def test_speed_barrier_of_another_entry() -> None:
    h, gradient = SpeedBarrier(-2.0, 5.0, index=1).h_and_grad(np.array([7.0, 1.0]))
    np.testing.assert_array_equal(h, [4.0, 3.0])
    np.testing.assert_array_equal(gradient, [[0.0, -1.0], [0.0, 1.0]])


def test_function_barrier_takes_scalars_arrays_and_gradients() -> None:
    state = np.array([3.0, -2.0])
    scalar = FunctionBarrier(lambda x: x[0] * x[1])
    np.testing.assert_allclose(scalar.h_and_grad(state)[1], [[-2.0, 3.0]], atol=1e-8)
    np.testing.assert_array_equal(scalar.h(state), [-6.0])
    given_gradient = FunctionBarrier(lambda x: x[0], lambda x: (1.0, 0.5), names=("mine",), kind="own")
    np.testing.assert_array_equal(given_gradient.h_and_grad(state)[1], [[1.0, 0.5]])
    assert (given_gradient.kind, given_gradient.names) == ("own", ("mine",))
    assert (scalar.kind, scalar.names) == ("function", ("h",))


def test_finite_differences_follow_the_size_of_the_state() -> None:
    state = np.array([1e6, 1e-3])
    gradient = FunctionBarrier(lambda x: 1e-6 * x[0] ** 2 + 1e3 * x[1] ** 2).h_and_grad(state)[1]
    np.testing.assert_allclose(gradient[0], [2.0, 2.0], rtol=1e-3)
    np.testing.assert_array_equal(state, [1e6, 1e-3])


def test_finite_differences_step_by_a_share_of_the_state() -> None:
    seen: list[float] = []

    def h(x: np.ndarray) -> float:
        seen.append(float(x[0]))
        return float(x[0])

    FunctionBarrier(h).h_and_grad(np.array([0.5]))
    assert seen == [0.5, 0.5 + 6e-6, 0.5 - 6e-6]
    seen.clear()
    FunctionBarrier(h).h_and_grad(np.array([-4.0]))
    assert seen == [-4.0, -4.0 + 2.4e-5, -4.0 - 2.4e-5]


@pytest.mark.parametrize(
    ("make", "phrase"),
    [
        (
            lambda: ObstacleBarrier([(1, 2)], FOOTPRINT, BRAKING),
            r"obstacles: got shape \(1, 2\), wanted \(obstacles, 3\)",
        ),
        (lambda: ObstacleBarrier([1.0, 2.0, 3.0], FOOTPRINT, BRAKING), r"obstacles: got shape \(3,\)"),
        (lambda: ObstacleBarrier([(1, math.nan, 1)], FOOTPRINT, BRAKING), "obstacles: got NaN"),
        (lambda: ObstacleBarrier([(1, 1, -0.1)], FOOTPRINT, BRAKING), "negative radius"),
        (lambda: ObstacleBarrier([(1, 1, 1)], FOOTPRINT, BRAKING, -0.1), r"clearance: got -0\.1"),
        (lambda: ObstacleBarrier([(1, 1, 1)], FOOTPRINT, BRAKING, math.nan), "clearance: got nan"),
        (
            lambda: ObstacleBarrier([(1, 1, 1)], FOOTPRINT, BRAKING, names=["a", "b"]),
            "names of obstacles: got 2, wanted 1",
        ),
        (lambda: ObstacleBarrier([], (0.1, 0.2), BRAKING), "footprint: got 2 numbers, wanted 3"),
        (lambda: ObstacleBarrier([], (0.1, -0.2, 0.1), BRAKING), "front not behind rear"),
        (lambda: ObstacleBarrier([], (0.1, 0.2, -0.1), BRAKING), "footprint: got"),
        (lambda: ObstacleBarrier([], (math.inf, 0.2, 0.1), BRAKING), "footprint: got inf"),
        (lambda: ObstacleBarrier([], (0.1, math.nan, 0.1), BRAKING), "footprint: got"),
        (lambda: ObstacleBarrier([], (0.1, 0.2, math.inf), BRAKING), "footprint: got"),
        (lambda: FieldBarrier((1, 1, 0, 2), FOOTPRINT, BRAKING), "field: got"),
        (lambda: FieldBarrier((0, 1, 3, 3), FOOTPRINT, BRAKING), "field: got"),
        (lambda: FieldBarrier((0, 1, 0), FOOTPRINT, BRAKING), "field: got"),
        (lambda: FieldBarrier((0, 1, 0, math.inf), FOOTPRINT, BRAKING), "field: got"),
        (lambda: FieldBarrier((0, 1, 0, 1), FOOTPRINT, BRAKING, -1.0), "clearance: got"),
        (lambda: FieldBarrier((0, 1, 0, 1), FOOTPRINT, BRAKING, math.inf), "clearance: got"),
        (lambda: FunctionBarrier(lambda x: [1.0, 2.0]).h(np.zeros(2)), r"h of barrier h: got shape \(2,\)"),
        (
            lambda: FunctionBarrier(lambda x: 1.0, lambda x: [1.0]).h_and_grad(np.zeros(2)),
            r"gradient of h of barrier h: got shape \(1,\), wanted \(1, 2\)",
        ),
    ],
)
def test_refusals_say_what_was_wanted(make: object, phrase: str) -> None:
    with pytest.raises(InputError, match=phrase):
        make()  # type: ignore[operator]


def test_limits_of_what_is_accepted() -> None:
    point = ObstacleBarrier([(1.0, 0.0, 0.0)], (0.0, 0.0, 0.0), BRAKING, 0.0, names=["post"])
    assert point.h(np.zeros(4)).tolist() == [1.0]
    assert point.names == ("post",)
    assert FieldBarrier((0, 1, 0, 1), (0.0, 0.0, 0.0), BRAKING, 0.0).h(np.zeros(4))[0] == 0.0
    assert FieldBarrier((0, 1, 0, 1), (0.0, 0.0, 0.0), BRAKING).h(np.zeros(4))[0] == 0.0
    long_nose = ObstacleBarrier([(1.0, 0.0, 0.1)], (-0.2, 0.4, 0.1), BRAKING)
    assert long_nose.h(np.zeros(4))[0] == pytest.approx(0.4)


finite = st.floats(-20.0, 20.0)


@given(finite, finite, st.floats(-3.0, 3.0), st.floats(0.01, 5.0), st.floats(0.01, 2.0))
def test_gradient_is_exact(angle: float, rate: float, low: float, width: float, time: float) -> None:
    barrier = CorridorBarrier(low, low + width, time)
    state, move = np.array([angle, rate]), np.array([0.3, -0.7])
    h, gradient = barrier.h_and_grad(state)
    np.testing.assert_allclose(barrier.h(state + move), h + gradient @ move, atol=1e-9)
    np.testing.assert_allclose(h, barrier.h(state))


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=60), st.floats(0.0, 1.0), st.floats(0.05, 1.0))
def test_the_angle_stays_where_the_barrier_is_kept(ahead: list[float], start: float, time: float) -> None:
    """Whatever s does within the corridor, the angle that moves at the rate (s - angle) / time stays within it."""
    barrier, angle, period = CorridorBarrier(0.0, 1.0, time), start, 0.01
    for s in ahead:
        rate = (s - angle) / time
        assert barrier.h(np.array([angle, rate])).min() >= -1e-12
        angle += period * rate
        assert -1e-12 <= angle <= 1.0 + 1e-12


def test_other_entries_of_the_state_and_names() -> None:
    barrier = CorridorBarrier(-1.0, 2.0, 0.5, angle=2, rate=0, name="elbow")
    assert barrier.names == ("elbow lower edge", "elbow upper edge")
    np.testing.assert_allclose(barrier.h(np.array([1.0, 9.0, 0.5])), [2.0, 1.0])
    np.testing.assert_allclose(barrier.h_and_grad(np.zeros(3))[1], [[0.5, 0.0, 1.0], [-0.5, 0.0, -1.0]])


@pytest.mark.parametrize(("low", "high"), [(1.0, 1.0), (2.0, 1.0), (nan, 1.0), (0.0, nan), (-inf, 1.0), (0.0, inf)])
def test_empty_and_endless_limits_are_refused(low: float, high: float) -> None:
    with pytest.raises(InputError, match=f"corridor: got {low} to {high}, wanted finite low < high"):
        CorridorBarrier(low, high, 0.2)
    with pytest.raises(InputError, match=f"speed limits: got {low} to {high}, wanted finite numbers, low < high"):
        SpeedBarrier(low, high)


@given(st.floats(-1e9, 1e9))
def test_the_narrowest_limits_are_taken(low: float) -> None:
    high = nextafter(low, inf)
    assert CorridorBarrier(low, high, 1e-300).h(np.array([low, 0.0])).min() == 0.0
    assert SpeedBarrier(low, high, 0).h(np.array([high])).tolist() == [0.0, high - low]


@pytest.mark.parametrize("time", [0.0, -1.0, nan, inf])
def test_a_time_that_is_none_is_refused(time: float) -> None:
    with pytest.raises(InputError, match="wanted a finite time > 0"):
        CorridorBarrier(0.0, 1.0, time)


def test_without_named_entries_it_reads_a_pendulums_state() -> None:
    assert CorridorBarrier(-1.0, 1.0, 0.2).reads == ("angle", "rate")
    for named in ({"angle": 0}, {"rate": 1}, {"angle": 2, "rate": 3}):
        assert CorridorBarrier(-1.0, 1.0, 0.2, **named).reads == ()


def slope(deceleration: float, gain: float, speed: float) -> float:
    return dual(stopping_distance(Dual(speed, 1.0), deceleration, gain, DUALS)).slope


@pytest.mark.parametrize(("deceleration", "gain"), [(2.0, 2.5), (0.5, 4.0), (9.0, 1.0)])
@pytest.mark.parametrize("speed", [-20.0, -1.0, -0.2, 0.0, 0.3, 0.8, 1.0, 2.0, 15.0])
def test_distance_is_what_the_brake_takes(deceleration: float, gain: float, speed: float) -> None:
    """Integrates d|v|/dt = -min(k |v|, b) in small steps: an independent road to D."""
    left, travelled, dt = abs(speed), 0.0, 1e-4
    while left > 1e-7:
        middle = left - 0.5 * dt * min(gain * left, deceleration)
        travelled += dt * middle
        left -= dt * min(gain * middle, deceleration)
    assert Braking(deceleration, gain).distance(speed) == pytest.approx(math.copysign(travelled, speed), abs=1e-6)


@pytest.mark.parametrize("speed", [-3.0, -0.8, -0.5, 0.0, 0.1, 0.79, 0.8, 0.81, 2.0])
def test_slope_is_the_larger_of_both_and_continuous(speed: float) -> None:
    braking, step = Braking(2.0, 2.5), 1e-6
    difference = (braking.distance(speed + step) - braking.distance(speed - step)) / (2 * step)
    assert slope(2.0, 2.5, speed) == pytest.approx(difference, abs=1e-6)
    assert slope(2.0, 2.5, speed) == pytest.approx(max(1.0 / 2.5, abs(speed) / 2.0), abs=1e-15)


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
def test_refuses_what_is_no_braking_ability(bad: float) -> None:
    with pytest.raises(InputError, match=r"braking deceleration: got .*, wanted a positive finite"):
        Braking(bad, 1.0)
    with pytest.raises(InputError, match=r"braking gain: got"):
        Braking(1.0, bad)


PERIOD = 0.05
A = np.eye(4) + PERIOD * np.eye(4, k=2)
B = np.vstack((0.5 * PERIOD**2 * np.eye(2), PERIOD * np.eye(2)))
CENTRE, RADIUS = np.array([1.5, 0.2]), 0.5
SETTINGS = FilterSettings(action_low=(-1.0, -1.0), action_high=(1.0, 1.0), eta=0.2, epsilon=0.002)


def room(x: np.ndarray) -> float:
    return float(np.hypot(*(x[:2] - CENTRE)) - RADIUS)


def closing(x: np.ndarray) -> float:
    """d(room)/dt, which no action changes at once."""
    apart = x[:2] - CENTRE
    return float(apart @ x[2:] / np.hypot(*apart))


def allowed(h: np.ndarray) -> np.ndarray:
    """Closing speed that a brake of 0.8 takes away over h, linear below 0.2 m: increasing, 0 at 0."""
    return np.where(h < 0.2, 2.0 * h, np.sqrt(1.6 * np.maximum(h, 0.2) - 0.16))


def drive(barrier: AbstractBarrier, seed: int) -> tuple[float, set[Status]]:
    random, x, least = np.random.default_rng(seed), np.zeros(4), np.inf
    x[:2] = random.uniform((-0.5, -0.8), (0.3, 1.2))
    safe, notice = SafetyFilter(lambda x: (A @ x, B), [barrier], SETTINGS), set()
    for _ in range(100):
        nominal = np.clip(3.0 * (CENTRE - x[:2]) + random.normal(size=2), -1.0, 1.0)
        verdict = safe.decide(x, nominal)
        notice.add(verdict.status)
        x = A @ x + B @ verdict.action
        least = min(least, room(x))
    return least, notice


@pytest.mark.long
def test_a_double_integrator_hits_nothing() -> None:
    plain = [drive(FunctionBarrier(room), seed)[0] for seed in range(20)]
    assert sum(least < 0.0 for least in plain) >= 5, "distance less radius has relative degree two"
    higher = [drive(HigherOrderBarrier([room, closing], [allowed]), seed) for seed in range(80)]
    assert min(least for least, _ in higher) >= 0.0
    assert set.union(*(notice for _, notice in higher)) <= {Status.passed, Status.corrected}


def test_it_is_the_recursion_of_its_source() -> None:
    """h = x^3 + y in time: derivatives of polynomials are known, psi_2 = psi_1' + alpha_2 psi_1."""
    derivatives = [lambda t: t[0] ** 3, lambda t: 3.0 * t[0] ** 2, lambda t: 6.0 * t[0]]
    first, second = 0.7, 1.9
    barrier = HigherOrderBarrier(derivatives, [first, second])
    t = 1.3
    psi_1, psi_1_rate = 3 * t**2 + first * t**3, 6 * t + first * 3 * t**2
    assert barrier.h(np.array([t]))[0] == pytest.approx(psi_1_rate + second * psi_1, rel=1e-14)
    squared = HigherOrderBarrier(derivatives, [first, np.square])
    assert squared.h(np.array([t]))[0] == pytest.approx(psi_1_rate + psi_1**2, rel=1e-14)


def test_several_values_and_a_gradient_of_their_own() -> None:
    barrier = HigherOrderBarrier(
        [lambda x: np.array([x[0], 2.0 * x[0]]), lambda x: np.array([x[1], 2.0 * x[1]])],
        [3.0],
        gradient=lambda x: [[3.0, 1.0], [6.0, 2.0]],
        names=("one", "two"),
        kind="wall",
    )
    h, gradient = barrier.h_and_grad(np.array([0.5, -0.2]))
    np.testing.assert_allclose(h, [1.3, 2.6])
    np.testing.assert_array_equal(gradient, [[3.0, 1.0], [6.0, 2.0]])
    np.testing.assert_array_equal(
        barrier.lie_derivative(np.array([0.5, -0.2]), np.array([[1.0], [2.0]])), [[5.0], [10.0]]
    )
    assert (barrier.names, barrier.kind) == (("one", "two"), "wall")


@pytest.mark.parametrize(
    ("derivatives", "rates"),
    [([room], []), ([room, closing], []), ([room, closing], [1.0, 2.0]), ([room, closing], [0.0]),
     ([room, closing], [-1.0]), ([room, closing], [np.inf]),
     ([room, closing], [np.nan]), ([room, closing, closing], [allowed, 1.0])],
)  # fmt: skip
def test_what_does_not_fit_is_named(derivatives: list[Any], rates: list[Any]) -> None:
    with pytest.raises(InputError, match="rates: got"):
        HigherOrderBarrier(derivatives, rates)
