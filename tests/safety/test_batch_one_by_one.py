"""The filter for many robots alongside the filter of each alone, with random motions and barriers of no robot."""

from dataclasses import replace
from math import inf
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from safedpa.dynamics import LearnedBase, load_model
from safedpa.dynamics.settings import Setting
from safedpa.effects import effect
from safedpa.errors import InputError
from safedpa.robots.car.barriers.batch import barriers_of_cars
from safedpa.robots.car.barriers.obstacles import ObstacleBarrier, braking_of, car_barriers
from safedpa.safety import CorridorBarrier, FilterSettings, FunctionBarrier, Prediction, SafetyFilter, Status
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.barriers.limits import SpeedBarrier
from safedpa.safety.batch import filter as batch
from safedpa.safety.batch.barriers import CompiledBatchBarriers, SequentialBarriers
from safedpa.safety.batch.constraints import solve_sqp_batch
from safedpa.safety.batch.filter import STATUSES, BatchFilter, BatchVerdicts
from safedpa.safety.batch.predictor import AffineBatchPredictor, BatchPredictor
from safedpa.safety.validation import Plausible
from safedpa.systems import System, Variable

Values = NDArray[np.float64]

SYSTEM = System(
    "drifter",
    (Variable("x", "m", -50.0, 50.0), Variable("y", "m", -50.0, 50.0), Variable("z", "m", -50.0, 50.0)),
    (Variable("push", "N", -3.0, 3.0), Variable("turn", "N", -3.0, 3.0)),
)
OWN = FilterSettings(
    action_low=(-1.0, 0.5), action_high=(3.0, 2.5), backup_action=(0.0, 1.0), weights=(1.0, 4.0), eta=0.3, epsilon=0.01
)
ROBOTS = 150


class Drawn:
    """Robots at random states that move by x+ = f + g a, h_i = p_i x + q_i - bend_i |x|^2 around each."""

    def __init__(self, seed: int, rows: int, bend: float) -> None:
        random = np.random.default_rng(seed)
        self.state = random.uniform(-1.0, 1.0, (ROBOTS, 3))
        self.nominal = random.uniform((-1.5, 0.2), (3.5, 2.8), (ROBOTS, 2))
        self.f = self.state + random.normal(0.0, 0.1, (ROBOTS, 3))
        self.g = random.normal(0.0, 1.0, (ROBOTS, 3, 2)) * random.choice([0.01, 1.0], (ROBOTS, 1, 1))
        self.p = random.normal(size=(ROBOTS, rows, 3)) * 10.0 ** random.uniform(-2.0, 2.0, (ROBOTS, rows, 1))
        size = (np.abs(self.p @ self.g) @ np.array([4.0, 2.0])) + np.abs(self.p).sum(axis=2) * 0.1
        self.bend = bend * size * random.uniform(0.0, 1.0, (ROBOTS, rows))
        now = size * random.uniform(-0.05, 0.8, (ROBOTS, rows))
        square = (self.state**2).sum(axis=1)[:, np.newaxis]
        self.q = now - np.einsum("nij,nj->ni", self.p, self.state) + self.bend * square
        if rows > 1:  # one of them is the same wherever the robot goes
            self.p[:20, -1], self.bend[:20, -1], self.q[:20, -1] = 0.0, 0.0, 5.0
        self.epsilon = {"function": random.choice([0.0, 0.005, 0.02], ROBOTS)}
        self.latent = np.zeros((ROBOTS, 2))
        self.names = tuple(f"h{row}" for row in range(rows))

    def barrier(self, robot: int) -> FunctionBarrier:
        """Around one of them."""
        p, q, bend = self.p[robot], self.q[robot], self.bend[robot]
        return FunctionBarrier(
            lambda x: p @ x + q - bend * (x @ x), lambda x: p - 2.0 * bend[:, np.newaxis] * x, self.names
        )

    def backup(self, robot: int) -> Values:
        """Another action for each."""
        return np.array([0.01 * robot, 1.0])

    def together(self) -> BatchVerdicts:
        """What the filter of many says."""
        around = SequentialBarriers([[self.barrier(robot)] for robot in range(ROBOTS)])
        return BatchFilter(SYSTEM, OWN).decide(
            self.state, self.nominal, barriers=around, epsilon=self.epsilon, affine=(self.f, self.g), backup=self.backup
        )

    def alone(self, robot: int) -> Any:
        """What the filter of one says."""
        believed = Plausible(SYSTEM.state_low, SYSTEM.state_high, SYSTEM.state_names)
        one = SafetyFilter(
            lambda _: (self.f[robot], self.g[robot]),
            [self.barrier(robot)],
            OWN,
            backup=lambda state: OWN.resting_action if state is None else self.backup(robot),
            state_range=believed,
        )
        margins = {kind: float(value[robot]) for kind, value in self.epsilon.items()}
        return one.decide(self.state[robot], self.nominal[robot], epsilon=margins)


