"""Every status, what it promises, and the fallback hierarchy."""

import math

import numpy as np
import pytest

from safedpa.dynamics import PhysicsModel, Setting
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.robots.car.dynamics.kinematic_bicycle import KinematicBicycle
from safedpa.safety import FilterSettings, FunctionBarrier, SafetyFilter, SpeedBarrier, Status, Verdict

FOOTPRINT = (0.08, 0.40, 0.12)
FIELD = (-4.0, 4.0, -4.0, 4.0)
NEAR = np.array([0.75, 0.0, 0.0, 0.6])


def check_promises(verdict: Verdict, settings: FilterSettings) -> None:
    assert (verdict.action >= settings.low).all()
    assert (verdict.action <= settings.high).all()
    numbers = [verdict.slack, verdict.h_now, verdict.h_next, verdict.margin, verdict.microseconds]
    assert np.isfinite(numbers).all()
    assert verdict.slack >= 0.0
    assert verdict.microseconds >= 0.0
    assert not verdict.action.flags.writeable
    if verdict.status in (Status.passed, Status.corrected):
        assert verdict.slack == 0.0
        assert verdict.known
        assert verdict.h_now >= 0.0
        assert verdict.h_next >= 0.0
    if verdict.status is Status.relaxed:
        assert verdict.slack > 0.0 or verdict.h_next < 0.0
        assert verdict.h_now >= 0.0
    if verdict.status is Status.violated:
        assert verdict.h_now < 0.0
    if verdict.status is Status.passed:
        assert verdict.nominal is not None
        assert verdict.action.tobytes() == verdict.nominal.tobytes()
    assert verdict.sentence.startswith(verdict.status.sentence)
    assert verdict.as_dict()["status"] == verdict.status.value


def test_a_safe_nominal_action_is_handed_on_bit_for_bit_with_the_sign_of_its_zero(car_filter: SafetyFilter) -> None:
    nominal = np.array([0.1 + 0.2, -0.0])
    verdict = car_filter.decide(np.array([-2.0, 0.0, 0.0, 0.3]), nominal)
    assert verdict.status is Status.passed
    assert verdict.action.tobytes() == nominal.tobytes()
    assert (verdict.slack, verdict.solver, verdict.reason, verdict.active) == (0.0, "not needed", "", ())
    assert not verdict.intervened
    check_promises(verdict, car_filter.settings)
    settings = FilterSettings(action_low=(0.0,), action_high=(1.0,))
    safe = SafetyFilter(lambda x: (x, np.eye(1)), [FunctionBarrier(lambda x: 5.0 - x[0])], settings)
    verdict = safe.decide(np.zeros(1), np.array([-0.0]))
    assert verdict.status is Status.passed
    assert math.copysign(1.0, verdict.action[0]) == -1.0


def test_a_nominal_action_beyond_the_actuator_limits_is_clipped_and_the_verdict_says_so(car_filter: SafetyFilter):
    verdict = car_filter.decide(np.array([-2.0, 0.0, 0.0, 0.3]), [0.2, 0.5])
    assert verdict.status is Status.corrected
    assert verdict.reason == "The nominal action lay outside the actuator limits."
    np.testing.assert_array_equal(verdict.action, [0.2, 0.34])
    np.testing.assert_array_equal(verdict.nominal, [0.2, 0.5])
    assert verdict.intervened


def test_dangerous_nominal_action_is_corrected_to_the_edge(car_filter: SafetyFilter) -> None:
    verdict = car_filter.decide(NEAR, [2.0, 0.0])
    assert verdict.status is Status.corrected
    assert verdict.solver == "solved"
    assert verdict.active == ("obstacle 0",)
    assert verdict.intervened
    assert 0.0 < verdict.h_next < verdict.h_now
    assert verdict.h_next == pytest.approx(0.8 * verdict.h_now + 0.01, abs=2e-4)
    check_promises(verdict, car_filter.settings)


def test_h_now_and_h_next_are_those_of_the_model(car: PhysicsModel, settings: FilterSettings) -> None:
    barriers = car_barriers(settings, FOOTPRINT, [(2.0, 0.0, 0.3)], FIELD)
    verdict = SafetyFilter.for_model(car, settings, barriers).decide(NEAR, [2.0, 0.0])
    following = car.step(NEAR, verdict.action)
    assert verdict.h_now == min(part.h(NEAR).min() for part in barriers)
    assert verdict.h_next == pytest.approx(min(part.h(following).min() for part in barriers), abs=1e-12)
    assert verdict.margin == 0.01


