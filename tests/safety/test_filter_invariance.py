"""Theorems about the closed loop, and decisions as they were recorded."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from safedpa.dynamics import PhysicsModel, parse_model
from safedpa.errors import InputError
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.safety import AbstractBarrier, FilterSettings, FunctionBarrier, SafetyFilter, Status
from safedpa.safety.batch.filter import BatchFilter

FOOTPRINT = (0.08, 0.40, 0.12)
FIELD = (-4.0, 4.0, -4.0, 4.0)
Draw = Callable[[np.random.Generator, int], list[AbstractBarrier]]


def nominal_of(kind: str, random: np.random.Generator, settings: FilterSettings, state: np.ndarray) -> np.ndarray:
    """Random, full speed, or straight at the nearest thing."""
    if kind == "random":
        return random.uniform(settings.low, settings.high)
    if kind == "extreme":
        return np.where(random.random(2) < 0.5, settings.low, settings.high)
    target = np.arctan2(-state[1], -state[0]) - state[2]
    return np.array([2.0, np.clip(np.sin(target), -0.34, 0.34)])


@pytest.mark.long
@hypothesis_settings(derandomize=True, deadline=None, database=None, max_examples=40)
@given(st.integers(0, 10**6), st.sampled_from(["random", "extreme", "centre"]), st.integers(1, 8))
def test_forward_invariance(
    car: PhysicsModel, settings: FilterSettings, random_scene: Draw, safe_state: Callable, seed: int, kind: str,
    count: int,
) -> None:  # fmt: skip
    random = np.random.default_rng(seed)
    barriers = random_scene(random, count)
    state = safe_state(random, barriers, 0.05)
    safe, nominal = SafetyFilter.for_model(car, settings, barriers), np.zeros(2)
    for tick in range(300):
        if tick % 7 == 0:
            nominal = nominal_of(kind, random, settings, state)
        verdict = safe.decide(state, nominal)
        assert verdict.status is not Status.relaxed
        assert verdict.status is not Status.fallback
        state = car.step(state, verdict.action)
        assert min(part.h(state).min() for part in barriers) >= 0.05 - 1e-3
        assert verdict.h_next == pytest.approx(min(part.h(state).min() for part in barriers), abs=1e-12)


def test_without_the_filter_the_same_nominal_actions_collide(car, settings, random_scene):
    barriers, state = random_scene(np.random.default_rng(0), 4), np.array([3.0, 0.0, 0.0, 1.0])
    for _ in range(40):
        state = car.step(state, np.array([2.0, 0.0]))
    assert min(part.h(state).min() for part in barriers) < 0.0


def test_every_safe_state_has_an_admissible_action(car, settings, random_scene, safe_state):
    """h >= epsilon / eta everywhere, then braking straight satisfies every condition: counted over the state space."""
    random, kept, count = np.random.default_rng(11), 0, 3000
    safe = SafetyFilter.for_model(car, settings)
    for _ in range(count):
        barriers = random_scene(random, int(random.integers(1, 9)))
        state = safe_state(random, barriers, 0.05)
        verdict = safe.decide(state, settings.resting_action, barriers=barriers)
        kept += verdict.status is Status.passed
    print(f"states with h >= epsilon / eta at which braking satisfies every condition: {kept} of {count}")
    assert kept == count


def test_from_every_safe_state_the_filter_finds_one(car, settings, random_scene, safe_state):
    """With nominal actions that are dangerous; a share of them must be answered by the QP itself, not by the backup."""
    random, by_program, count = np.random.default_rng(12), 0, 600
    safe = SafetyFilter.for_model(car, settings)
    for _ in range(count):
        barriers = random_scene(random, 8)
        verdict = safe.decide(
            safe_state(random, barriers, 0.05), nominal_of("extreme", random, settings, np.zeros(4)), barriers=barriers
        )
        assert verdict.status in (Status.passed, Status.corrected)
        by_program += verdict.reason == ""
    print(f"answered without the backup: {by_program} of {count}")
    assert by_program >= 0.98 * count


def test_car_leaves_a_narrow_place(car: PhysicsModel, settings: FilterSettings) -> None:
    """Nose to nose with an obstacle it may reverse, though not push on; between two it creeps to the middle."""
    nose = 0.40 + 0.12 + 0.05 + 0.05  # front, radius, clearance, epsilon / eta
    barriers = car_barriers(settings, FOOTPRINT, [(nose + 0.3, 0.0, 0.3)], FIELD)
    safe, state = SafetyFilter.for_model(car, settings, barriers), np.zeros(4)
    assert safe.decide(state, [1.0, 0.0]).action[0] <= 1e-6
    for _ in range(60):
        verdict = safe.decide(state, [-0.5, 0.2])
        assert verdict.status in (Status.passed, Status.corrected)
        state = car.step(state, verdict.action)
    assert np.hypot(*state[:2]) > 0.8


def test_car_recovers_from_inside_the_margin(car: PhysicsModel, settings: FilterSettings) -> None:
    """0 < h < epsilon / eta, after an error: visible, and h grows again."""
    nose = 0.40 + 0.12 + 0.05 + 0.01
    barriers = car_barriers(settings, FOOTPRINT, [(nose + 0.3, 0.0, 0.3)], FIELD)
    safe, state = SafetyFilter.for_model(car, settings, barriers), np.zeros(4)
    first = safe.decide(state, [1.0, 0.0])
    assert first.action[0] < 0.0
    assert first.h_next > first.h_now
    for _ in range(80):
        state = car.step(state, safe.decide(state, [1.0, 0.0]).action)
    assert min(part.h(state).min() for part in barriers) > 0.04


def test_small_model_errors_are_covered_by_the_margin(car, settings, random_scene, safe_state):
    """The world brakes worse than the model but as guaranteed; nominal actions are adversarial. Nothing is touched."""
    from safedpa.dynamics import Setting

    world = car.with_settings({"base.speed_gain": Setting(3.0), "base.acceleration_limit": Setting(3.0)})
    for seed in range(8):
        random = np.random.default_rng(seed)
        barriers = random_scene(random, 5)
        state, safe = safe_state(random, barriers, 0.05), SafetyFilter.for_model(car, settings, barriers)
        nominal = np.zeros(2)
        for tick in range(120):
            nominal = nominal_of("extreme", random, settings, state) if tick % 5 == 0 else nominal
            state = world.step(state, safe.decide(state, nominal).action)
            assert min(part.h(state).min() for part in barriers) > -settings.barrier("clearance")


CAR = """
format = 1
robot = "car"
period = 0.05
[base]
kind = "kinematic_bicycle"
drive = "speed_servo"
wheelbase = 0.32
speed_gain = 3.0
acceleration_limit = 6.0
"""
SLICK = """
[[effects]]
name = "speed_command_gain"
where = "x above"
edge = 0.05
gain = 0.5
x_above = 1.0
"""
FRESH = """
[[effects]]
name = "speed_command_gain"
varies = "gain with time"
gain = 1.0
gain_per_time = 0.01
"""
LOW, HIGH = (-3.0, -0.4), (3.0, 0.4)


def filter_of(text):
    settings = FilterSettings(
        system="car", action_low=LOW, action_high=HIGH, backup_action=(0.0, 0.0), eta=0.3, epsilon={"default": 0.0}
    )
    return SafetyFilter.for_model(parse_model(CAR + text), settings, [FunctionBarrier(lambda x: 1.0 - x[3])])


def decided(text, x, **known):
    return filter_of(text).decide(np.array([x, 0.0, 0.0, 0.95]), nominal=(3.0, 0.0), **known)


def test_the_filter_asks_for_as_much_as_the_floor_there_takes():
    plain, outside, inside = (decided(text, x) for text, x in (("", 0.0), (SLICK, 0.0), (SLICK, 3.0)))
    assert {plain.status, outside.status, inside.status} == {Status.corrected}
    np.testing.assert_allclose(outside.action, plain.action, atol=1e-6)
    assert inside.action[0] == pytest.approx(2.0 * plain.action[0], rel=1e-3)
    for verdict in (plain, outside, inside):
        assert verdict.h_next >= 0.0


def test_a_batch_has_no_time_to_other_models_it_says_nothing_and_the_filter_knows_how_late_it_is():
    fresh, late = (decided(FRESH, 0.0, time=seconds) for seconds in (0.0, 50.0))
    assert fresh.status is late.status is Status.corrected
    assert late.action[0] == pytest.approx(fresh.action[0] / 1.5, rel=2e-3)
    np.testing.assert_array_equal(decided("", 0.0, time=50.0).action, decided("", 0.0).action)
    with pytest.raises(InputError, match="filter one by one"):
        BatchFilter(parse_model(CAR + FRESH))


@pytest.mark.parametrize("time", [None, float("nan"), -1.0, float("inf"), "late"])
def test_a_model_that_depends_on_the_time_is_not_trusted_without_it(time):
    verdict = decided(FRESH, 0.0, time=time)
    assert verdict.status is Status.fallback
    assert "seconds since the start of the run" in verdict.reason
    np.testing.assert_array_equal(verdict.action, (0.0, 0.0))
    ordered = filter_of(FRESH).stop("asked", np.array([0.0, 0.0, 0.0, 0.9]), time=time)
    np.testing.assert_array_equal(ordered.action, (0.0, 0.0))


def test_the_slopes_follow_the_border():
    """About the border the tangent of the filter's model is that of differences, on the recorded road as before it."""
    model = parse_model(CAR + SLICK)
    for _ in range(300):
        model.step(np.zeros(4), np.zeros(2))
    for x in np.linspace(0.85, 1.05, 9):
        state, action = np.array([x, 0.0, 0.0, 1.0]), np.array([1.2, 0.1])
        g = model.control_matrix(state, None, action, ())
        nudge = 1e-6 * np.eye(2)
        columns = [(model.step(state, action + e) - model.step(state, action - e)) / 2e-6 for e in nudge]
        np.testing.assert_allclose(g, np.stack(columns, axis=1), atol=1e-6)