@pytest.mark.long
@pytest.mark.parametrize(("rows", "bend"), [(1, 0.0), (4, 0.0), (1, 0.3), (3, 0.1), (1, 2.0), (2, 1.0)])
def test_everybody_gets_what_one_gets_and_only_what_is_out_of_the_ordinary_is_left_to_it(rows: int, bend: float):
    drawn = Drawn(rows, rows, bend)
    drawn.state[0, 0], drawn.nominal[1, 0], drawn.state[2, 1], drawn.nominal[3, 1] = np.nan, inf, 51.0, 1e4
    drawn.epsilon["function"][4:7] = -0.1, inf, np.nan
    found = drawn.together()
    for robot in range(ROBOTS):
        verdict = drawn.alone(robot)
        assert STATUSES[found.status[robot]] is verdict.status, robot
        np.testing.assert_allclose(found.action[robot], verdict.action, rtol=0.0, atol=1e-6)
        reported = found.slack[robot], found.h_now[robot], found.h_next[robot]
        np.testing.assert_allclose(reported, (verdict.slack, verdict.h_now, verdict.h_next), rtol=1e-9, atol=1e-6)
    ordinary = np.isin(found.status, [STATUSES.index(Status.passed), STATUSES.index(Status.corrected)])
    assert (~found.single <= ordinary).all()
    if bend == 0.0:  # the program says all, and has a closed form
        assert found.single.tolist() == (~ordinary).tolist()
    assert found.count(Status.fallback) >= 7
    assert min(found.count(Status.passed), found.count(Status.corrected), found.count(Status.violated)) > 5


def test_what_lies_on_a_limit_is_answered_with_the_others() -> None:
    """A state at the end of its range, an h of exactly 0, a margin of 0 and one in whole numbers."""
    names = ("left",)
    for state, epsilon in ((0.0, 0.0), (0.0, 0), (50.0, 0.01)):
        at = np.array([[state, 50.0, -50.0]] * 2)
        around = SequentialBarriers([[FunctionBarrier(lambda x, s=state: x[0] - s, names=names)]] * 2)
        g = np.zeros((2, 3, 2))
        g[:, 0, 0] = 0.1
        nominal = np.array([[1.0, 1.0], [-0.5, 1.0]])
        found = BatchFilter(SYSTEM, OWN).decide(
            at, nominal, barriers=around, epsilon={"function": epsilon, "default": 0.5, "obstacle": 0.5},
            affine=(at.copy(), g),
        )  # fmt: skip
        assert found.count(Status.passed) == 1
        assert found.count(Status.corrected) == 1
        assert not found.single.any()


def test_conditions_are_posed_with_the_scales_that_those_of_one_have(monkeypatch: pytest.MonkeyPatch) -> None:
    """max(|h|, epsilon), before any slope is known."""
    drawn, posed = Drawn(5, 3, 0.0), list[tuple[Values, Values]]()

    def searched(conditions: Any, nominal: Values, start: Any) -> Any:
        posed.append((conditions.scale.copy(), conditions.barriers.h(conditions.predictions.state)))
        return solve_sqp_batch(conditions, nominal, start)

    monkeypatch.setattr(batch, "solve_sqp_batch", searched)
    drawn.epsilon["function"] = np.full(ROBOTS, 0.2)
    drawn.together()
    ((scale, h),) = posed
    np.testing.assert_array_equal(scale, np.maximum(np.abs(h), 0.2))
    assert (scale > 0.2).any()
    assert (scale == 0.2).any()


def test_latents_say_nothing_where_there_is_no_model() -> None:
    drawn = Drawn(7, 2, 0.0)
    around = SequentialBarriers([[drawn.barrier(robot)] for robot in range(ROBOTS)])
    many, known = BatchFilter(SYSTEM, OWN), {"barriers": around, "affine": (drawn.f, drawn.g)}
    with_latent = many.decide(drawn.state, drawn.nominal, drawn.latent, **known)
    without = many.decide(drawn.state, drawn.nominal, **known)
    np.testing.assert_array_equal(with_latent.action, without.action)
    np.testing.assert_array_equal(with_latent.single, without.single)