def test_filtering_the_filtered_action_leaves_it(car, settings, random_scene, safe_state):
    random, corrected = np.random.default_rng(5), 0
    safe = SafetyFilter.for_model(car, settings)
    for _ in range(400):
        barriers = random_scene(random, 6)
        state = safe_state(random, barriers, 0.05)
        first = safe.decide(state, (2.0, random.uniform(-0.34, 0.34)), barriers=barriers)
        check_promises(first, settings)
        if first.status is Status.corrected:
            second = safe.decide(state, first.action, barriers=barriers)
            assert second.status is Status.passed
            assert second.action.tobytes() == first.action.tobytes()
            corrected += 1
    assert corrected > 50


@pytest.mark.parametrize("y", [0.05, 0.2, 0.31, 0.45])
@pytest.mark.parametrize("steer", [-0.3, 0.0, 0.25])
def test_mirrored_scene_gives_the_mirrored_action(car: PhysicsModel, settings: FilterSettings, y: float, steer: float):
    state, verdicts = np.array([0.3, 0.1, 0.05, 1.2]), []
    for side in (1.0, -1.0):
        barriers = car_barriers(settings, FOOTPRINT, [(1.9, side * y, 0.3)], FIELD)
        safe = SafetyFilter.for_model(car, settings, barriers)
        verdicts.append(safe.decide(state * (1.0, side, side, 1.0), [2.0, side * steer]))
    np.testing.assert_allclose(verdicts[0].action, verdicts[1].action * (1.0, -1.0), atol=1e-6)
    assert verdicts[0].h_next == pytest.approx(verdicts[1].h_next, abs=1e-6)
    assert verdicts[0].status is verdicts[1].status


def test_no_better_action_is_overlooked(car, settings, random_scene, safe_state):
    """Against a fine grid of actions under the nonlinear model: the correction is near the smallest one."""
    random, ratios = np.random.default_rng(8), []
    safe = SafetyFilter.for_model(car, settings)
    targets, steers = np.meshgrid(np.linspace(-0.6, 2.0, 53), np.linspace(-0.34, 0.34, 35), indexing="ij")
    grid = np.column_stack([targets.ravel(), steers.ravel()])
    while len(ratios) < 25:
        barriers = random_scene(random, 5)
        state, nominal = safe_state(random, barriers, 0.05), np.array([2.0, random.uniform(-0.34, 0.34)])
        verdict = safe.decide(state, nominal, barriers=barriers)
        if verdict.status is not Status.corrected:
            continue
        following = car.step(np.broadcast_to(state, (len(grid), 4)), grid)
        required = [0.8 * part.h(state) + 0.01 for part in barriers]
        kept = np.array(
            [
                all((part.h(row) >= need).all() for part, need in zip(barriers, required, strict=True))
                for row in following
            ]
        )
        distance = (((grid - nominal) / (settings.high - settings.low)) ** 2).sum(axis=1)[kept].min()
        own = (((verdict.action - nominal) / (settings.high - settings.low)) ** 2).sum()
        ratios.append(own / max(distance, 1e-3))
    assert np.median(ratios) < 1.05
    assert np.mean(np.array(ratios) < 1.3) > 0.85


def test_larger_margin_never_lowers_h_next() -> None:
    """An affine model and barrier, so that the optimum is exact."""
    f, g = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])
    random = np.random.default_rng(4)
    settings = FilterSettings(action_low=(-1.0,), action_high=(1.0,), epsilon=0.0)
    safe = SafetyFilter(lambda x: (f @ x, g), [FunctionBarrier(lambda x: 1.0 - x[0] - 2.0 * x[1])], settings)
    for _ in range(100):
        state, nominal = random.uniform((-2, -1), (1, 0.5)), random.uniform(-1, 1, 1)
        heights = [safe.decide(state, nominal, epsilon={"function": e}).h_next for e in np.linspace(0.0, 0.3, 12)]
        assert (np.diff(heights) >= -1e-4).all()


