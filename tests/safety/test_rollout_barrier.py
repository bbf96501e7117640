"""A barrier from a backup: relative degree two and four, thin obstacles, any unit, and its gradient."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from safedpa.dynamics import load_model
from safedpa.effects import effect
from safedpa.errors import InputError
from safedpa.robots.car.barriers.obstacles import ObstacleBarrier
from safedpa.safety import (
    AbstractBarrier,
    FilterSettings,
    FunctionBarrier,
    PendingActions,
    RolloutBarrier,
    SafetyFilter,
    Status,
)
from safedpa.safety.barriers.stopping import STEP_SECONDS, STEPS, Braking, Motion, StoppingBarrier, stopping_action

PERIOD = 0.05
A = np.eye(4) + PERIOD * np.eye(4, k=2)
B = np.vstack((0.5 * PERIOD**2 * np.eye(2), PERIOD * np.eye(2)))
DISCS = np.array([[1.5, 0.2, 0.4], [2.5, -0.8, 0.4], [1.0, 1.5, 0.4]])
NAMES = ("a", "b", "c")
SETTINGS = FilterSettings(action_low=(-1.0, -1.0), action_high=(1.0, 1.0), eta=0.2, epsilon=0.002)


def affine(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two masses, one along each axis: position answers to the action's second integral."""
    return A @ x, B


def brake(x: np.ndarray) -> np.ndarray:
    return np.clip(-x[2:] / PERIOD, -1.0, 1.0)


def room(x: np.ndarray) -> np.ndarray:
    """Relative degree two: distance less radius."""
    return np.hypot(*(DISCS[:, :2] - x[:2]).T) - DISCS[:, 2]


def rollout(horizon: int = 40) -> RolloutBarrier:
    return RolloutBarrier(affine, brake, room, horizon, NAMES)


def drive(barrier: AbstractBarrier, seed: int, ticks: int) -> tuple[float, set[Status]]:
    """Least room on the way of a robot that is driven at the discs, and what the filter said."""
    random, x, least = np.random.default_rng(seed), np.zeros(4), np.inf
    safe, notice = SafetyFilter(affine, [barrier], SETTINGS, backup=brake), set()
    for tick in range(ticks):
        if tick % 40 == 0:
            target = DISCS[random.integers(3), :2] + 0.1 * random.normal(size=2)
        nominal = np.clip(3.0 * (target - x[:2]) - 0.2 * x[2:] + random.normal(size=2), -1.0, 1.0)
        verdict = safe.decide(x, nominal)
        notice.add(verdict.status)
        x = A @ x + B @ verdict.action
        least = min(least, float(room(x).min()))
    return least, notice


@pytest.mark.long
def test_with_relative_degree_two_nothing_is_hit_and_nothing_relaxed() -> None:
    plain = [drive(FunctionBarrier(room, names=NAMES), seed, 150)[0] for seed in range(10)]
    assert sum(least < 0.0 for least in plain) >= 4, "the plain distance is no barrier of such a robot"
    for seed in range(5):
        least, notice = drive(rollout(), seed, 120)
        assert least >= 0.0
        assert notice <= {Status.passed, Status.corrected}


def test_the_backup_keeps_every_condition_wherever_it_is_promised() -> None:
    random, barrier, tried = np.random.default_rng(3), rollout(), 0
    safe = SafetyFilter(affine, [barrier], SETTINGS, backup=barrier.backup)
    while tried < 100:
        x = np.r_[random.uniform((0.0, -1.5), (3.0, 2.0)), random.uniform(-1.2, 1.2, 2)]
        if barrier.h(x).min() < SETTINGS.epsilon["default"] / SETTINGS.eta:
            continue
        tried += 1
        assert safe.decide(x, barrier.backup(x)).status is Status.passed