def test_more_than_two_actions_are_refused() -> None:
    three = replace(SYSTEM, action=(*SYSTEM.action, Variable("lift", "N", -3.0, 3.0)))
    with pytest.raises(InputError, match="got 3 actions, wanted 1 or 2"):
        BatchFilter(three, replace(OWN, action_low=(0.0,) * 3, action_high=(1.0,) * 3, weights=(), backup_action=()))


@pytest.mark.parametrize("free", [(), ("wind.speed",)])
def test_a_model_of_one_latent_or_none(free: tuple[str, ...]) -> None:
    """Without what the model needs no one is answered, with what it does not believe neither; without need all are."""
    whole, settings = (
        load_model("pendulum"),
        FilterSettings(system="pendulum", action_low=(-10.0,), action_high=(10.0,)),
    )
    held = {name: Setting(0.0) for name in whole.latent_names if name not in free}
    model = whole.with_settings(held)
    assert model.latent_names == free
    state, nominal = np.array([[0.1, 0.0]] * 3), np.array([[0.0], [1e6], [1.0]])
    around = SequentialBarriers([[CorridorBarrier(-3.0, 3.0, 0.25)]] * 3)
    many = BatchFilter(model, settings)
    found = many.decide(state, nominal, barriers=around)
    assert found.single.tolist() == ([True] * 3 if free else [False, True, False])
    assert found.count(Status.fallback) == (3 if free else 1)
    reported = many.decide(state, nominal, np.array([[1e6]] * 3)[:, : len(free)], barriers=around)
    assert reported.count(Status.fallback) == (3 if free else 1)


MODELS = {
    "car": lambda: load_model("car"),
    "car_learned": lambda: load_model("car_learned"),
    "over another period": lambda: load_model("car_learned").with_period(0.12),
    "with an effect": lambda: load_model("car_learned").with_effect(effect("car", "quadratic_drag"), {}),
    "fixed": lambda: load_model("car_learned").with_settings(
        {name: Setting(0.1) for name in load_model("car_learned").latent_names}
    ),
}


@pytest.mark.parametrize("name", MODELS)
def test_predictions_and_slopes_are_those_of_one(name: str) -> None:
    model, random = MODELS[name](), np.random.default_rng(2)
    one = Prediction.of_model(model)
    state = random.uniform((-1.0, -1.0, -3.0, 0.2), (1.0, 1.0, 3.0, 1.5), (20, 4))
    action = random.uniform((0.1, -0.3), (1.9, 0.3), (20, 2))
    latent = model.latent * random.uniform(0.8, 1.2, (20, len(model.latent)))
    given = latent if len(model.latent_names) else None
    many = BatchPredictor(model, state, given)
    assert many.affine is one.affine
    some = many.only(np.array([3, 11]))
    for robot in range(20):
        own = None if given is None else latent[robot]
        np.testing.assert_allclose(
            many.next_state(action)[robot], one.next_state(state[robot], action[robot], own, None), atol=1e-6
        )
        slopes = one.control_matrix(state[robot], action[robot], own, None)
        np.testing.assert_allclose(many.control_matrix(action)[robot], slopes, atol=1e-6)
    np.testing.assert_allclose(some.next_state(action[[3, 11]]), many.next_state(action)[[3, 11]], atol=1e-6)
    assert some.affine is many.affine


def test_networks_are_asked_once_for_all_actions(monkeypatch: pytest.MonkeyPatch) -> None:
    model, asked = load_model("car_learned"), list[Values]()
    assert isinstance(model.base, LearnedBase)
    networks = type(model.base.networks)
    increment = networks.increment

    def counted(self: Any, state: Values, latent: Values) -> Any:
        asked.append(state)
        return increment(self, state, latent)

    monkeypatch.setattr(networks, "increment", counted)
    state = np.zeros((5, 4))
    many = BatchPredictor(model, state, np.tile(model.latent, (5, 1)))
    for action in (np.zeros((5, 2)), np.full((5, 2), 0.1)):
        many.next_state(action)
        many.control_matrix(action)
        many.only(np.array([1])).next_state(action[:1])
    assert len(asked) == 1


def test_what_is_given_as_f_and_g_is_affine() -> None:
    f, g = np.ones((2, 3)), np.zeros((2, 3, 2))
    known = AffineBatchPredictor(f, f, g)
    assert known.affine
    known.control_matrix(np.zeros((2, 2)))[:] = 1.0
    assert not known.g.any()