def test_infeasible_situation_is_visible_and_brakes() -> None:
    """1 m before a wall at 20 m/s with 1 m/s2: no action helps, and the verdict says so."""
    values = {"wheelbase": 0.32, "speed_gain": 4.0, "acceleration_limit": 1.0}
    car = PhysicsModel(KinematicBicycle(), (), {f"base.{key}": Setting(value) for key, value in values.items()})
    settings = FilterSettings(
        action_low=(-0.6, -0.34), action_high=(8.0, 0.34), barriers={"speed_high": 30.0, "braking_deceleration": 1.0}
    )
    barriers = car_barriers(settings, FOOTPRINT, [], (-500.0, 1.0, -500.0, 500.0))
    safe = SafetyFilter.for_model(car, settings, barriers)
    verdict = safe.decide(np.array([-0.57, 0.0, 0.0, 20.0]), [20.0, 0.0])
    assert verdict.status is Status.violated
    assert verdict.h_next < 0.0
    assert verdict.reason == "Below 0: right wall, front end."
    after = car.step(np.array([-0.57, 0.0, 0.0, 20.0]), verdict.action)
    assert after[3] == pytest.approx(20.0 - 0.05 * 1.0)  # as hard as it can
    braking = car.step(np.array([-0.57, 0.0, 0.0, 20.0]), np.array([0.0, 0.0]))
    assert verdict.h_next >= min(part.h(braking).min() for part in barriers[1:])
    turned = [
        car.step(np.array([-0.57, 0.0, 0.0, 20.0]), np.array([target, steer]))
        for target in np.linspace(-0.6, 25.0, 9)
        for steer in np.linspace(-0.34, 0.34, 9)
    ]
    best = max(min(part.h(state).min() for part in barriers[1:]) for state in turned)
    assert verdict.h_next >= best - 1.0  # turning away helps more than braking: -89 against -199
    check_promises(verdict, settings)


def test_disabled_hands_on_what_the_actuator_can_do(car: PhysicsModel) -> None:
    settings = FilterSettings.for_robot("car", enabled=False)
    safe = SafetyFilter.for_model(car, settings, car_barriers(settings, FOOTPRINT, [(2.0, 0.0, 0.3)]))
    verdict = safe.decide(NEAR, [2.5, 0.1])
    assert verdict.status is Status.disabled
    np.testing.assert_array_equal(verdict.action, [2.0, 0.1])
    assert verdict.known
    assert verdict.slack > 0.0
    assert not verdict.intervened
    blind = safe.decide(None, [1.0, 0.1])
    assert (blind.status, blind.known) == (Status.disabled, False)
    np.testing.assert_array_equal(blind.action, [1.0, 0.1])
    assert safe.decide(NEAR, [math.nan, 0.1]).status is Status.fallback


def test_saturated_servo_does_not_hide_the_brake(car_filter: SafetyFilter) -> None:
    """At low speed the servo saturates for a fast nominal action, so that the tangent at the nominal action knows no
    influence of it."""
    verdict = car_filter.decide(np.array([1.0, 0.0, 0.0, 0.2]), [2.0, 0.0])
    assert verdict.status is Status.corrected
    assert verdict.reason == ""
    assert verdict.h_next == pytest.approx(0.8 * verdict.h_now + 0.01, abs=0.01)


def test_each_reference_action_is_judged_by_the_nonlinear_model() -> None:
    """h bends: the tangent at the nominal action misleads, re-linearisation finds the edge."""
    settings = FilterSettings(action_low=(-2.0,), action_high=(2.0,), epsilon=0.0, eta=1.0)
    safe = SafetyFilter(
        lambda x, latent, around: (around**2 * -0.5, np.array([[around[0]]])),
        [FunctionBarrier(lambda x: 1.0 - x[0])],
        settings,
        step=lambda x, a: 0.5 * a * a,
    )
    verdict = safe.decide(np.zeros(1), [2.0])
    assert verdict.status is Status.corrected
    assert verdict.action[0] == pytest.approx(math.sqrt(2.0), abs=1e-3)


def test_without_step_the_tangent_at_the_action_is_the_prediction() -> None:
    settings = FilterSettings(action_low=(-2.0,), action_high=(2.0,), epsilon=0.0, eta=1.0)
    safe = SafetyFilter(
        lambda x, around: (around**2 * -0.5, np.array([[around[0]]])), [FunctionBarrier(lambda x: 1.0 - x[0])], settings
    )
    assert safe.decide(np.zeros(1), [2.0]).action[0] == pytest.approx(math.sqrt(2.0), abs=1e-3)


