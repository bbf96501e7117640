"""The filter for many robots alongside the filter for one, which is the reference."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.robots.car.barriers.batch import barriers_of_cars
from safedpa.robots.car.barriers.moving_obstacles import MovingObstacleBarrier
from safedpa.robots.car.barriers.obstacles import ObstacleBarrier, braking_of, car_barriers
from safedpa.robots.car.dynamics.limits import ReversalBraking
from safedpa.safety import AbstractBarrier, CorridorBarrier, FilterSettings, FunctionBarrier, SafetyFilter, Status
from safedpa.safety.barriers.limits import SpeedBarrier
from safedpa.safety.batch.barriers import SequentialBarriers, batch_barriers
from safedpa.safety.batch.filter import STATUSES, BatchFilter, BatchVerdicts
from safedpa.safety.defaults import settings_named

FOOTPRINT = (0.08, 0.40, 0.12)
FIELD = (-4.0, 4.0, -4.0, 4.0)
FILTERS = {name: BatchFilter(load_model(name)) for name in ("car", "car_measured", "car_learned")}
WITHIN = {"car": 1e-6, "car_measured": 1e-6, "car_learned": 1e-5}
"""Networks of many rows at once round differently: float32 has seven digits."""


def drawn(seed: int, robots: int, obstacles: int, latent: np.ndarray[Any, Any]) -> dict[str, Any]:
    random = np.random.default_rng(seed)
    return {
        "state": random.uniform((-3.4, -3.4, -3.1, -0.6), (3.4, 3.4, 3.1, 2.0), (robots, 4)),
        "nominal": random.uniform((-0.6, -0.34), (2.0, 0.34), (robots, 2)) * random.choice([1.0, 1.4], (robots, 1)),
        "latent": np.tile(latent, (robots, 1)),
        "obstacles": np.stack(
            [*random.uniform(-3.5, 3.5, (2, robots, obstacles)), random.uniform(0.2, 0.35, (robots, obstacles))], axis=2
        ),
    }


def decided(
    many: BatchFilter, *, obstacles: Any, footprint: Any = FOOTPRINT, field: Any = None,
    epsilon: dict[str, Any] | None = None, **inputs: Any,
) -> BatchVerdicts:  # fmt: skip
    return many.decide(**inputs, barriers=barriers_of_cars(many.settings, obstacles, footprint, field), epsilon=epsilon)


def agree(name: str, given_: dict[str, Any], walls: bool, epsilon: dict[str, Any] | None = None) -> BatchFilter:
    many = FILTERS[name]
    field = FIELD if walls else None
    found = decided(many, **given_, footprint=FOOTPRINT, field=field, epsilon=epsilon)
    one = SafetyFilter.for_model(many.model, many.settings)
    for robot in range(len(found.action)):
        barriers = car_barriers(many.settings, FOOTPRINT, given_["obstacles"][robot], field)
        margins = {kind: float(np.resize(value, len(found.action))[robot]) for kind, value in (epsilon or {}).items()}
        verdict = one.decide(
            *(given_[key][robot] for key in ("state", "nominal", "latent")), barriers=barriers, epsilon=margins
        )
        assert STATUSES[found.status[robot]] is verdict.status
        np.testing.assert_allclose(found.action[robot], verdict.action, rtol=0.0, atol=WITHIN[name])
        for numbers, number in (
            (found.slack, verdict.slack),
            (found.h_now, verdict.h_now),
            (found.h_next, verdict.h_next),
        ):
            assert numbers[robot] == pytest.approx(number, abs=1e-6)
    return many


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    name=st.sampled_from(tuple(FILTERS)),
    obstacles=st.sampled_from((0, 1, 3, 8)),
    walls=st.booleans(),
)
def test_everybody_gets_what_the_filter_of_one_robot_gives(seed: int, name: str, obstacles: int, walls: bool) -> None:
    agree(name, drawn(seed, 12, obstacles, FILTERS[name].model.latent), walls)


def test_where_an_actuator_saturates_the_nearest_action_is_looked_for_as_well() -> None:
    """There the slope is a chord's, and the action that it leads to may lie further from the nominal action than need
    be."""
    random = np.random.default_rng(8)
    given_ = drawn(8, 300, 6, FILTERS["car"].model.latent)
    given_["state"][:, 3], given_["nominal"] = random.uniform(0.5, 2.0, 300), np.tile([2.0, 0.0], (300, 1))
    agree("car", given_, True, {"obstacle": random.uniform(0.01, 0.07, 300), "field": 0.05})


def test_most_are_answered_together_and_every_kind_of_verdict_occurs() -> None:
    many = FILTERS["car"]
    found = decided(many, **drawn(0, 400, 6, many.model.latent), footprint=FOOTPRINT, field=FIELD)
    for status in (Status.passed, Status.corrected, Status.violated):
        assert found.count(status) > 10
    together = ~found.single
    assert together.mean() > 0.6
    assert set(found.status[together].tolist()) == {STATUSES.index(Status.passed), STATUSES.index(Status.corrected)}


def test_what_cannot_be_believed_ends_in_the_fallback_of_its_own_robot() -> None:
    many = FILTERS["car"]
    given_ = drawn(1, 8, 2, many.model.latent)
    given_["state"][0, 0], given_["nominal"][1, 1], given_["latent"][2, 0] = np.nan, np.inf, -5.0
    given_["state"][3, 3], given_["nominal"][4, 0] = 1e6, 1e6
    epsilon = {"obstacle": np.array([0.01, 0.01, 0.01, 0.01, 0.01, np.nan, -0.1, 0.01])}
    with np.errstate(all="raise"):
        found = decided(many, **given_, footprint=FOOTPRINT, field=FIELD, epsilon=epsilon)
    assert [STATUSES[index] is Status.fallback for index in found.status] == [True] * 7 + [False]
    np.testing.assert_array_equal(found.action[:7], np.zeros((7, 2)))


def test_a_margin_for_a_kind_that_no_barrier_has_is_refused_as_for_one_robot() -> None:
    given_ = drawn(2, 4, 2, FILTERS["car"].model.latent)
    for epsilon in ({"obstacel": 0.3}, {"obstacle": True}):
        found = decided(FILTERS["car"], **given_, epsilon=epsilon)
        assert found.count(Status.fallback) == 4
    agree("car", given_, walls=False, epsilon={"mover": 0.3, "default": 0.0})


@pytest.mark.parametrize(
    ("margin", "fallbacks"),
    [(True, 3), ("1.0", 3), (np.array([2.0, True, 2.0], dtype=object), 1), (1, 0), (np.ones(3), 0)],
)
def test_what_is_no_number_is_no_margin_even_where_as_one_it_would_be_kept(margin: Any, fallbacks: int) -> None:
    """With obstacles a hundred metres away every nominal action keeps a margin of a metre."""
    given_ = {**drawn(2, 3, 1, FILTERS["car"].model.latent), "obstacles": np.full((3, 1, 3), (100.0, 0.0, 0.2))}
    given_["state"][:, 3] = 0.5
    given_["nominal"][:] = 0.5, 0.0
    found = decided(FILTERS["car"], **given_, epsilon={"obstacle": margin, "speed": 0.0})
    assert found.count(Status.fallback) == fallbacks
    assert found.count(Status.passed) == 3 - fallbacks


def test_what_is_predicted_comes_from_a_model_or_with_each_decision_and_not_from_both() -> None:
    model = FILTERS["car"].model
    given_ = drawn(0, 2, 1, model.latent)
    barriers = barriers_of_cars(FilterSettings.for_robot("car"), given_.pop("obstacles"), FOOTPRINT)
    affine = np.zeros((2, 4)), np.zeros((2, 4, 2))
    notice = "affine: wanted f and g of each robot where the filter has no model, and nothing where it has"
    with pytest.raises(InputError, match=notice):
        FILTERS["car"].decide(**given_, barriers=barriers, affine=affine)
    without = BatchFilter(model.system)
    with pytest.raises(InputError, match=notice):
        without.decide(**given_, barriers=barriers)
    assert len(without.decide(**given_, barriers=barriers, affine=affine).status) == 2


def test_a_predicted_state_that_is_no_number_passes_no_nominal_action_though_no_barrier_reads_it() -> None:
    own = FunctionBarrier(lambda x: 1.0 - x[0], names=("x",))
    many, robots = BatchFilter(load_model("car").system, replace(FilterSettings.for_robot("car"), epsilon={})), 3
    state, g = np.tile((0.95, 0.0, 0.0, 0.0), (robots, 1)), np.zeros((robots, 4, 2))
    g[:, 0, 0] = 0.01
    f = state.copy()
    f[1, 2], f[2, 2] = np.nan, np.inf
    for nominal in (-0.5, 1.9):
        found = many.decide(
            state, np.full((robots, 2), (nominal, 0.0)), barriers=batch_barriers([[own]] * robots, 4), affine=(f, g)
        )
        wanted = Status.passed if nominal < 0.0 else Status.corrected
        assert [STATUSES[index] for index in found.status] == [wanted, Status.fallback, Status.fallback]


@pytest.mark.parametrize("slowly", [False, True])
def test_what_may_be_used_up_at_once_may_be_so_by_many(slowly: bool) -> None:
    """In one function and one by one: as the filter of one robot has it."""
    settings = settings_named("car")
    braking, counter = braking_of(settings), ReversalBraking(2.0, 2.5, 0.6)
    state = np.array([(0.0, 0.0, 0.0, 0.8), (0.1, 0.0, 0.0, 0.8)])
    nominal, latent = np.tile((1.2, 0.0), (2, 1)), np.tile(FILTERS["car"].model.latent, (2, 1))
    discs = [[(ahead, 0.0, 0.1, 1.5)] for ahead in (1.5, 1.8)]
    parts: list[list[AbstractBarrier]] = [
        [MovingObstacleBarrier(disc, [False], FOOTPRINT, braking, counter), SpeedBarrier(-0.8, 2.2)] for disc in discs
    ]
    around = SequentialBarriers(parts) if slowly else batch_barriers(parts, 4)
    found = FILTERS["car"].decide(state, nominal, latent, barriers=around)
    one = SafetyFilter.for_model(FILTERS["car"].model, FILTERS["car"].settings)
    for robot, own in enumerate(parts):
        verdict = one.decide(state[robot], nominal[robot], latent[robot], barriers=own)
        assert STATUSES[found.status[robot]] is verdict.status
        np.testing.assert_allclose(found.action[robot], verdict.action, rtol=0.0, atol=1e-6)
    assert (found.count(Status.corrected), found.count(Status.passed)) == (1, 1)


@pytest.mark.parametrize("own", [[], [ObstacleBarrier((), FOOTPRINT, braking_of(settings_named("car")))]])
def test_where_there_is_no_barrier_all_fall_back_and_say_so(own: list[AbstractBarrier]) -> None:
    given_ = drawn(2, 3, 0, FILTERS["car"].model.latent)
    del given_["obstacles"]
    found = FILTERS["car"].decide(**given_, barriers=batch_barriers([own] * 3, 4))
    assert found.count(Status.fallback) == 3
    np.testing.assert_array_equal(found.action, np.zeros((3, 2)))


def test_without_a_latent_all_fall_back_and_a_filter_that_is_switched_off_says_so() -> None:
    given_ = {**drawn(2, 3, 2, FILTERS["car"].model.latent), "latent": None}
    assert decided(FILTERS["car"], **given_, footprint=FOOTPRINT).count(Status.fallback) == 3
    many = BatchFilter(load_model("car"), FilterSettings.for_robot("car", enabled=False))
    assert decided(many, **drawn(2, 3, 2, many.model.latent), footprint=FOOTPRINT).count(Status.disabled) == 3


def test_one_robot_and_obstacles_far_away_as_padding() -> None:
    many = FILTERS["car"]
    given_ = drawn(5, 1, 3, many.model.latent)
    padded = {**given_, "obstacles": np.concatenate([given_["obstacles"], np.full((1, 4, 3), (1e6, 0.0, 0.0))], axis=1)}
    one, other = (decided(many, **numbers, footprint=FOOTPRINT, field=FIELD) for numbers in (given_, padded))
    np.testing.assert_allclose(one.action, other.action, atol=1e-9)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"state": np.zeros((2, 3))}, "state"),
        ({"nominal": np.zeros((1, 2))}, "nominal"),
        ({"latent": np.zeros((2, 9))}, "latent"),
        ({"obstacles": np.zeros((2, 3))}, "obstacles"),
        ({"footprint": (0.1, 0.2)}, "footprint"),
    ],
)
def test_shapes_that_are_wrong_are_refused(wrong: dict[str, Any], message: str) -> None:
    given_ = {**drawn(0, 2, 1, FILTERS["car"].model.latent), "footprint": FOOTPRINT, "field": FIELD, **wrong}
    with pytest.raises(InputError, match=message):
        decided(FILTERS["car"], **given_)


def test_other_robots_are_refused() -> None:
    with pytest.raises(InputError, match="made for the system 'car', the model is of 'pendulum'"):
        BatchFilter(load_model("pendulum"), FilterSettings.for_robot("car"))
    given_ = drawn(0, 2, 1, FILTERS["car"].model.latent)
    barriers = barriers_of_cars(FilterSettings.for_robot("car"), given_.pop("obstacles"), FOOTPRINT)
    with pytest.raises(InputError, match="those of 1 robots, wanted 2"):
        FILTERS["car"].decide(**given_, barriers=barriers.only(np.array([0])))
    corridor = batch_barriers([[CorridorBarrier(-1.0, 1.0, 0.2)]] * 2, 4)
    with pytest.raises(InputError, match="those of angle, rate"):
        FILTERS["car"].decide(**given_, barriers=corridor)


def test_a_robot_of_one_action_and_barriers_that_are_functions() -> None:
    """A pendulum's torque in a corridor, next to the same corridor as a function of the user's own."""
    model, chosen = load_model("pendulum"), replace(settings_named("pendulum"), eta=0.15, epsilon={})
    many, one = BatchFilter(model, chosen), SafetyFilter.for_model(model, chosen)
    random = np.random.default_rng(4)
    state, nominal = random.uniform((-0.4, -1.5), (0.4, 1.5), (40, 2)), random.uniform(-10.0, 10.0, (40, 1))
    latent = np.tile(model.latent, (40, 1))
    edges, names = CorridorBarrier(-0.5, 0.5, 0.25), ("lower", "upper")
    own = FunctionBarrier(lambda x: (x @ [1.0, 0.25] + 0.5, 0.5 - x @ [1.0, 0.25]), names=names, kind="corridor")
    parts: list[list[AbstractBarrier]] = [[edges] if robot % 2 else [own] for robot in range(40)]
    found = many.decide(state, nominal, latent, barriers=batch_barriers(parts, 2))
    for robot, around in enumerate(parts):
        verdict = one.decide(state[robot], nominal[robot], latent[robot], barriers=around)
        assert STATUSES[found.status[robot]] is verdict.status
        np.testing.assert_allclose(found.action[robot], verdict.action, rtol=0.0, atol=1e-6)
    assert found.count(Status.corrected) > 5
    assert (~found.single).mean() > 0.5
