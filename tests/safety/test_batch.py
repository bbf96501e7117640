"""The filter for many robots beside the filter for one, which is the reference."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.safety import FilterSettings, SafetyFilter, Status, car_barriers
from safedpa.safety.batch import STATUSES, BatchFilter

FOOTPRINT = (0.08, 0.40, 0.12)
FIELD = (-4.0, 4.0, -4.0, 4.0)
FILTERS = {name: BatchFilter(load_model(name)) for name in ("car", "car_measured", "car_learned")}
WITHIN = {"car": 1e-6, "car_measured": 1e-6, "car_learned": 1e-5}
"""Networks of many rows at once round differently: float32 has seven digits."""


def drawn(seed: int, robots: int, obstacles: int, latent: np.ndarray[Any, Any]) -> dict[str, Any]:
    random = np.random.default_rng(seed)
    return {
        "state": random.uniform((-3.4, -3.4, -3.1, -0.6), (3.4, 3.4, 3.1, 2.0), (robots, 4)),
        "wish": random.uniform((-0.6, -0.34), (2.0, 0.34), (robots, 2)) * random.choice([1.0, 1.4], (robots, 1)),
        "latent": np.tile(latent, (robots, 1)),
        "obstacles": np.stack(
            [*random.uniform(-3.5, 3.5, (2, robots, obstacles)), random.uniform(0.2, 0.35, (robots, obstacles))], axis=2
        ),
    }


def agree(name: str, given_: dict[str, Any], walls: bool, epsilon: dict[str, Any] | None = None) -> BatchFilter:
    many = FILTERS[name]
    field = FIELD if walls else None
    found = many.decide(**given_, footprint=FOOTPRINT, field=field, epsilon=epsilon)
    one = SafetyFilter.for_model(many.model, many.settings)
    for robot in range(len(found.action)):
        barriers = car_barriers(many.settings, FOOTPRINT, given_["obstacles"][robot], field)
        margins = {kind: float(np.resize(value, len(found.action))[robot]) for kind, value in (epsilon or {}).items()}
        verdict = one.decide(
            *(given_[key][robot] for key in ("state", "wish", "latent")), barriers=barriers, epsilon=margins
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


def test_margins_by_robot() -> None:
    agree(
        "car",
        drawn(3, 12, 4, FILTERS["car"].model.latent),
        True,
        {"obstacle": np.linspace(0.0, 0.1, 12), "field": 0.02},
    )


def test_most_are_answered_together_and_every_kind_of_verdict_occurs() -> None:
    many = FILTERS["car"]
    found = many.decide(**drawn(0, 400, 6, many.model.latent), footprint=FOOTPRINT, field=FIELD)
    for status in (Status.passed, Status.corrected, Status.violated):
        assert found.count(status) > 10
    together = ~found.alone
    assert together.mean() > 0.6
    assert set(found.status[together].tolist()) == {STATUSES.index(Status.passed), STATUSES.index(Status.corrected)}


def test_what_cannot_be_believed_ends_in_the_fallback_of_its_own_robot() -> None:
    many = FILTERS["car"]
    given_ = drawn(1, 8, 2, many.model.latent)
    given_["state"][0, 0], given_["wish"][1, 1], given_["latent"][2, 0] = np.nan, np.inf, -5.0
    given_["state"][3, 3], given_["wish"][4, 0] = 1e6, 1e6
    epsilon = {"obstacle": np.array([0.01, 0.01, 0.01, 0.01, 0.01, np.nan, -0.1, 0.01])}
    with np.errstate(all="raise"):
        found = many.decide(**given_, footprint=FOOTPRINT, field=FIELD, epsilon=epsilon)
    assert [STATUSES[index] is Status.fallback for index in found.status] == [True] * 7 + [False]
    np.testing.assert_array_equal(found.action[:7], np.zeros((7, 2)))


def test_without_the_latent_that_the_model_needs_all_fall_back() -> None:
    given_ = {**drawn(2, 3, 2, FILTERS["car"].model.latent), "latent": None}
    assert FILTERS["car"].decide(**given_, footprint=FOOTPRINT).count(Status.fallback) == 3


def test_a_filter_that_is_switched_off_says_so() -> None:
    many = BatchFilter(load_model("car"), FilterSettings(enabled=False))
    assert many.decide(**drawn(2, 3, 2, many.model.latent), footprint=FOOTPRINT).count(Status.disabled) == 3


def test_one_robot_and_obstacles_far_away_as_padding() -> None:
    many = FILTERS["car"]
    given_ = drawn(5, 1, 3, many.model.latent)
    padded = {**given_, "obstacles": np.concatenate([given_["obstacles"], np.full((1, 4, 3), (1e6, 0.0, 0.0))], axis=1)}
    one, other = (many.decide(**numbers, footprint=FOOTPRINT, field=FIELD) for numbers in (given_, padded))
    np.testing.assert_allclose(one.action, other.action, atol=1e-9)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"state": np.zeros((2, 3))}, "state"),
        ({"wish": np.zeros((1, 2))}, "wish"),
        ({"latent": np.zeros((2, 9))}, "latent"),
        ({"obstacles": np.zeros((2, 3))}, "obstacles"),
        ({"obstacles": np.full((2, 1, 3), np.nan)}, "finite"),
        ({"obstacles": np.full((2, 1, 3), -1.0)}, "negative"),
        ({"footprint": (0.1, 0.2)}, "footprint"),
        ({"footprint": (-0.2, 0.1, 0.1)}, "front behind"),
        ({"field": (1.0, -1.0, -1.0, 1.0)}, "lowest x"),
        ({"field": (-1.0, 1.0, np.nan, 1.0)}, "finite"),
    ],
)
def test_shapes_that_are_wrong_are_refused(wrong: dict[str, Any], message: str) -> None:
    given_ = {**drawn(0, 2, 1, FILTERS["car"].model.latent), "footprint": FOOTPRINT, "field": FIELD, **wrong}
    with pytest.raises(InputError, match=message):
        FILTERS["car"].decide(**given_)


def test_other_robots_are_refused() -> None:
    with pytest.raises(InputError, match="wanted a car"):
        BatchFilter(load_model("pendulum"))