def test_latent_and_memory_reach_the_users_functions() -> None:
    settings = FilterSettings(action_low=(-1.0,), action_high=(1.0,), epsilon=0.0)
    seen: list[object] = []

    def affine(x: np.ndarray, latent: np.ndarray, *, around: np.ndarray, memory: object):
        seen.append((latent.tolist(), memory))
        return x + latent, np.eye(1)

    safe = SafetyFilter(affine, [FunctionBarrier(lambda x: 1.0 - x[0])], settings)
    verdict = safe.decide(np.zeros(1), [1.0], [0.5], memory="felt")
    assert seen[0] == ([0.5], "felt")
    assert verdict.action[0] == pytest.approx(-0.3, abs=1e-6)


def test_memory_of_a_models_actuators_changes_the_prediction(car: PhysicsModel, settings: FilterSettings) -> None:
    from safedpa.effects import effect

    lagging = car.with_effect(effect("car", "steering_lag"), {"time_constant": Setting(0.3)})
    safe = SafetyFilter.for_model(lagging, settings, [FunctionBarrier(lambda x: x[2] + 1.0)])
    state, nominal = np.array([0.0, 0.0, 0.0, 1.0]), np.array([1.0, 0.3])
    settled = safe.decide(state, nominal)
    turning = safe.decide(state, nominal, memory=lagging.initial_memory(np.array([1.0, -0.3])))
    assert settled.h_next > 1.0 > turning.h_next


def test_a_call_may_bring_its_own_margin_and_barriers_but_no_barrier_is_no_permission(car_filter: SafetyFilter) -> None:
    loose, tight = (car_filter.decide(NEAR, [2.0, 0.0], epsilon={"obstacle": e}) for e in (0.0, 0.03))
    assert (loose.margin, tight.margin) == (0.01, 0.03)
    assert tight.h_next - loose.h_next == pytest.approx(0.03, abs=1e-3)
    free = car_filter.decide(NEAR, [2.0, 0.0], barriers=[SpeedBarrier(-1.0, 3.0)])
    assert free.status is Status.passed
    assert free.h_now == pytest.approx(1.6)
    verdict = car_filter.decide(NEAR, [2.0, 0.0], barriers=[])
    assert verdict.status is Status.fallback
    assert verdict.reason == "Reason: there is no barrier to keep."
    np.testing.assert_array_equal(verdict.action, [0.0, 0.0])


def test_statuses_have_sentences() -> None:
    assert {status.value for status in Status} == {
        "passed", "corrected", "relaxed", "violated", "fallback", "disabled", "stopped",
    }  # fmt: skip
    assert len({status.sentence for status in Status}) == 7
    assert all(status.sentence.endswith(".") for status in Status)


def test_time_comes_from_the_clock_given() -> None:
    ticks = iter((10.0, 12.0))
    settings = FilterSettings(action_low=(-1.0,), action_high=(1.0,), epsilon=0.0)
    safe = SafetyFilter(
        lambda x: (x, np.eye(1)), [FunctionBarrier(lambda x: 5.0 - x[0])], settings, clock=lambda: next(ticks)
    )
    verdict = safe.decide(np.zeros(1), [0.5])
    assert verdict.microseconds == 2e6
    assert verdict.as_dict() == {
        "action": [0.5], "status": "passed", "sentence": Status.passed.sentence, "slack": 0.0, "active": [],
        "h_now": 5.0, "h_next": 4.5, "margin": 0.0, "solver": "not needed", "microseconds": verdict.microseconds,
        "nominal": [0.5], "known": True,
    }  # fmt: skip


@pytest.mark.parametrize("nominal", [0.0, 5.0])
def test_a_barrier_of_ones_own_without_a_margin_says_so_until_a_margin_is_set(nominal: float) -> None:
    def verdict(epsilon: object, call: object = None) -> str:
        chosen = {} if epsilon is None else {"epsilon": epsilon}
        own = FilterSettings(action_low=(-1.0,), action_high=(1.0,), **chosen)
        safe = SafetyFilter(lambda x: (x, np.eye(1)), [FunctionBarrier(lambda x: 1.2 - x[0], kind="cliff")], own)
        return safe.decide([0.5], [nominal], epsilon=call).reason

    assert "No margin is set for barriers of kind cliff" in verdict(None)
    assert "No margin is set for barriers of kind cliff" in verdict({"obstacle": 0.1})
    for chosen in (0.0, 0.01, {"cliff": 0.0}, {"default": 0.0}):
        assert "No margin" not in verdict(chosen)
    assert "No margin" not in verdict(None, {"cliff": 0.0})