def test_barriers_that_differ_between_robots_are_refused() -> None:
    """By kind, by number, and by whether they may be used up at once; though one robot alone differs."""
    corridor, speed = CorridorBarrier(-1.0, 1.0, 0.2), SpeedBarrier(-0.5, 1.0)
    few = [
        ObstacleBarrier([(1.0, 0.0, 0.1)] * count, (0.1, 0.1, 0.1), braking_of(FilterSettings.for_robot("car")))
        for count in (1, 2)
    ]
    for parts in ([[speed], [speed], [corridor]], [[few[0]], [few[0]], [few[1]]]):
        with pytest.raises(InputError, match="got others for one robot than for another"):
            CompiledBatchBarriers.of(parts, 4)
        with pytest.raises(InputError, match="got others for one robot than for another"):
            SequentialBarriers(parts)
    patient, hasty = (FunctionBarrier(lambda x: 1.0) for _ in range(2))
    hasty.at_once = True
    with pytest.raises(InputError, match="used up at once for one robot"):
        SequentialBarriers([[patient], [patient], [hasty]])


def bodies(random: np.random.Generator, cars: int) -> Values:
    """Footprints (cars, 3), a disc of no radius the first."""
    found = np.c_[random.uniform(0.0, 0.2, (cars, 2)), random.uniform(0.0, 0.2, cars)]
    found[0] = (-0.1, 0.1, 0.0)
    return found


@pytest.mark.parametrize("walls", [False, True])
def test_many_cars_have_the_barriers_of_each(walls: bool) -> None:
    random, cars, settings = np.random.default_rng(5), 12, FilterSettings.for_robot("car")
    table = np.c_[random.uniform(-2.0, 2.0, (cars * 3, 2)), random.uniform(0.0, 0.3, cars * 3)].reshape(cars, 3, 3)
    body = bodies(random, cars)
    field = np.c_[random.uniform(-4.0, -2.0, cars), random.uniform(2.0, 4.0, cars)][:, [0, 1, 0, 1]] if walls else None
    state = random.uniform((-1.0, -1.0, -3.0, -0.5), (1.0, 1.0, 3.0, 1.5), (cars, 4))
    g = random.normal(size=(cars, 4, 2))
    many = barriers_of_cars(settings, table, body, field)
    h, slopes = many.h(state), many.lie_derivative(state, g, np.ones(2))
    for car in range(cars):
        own: list[AbstractBarrier] = car_barriers(
            settings, body[car], table[car], None if field is None else field[car]
        )
        wanted = [part.h_and_grad(state[car]) for part in own]
        assert many.kinds == tuple(part.kind for part in own for _ in part.names)
        np.testing.assert_allclose(h[car], np.concatenate([values for values, _ in wanted]), atol=1e-12)
        along = np.concatenate([gradient for _, gradient in wanted]) @ g[car]
        np.testing.assert_allclose(slopes[car], along, atol=1e-11)
        again = np.concatenate([part.h(state[car]) for part in many.one(car)])
        np.testing.assert_allclose(again, h[car], atol=1e-12)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"footprint": (0.1, 0.1, -0.1)}, "negative radius"),
        ({"footprint": (-0.2, 0.1, 0.3)}, "front behind"),
        ({"footprint": (0.1, np.nan, 0.1)}, "footprint: got shape"),
        ({"field": (1.0, 1.0, -1.0, 1.0)}, "field: got an empty one"),
        ({"field": (-1.0, 1.0, 1.0, 1.0)}, "field: got an empty one"),
        ({"field": (-1.0, 1.0, np.inf, 1.0)}, "field: got shape"),
        ({"obstacles": [(1.0, np.nan, 0.1)]}, "obstacles: got NaN"),
        ({"obstacles": [(1.0, 1.0, -0.1)]}, "obstacles: got NaN, infinity or a negative radius"),
    ],
)
def test_what_is_wrong_around_one_car_of_three_is_refused(wrong: dict[str, Any], message: str) -> None:
    right = {"obstacles": [(1.0, 0.0, 0.1)], "footprint": (0.1, 0.1, 0.1), "field": (-2.0, 2.0, -2.0, 2.0)}
    tables = {name: np.array([value, {**right, **wrong}[name], value]) for name, value in right.items()}
    barriers_of_cars(FilterSettings.for_robot("car"), **{name: np.array([value] * 3) for name, value in right.items()})
    with pytest.raises(InputError, match=message):
        barriers_of_cars(FilterSettings.for_robot("car"), **tables)