def test_it_is_the_least_value_of_the_dense_path() -> None:
    random, barrier = np.random.default_rng(5), rollout()
    for _ in range(20):
        x = np.r_[random.uniform((0.0, -1.5), (3.0, 2.0)), random.uniform(-1.5, 1.5, 2)]
        path = np.array(barrier.path(x))
        chords = [path[:-1] + share * np.diff(path, axis=0) for share in np.linspace(0.0, 1.0, 101)]
        dense = np.min([room(state) for state in np.concatenate(chords)], axis=0)
        np.testing.assert_array_less(barrier.h(x), dense + 1e-12)
        np.testing.assert_allclose(barrier.h(x), dense, atol=1e-5)


HOVER = 0.03


def quadrotor(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x, z, tilt, their rates; thrust acceleration beyond hovering [m/s2] and angular acceleration [rad/s2]."""
    f = x + HOVER * np.array([*x[3:], -9.81 * np.sin(x[2]), 9.81 * (np.cos(x[2]) - 1.0), 0.0])
    g = np.zeros((6, 2))
    g[3:5, 0] = HOVER * np.array([-np.sin(x[2]), np.cos(x[2])])
    g[5, 1] = HOVER
    return f, g


def level_out(x: np.ndarray) -> np.ndarray:
    """Tilts against the speed, then levels: comes to rest within two seconds."""
    tilt = np.clip(0.25 * x[3], -0.5, 0.5)
    return np.clip(np.array([-3.0 * x[4], 60.0 * (tilt - x[2]) - 14.0 * x[5]]), [-4.0, -30.0], [6.0, 30.0])


def pillar(x: np.ndarray) -> np.ndarray:
    return np.array([np.hypot(x[0] - 2.0, x[1] - 0.3) - 0.5, x[1] + 2.0])


@pytest.mark.long
def test_a_planar_quadrotor_is_kept_off_by_its_tilt() -> None:
    """Sideways, h answers to the torque's fourth integral."""
    barrier = RolloutBarrier(quadrotor, level_out, pillar, 130, ("pillar", "ground"))
    limits = FilterSettings(action_low=(-4.0, -30.0), action_high=(6.0, 30.0), eta=0.2, epsilon=0.004)
    hits = {True: 0, False: 0}
    for filtered in (False, True):
        for seed in range(2):
            random, x = np.random.default_rng(seed), np.zeros(6)
            safe = SafetyFilter(quadrotor, [barrier], limits, backup=barrier.backup)
            least = np.inf
            for _ in range(70):
                tilt = np.clip(-0.4 * (2.0 - x[0]) + 0.2 * x[3], -0.4, 0.4) + 0.1 * random.normal()
                nominal = np.array([2.0 * (0.3 - x[1]) - x[4], 60.0 * (tilt - x[2]) - 14.0 * x[5]])
                nominal = np.clip(nominal, limits.low, limits.high)
                verdict = safe.decide(x, nominal) if filtered else None
                f, g = quadrotor(x)
                x = f + g @ (nominal if verdict is None else verdict.action)
                least = min(least, float(pillar(x).min()))
                assert verdict is None or verdict.status in (Status.passed, Status.corrected)
            hits[filtered] += least < 0.0
    assert hits == {True: 0, False: 2}


THIN = np.array([1.0, 0.0])


def jumping(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The action is the way of one tick, up to half a metre along each axis."""
    return np.array(x), np.eye(2)


def past_thin(x: np.ndarray) -> np.ndarray:
    """A place, or many of them (..., 2)."""
    return np.hypot(*(x - THIN).T) - 0.1


def least_between_ticks(barrier: AbstractBarrier, seed: int) -> float:
    random = np.random.default_rng(seed)
    x, least = random.uniform(-0.5, 0.5, 2), np.inf
    limits = FilterSettings(action_low=(-0.5, -0.5), action_high=(0.5, 0.5), eta=0.5, epsilon=0.005)
    safe = SafetyFilter(jumping, [barrier], limits)
    for _ in range(14):
        nominal = np.clip(3.0 * (THIN + 0.3 * random.normal(size=2) - x), -0.5, 0.5)
        verdict = safe.decide(x, nominal)
        assert verdict.status in (Status.passed, Status.corrected)
        way = x + np.linspace(0.0, 1.0, 101)[:, np.newaxis] * verdict.action
        least = min(least, float(past_thin(way).min()))
        x = x + verdict.action
    return least


def test_what_is_thinner_than_a_tick_is_not_jumped_over() -> None:
    plain = [least_between_ticks(FunctionBarrier(past_thin), seed) for seed in range(20)]
    assert sum(least < 0.0 for least in plain) >= 10, "h at the ticks alone does not see it"
    looked = [least_between_ticks(RolloutBarrier(jumping, (0.0, 0.0), past_thin, 1), seed) for seed in range(80)]
    assert sum(least < 0.0 for least in looked) == 0


@hypothesis_settings(max_examples=15, deadline=None, derandomize=True, database=None)
@given(st.integers(0, 10**6), st.integers(-6, 6), st.integers(-6, 6), st.integers(-6, 6), st.integers(-6, 6))
@example(300, -6, 6, 0, 5)  # twelve decades between two entries: what one moves looks like the other's rounding
def test_another_unit_changes_nothing_but_the_unit(seed: int, place: int, speed: int, push: int, height: int) -> None:
    random = np.random.default_rng(seed)
    x = np.r_[random.uniform((0.0, -1.5), (3.0, 2.0)), random.uniform(-1.2, 1.2, 2)]
    unit, push_unit, height_unit = np.repeat((10.0**place, 10.0**speed), 2), 10.0**push, 10.0**height
    reported = RolloutBarrier(
        lambda y: (unit * affine(y / unit)[0], unit[:, np.newaxis] * B / push_unit),
        lambda y: push_unit * brake(y / unit),
        lambda y: height_unit * room(y / unit),
        40,
        NAMES,
    )
    origin = x + 0.02 * random.normal(size=4)
    h, gradient = rollout().starting_at(origin).h_and_grad(x)
    other, slopes = reported.starting_at(unit * origin).h_and_grad(unit * x)
    np.testing.assert_allclose(other / height_unit, h, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(slopes * unit / height_unit, gradient, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_gradients_at_rest_where_nothing_gives_the_size_of_a_step(unit: float) -> None:
    reported = RolloutBarrier(
        lambda y: (unit * affine(y / unit)[0], unit * B), lambda y: brake(y / unit), lambda y: room(y / unit), 40, NAMES
    )
    gradient = reported.h_and_grad(np.zeros(4))[1] * unit
    towards = -DISCS[:, :2] / np.hypot(*DISCS[:, :2].T)[:, np.newaxis]
    np.testing.assert_allclose(gradient[:, :2], towards, atol=1e-6)


def differences(barrier: AbstractBarrier, x: np.ndarray, step: float = 1e-6) -> np.ndarray:
    nudges = step * np.eye(len(x))
    return np.array([(barrier.h(x + nudge) - barrier.h(x - nudge)) / (2.0 * step) for nudge in nudges]).T


def test_the_gradient_is_that_of_its_values() -> None:
    random, agreed = np.random.default_rng(8), 0
    for _ in range(30):
        x = np.r_[random.uniform((0.0, -1.5), (3.0, 2.0)), random.uniform(-1.2, 1.2, 2)]
        barrier = rollout().starting_at(x - 0.02 * random.normal(size=4))
        agreed += np.abs(barrier.h_and_grad(x)[1] - differences(barrier, x)).max() < 1e-6
    assert agreed >= 27, "all but where the backup's limits make a kink"


def test_slopes_along_directions_are_those_of_the_gradient() -> None:
    random, discs = np.random.default_rng(2), ObstacleBarrier([(2.0, 0.3, 0.3)], (0.1, 0.4, 0.1), Braking(2.0, 2.5))
    exact = RolloutBarrier(load_model("car"), (0.0, 0.0), discs, 40)
    still = np.zeros((4, 1))
    for whole in (rollout(), exact):
        agreed = 0
        for _ in range(20):
            x = np.r_[random.uniform((0.0, -1.5), (3.0, 2.0)), random.uniform(-1.2, 1.2, 2)]
            directions = np.hstack((0.05 * random.normal(size=(4, 2)), still))
            for barrier in (whole, whole.starting_at(x - 0.02 * random.normal(size=4))):
                along = barrier.lie_derivative(x, directions)
                np.testing.assert_array_equal(along[:, 2], 0.0)
                agreed += np.abs(along - barrier.h_and_grad(x)[1] @ directions).max() < 1e-6
        assert agreed >= 36, "all but where the backup's limits make a kink"


def test_recorded_equations_and_differences_give_one_gradient() -> None:
    model, random = load_model("car"), np.random.default_rng(0)
    discs = ObstacleBarrier([(2.0, 0.3, 0.3), (1.2, -1.0, 0.25)], (0.08, 0.4, 0.12), Braking(2.0, 2.5), 0.05)
    exact = RolloutBarrier(model, (0.0, 0.0), discs, 40)
    near = RolloutBarrier(model, (0.0, 0.0), FunctionBarrier(discs.h, names=discs.names), 40)
    assert exact.loop.sensitivities(exact.path(np.zeros(4))) is not None
    assert exact.names == discs.names
    assert exact.kind == "obstacle"
    for _ in range(25):
        x = random.uniform((-1, -1, -3, -0.5), (1, 1, 3, 2))
        origin = x - 0.05 * random.normal(size=4)
        one, other = exact.starting_at(origin).h_and_grad(x), near.starting_at(origin).h_and_grad(x)
        np.testing.assert_array_equal(one[0], other[0])
        np.testing.assert_allclose(one[1], other[1], atol=1e-6)
        latent = RolloutBarrier(model, (0.0, 0.0), discs, 40, latent=model.latent)
        np.testing.assert_array_equal(latent.h_and_grad(x)[1], exact.h_and_grad(x)[1])


def test_it_looks_past_a_delay() -> None:
    """Three actions in flight: the path of the backup begins with them."""
    late = PendingActions(affine, 3, (0.0, 0.0))
    barrier = RolloutBarrier(
        late.prediction, lambda xi: brake(late.state_at_effect(xi)), lambda xi: room(late.split(xi)[0]), 44, NAMES
    )
    for seed in range(2):
        random, x = np.random.default_rng(seed), np.zeros(4)
        xi, safe = late.state(x), SafetyFilter(late.prediction, [barrier], SETTINGS, backup=barrier.backup)
        for _ in range(60):
            nominal = np.clip(3.0 * (DISCS[0, :2] - x[:2]) + random.normal(size=2), -1.0, 1.0)
            verdict = safe.decide(xi, nominal)
            assert verdict.status in (Status.passed, Status.corrected)
            x = A @ x + B @ late.split(xi)[1][0]
            xi = late.next_state(xi, verdict.action, x)
            assert room(x).min() >= 0.0


@pytest.mark.parametrize("horizon", [0, 1.5, True, "4", None])
def test_a_horizon_is_a_number_of_ticks(horizon: object) -> None:
    with pytest.raises(InputError, match="wanted a whole number of ticks"):
        RolloutBarrier(affine, brake, room, horizon)  # type: ignore[arg-type]


def test_what_cannot_be_rolled_out_is_named() -> None:
    slow = load_model("car").with_effect(effect("car", "steering_delay"), {})
    cases: list[tuple[Callable[[], object], str]] = [
        (lambda: RolloutBarrier(slow, (0.0, 0.0), room, 5), "with actuator memory"),
        (lambda: RolloutBarrier(3, (0.0, 0.0), room, 5), "wanted a model"),  # type: ignore[arg-type]
        (lambda: RolloutBarrier(affine, (np.nan, 0.0), room, 5), "backup: got"),
        (lambda: RolloutBarrier(affine, lambda x: 1.0, room, 5, NAMES).h(np.zeros(4)), "backup: got shape"),
        (lambda: RolloutBarrier(lambda x, a: x[:3], (0.0, 0.0), room, 5).h(np.zeros(4)), "predicted state"),
        (lambda: RolloutBarrier(lambda x, a: x * np.nan, (0.0,), room, 5).h(np.zeros(4)), "NaN or infinity"),
        (lambda: rollout().backup(None), "got no state"),
    ]
    for made, notice in cases:
        with pytest.raises(InputError, match=notice):
            made()
    np.testing.assert_array_equal(RolloutBarrier(affine, (0.5, 0.0), room, 5, NAMES).backup(None), [0.5, 0.0])


def test_a_user_function_cannot_write_into_what_the_next_one_sees() -> None:
    def careless(x: np.ndarray) -> np.ndarray:
        x[0] = 100.0
        return room(x)

    with pytest.raises(ValueError, match="read-only"):
        RolloutBarrier(affine, brake, careless, 5, NAMES).h(np.zeros(4))


@pytest.mark.parametrize(("speed", "end"), [(0.5, -1.0), (-0.5, 1.0)])
def test_the_point_robot_stops_in_about_half_a_second_without_overshooting(speed: float, end: float) -> None:
    """Integrated in steps of 1 ms from 0.5 m/s: slower, and h would hold a robot back from everything far around it."""
    motion, x, seconds = Motion(np.zeros(2), 0.0, 9.0, 3.0), np.array([0.0, 0.0, 0.0, speed, 0.0]), 0.0
    way = abs(StoppingBarrier(np.array([[9.0, 0.0, 0.0]]), motion).h(x)[0] - 9.0)
    while abs(x[3]) > 0.05 * abs(speed):
        thrust, _ = stopping_action(x[:, np.newaxis], motion, np.array([end]))
        x[0], x[3], seconds = x[0] + 0.001 * x[3], x[3] + 0.001 * float(thrust[0]), seconds + 0.001
        assert x[3] * speed > 0.0
    assert 0.2 < seconds < 0.8
    assert speed < 0.0 or way == pytest.approx(x[0], abs=0.01), "the barrier foresees that way"


def test_the_point_robots_stopping_manoeuvre_is_a_rollout() -> None:
    """The same path, hence the same room at its ticks; between them the rollout sees a little more."""
    motion, hazards = Motion(np.array([0.7, -0.4]), 1.9, 2.9, 3.0), np.array([[0.4, 0.0, 0.2], [-0.5, 0.3, 0.2]])
    stopping, random = StoppingBarrier(hazards, motion), np.random.default_rng(6)

    def step(x: np.ndarray, a: np.ndarray) -> np.ndarray:
        middle = x[2] + 0.5 * STEP_SECONDS * a[1]
        push = a[0] * np.array([np.cos(middle), np.sin(middle)]) + motion.wind - motion.drag * x[3:]
        place = x[:2] + STEP_SECONDS * (x[3:] + 0.5 * STEP_SECONDS * push)
        return np.array([*place, x[2] + STEP_SECONDS * a[1], *(x[3:] + STEP_SECONDS * push)])

    def room_left(x: np.ndarray) -> np.ndarray:
        return np.hypot(*(hazards[:, :2] - x[:2]).T) - hazards[:, 2]

    def rolled(end: float) -> RolloutBarrier:
        """Nose first or tail first."""
        return RolloutBarrier(
            step,
            lambda x: np.concatenate(stopping_action(x[:, np.newaxis], motion, np.array([end]))),
            room_left,
            STEPS,
            ("hazard 0", "hazard 1"),
        )

    for _ in range(40):
        x = np.array([*random.uniform(-0.8, 0.8, 2), random.uniform(-3.0, 3.0), *random.uniform(-0.8, 0.8, 2)])
        barrier = rolled(stopping.best_end(x))
        at_ticks = np.min([room_left(state) for state in barrier.path(x)], axis=0)
        np.testing.assert_allclose(at_ticks, stopping.h(x), atol=1e-9)
        np.testing.assert_array_less(barrier.h(x), at_ticks + 1e-12)
        np.testing.assert_allclose(barrier.h(x), at_ticks, atol=4e-3)
