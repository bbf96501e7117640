"""The car's body as its barriers and the dashboard see it: stretched by the stop, with a load that is moved on."""

from __future__ import annotations

from dataclasses import replace
from math import hypot

import numpy as np
import pytest

from safedpa.bus import StateMessage
from safedpa.equations import Given
from safedpa.operations import FLOATS
from safedpa.robots.car.barriers import (
    FieldBarrier,
    ObstacleBarrier,
    braking_of,
    car_barriers,
    swept_capsule,
    towed_again,
)
from safedpa.robots.car.swept import steepest
from safedpa.robots.car.towed_reach import TowedReach
from safedpa.safety import FilterSettings

SETTINGS, FOOTPRINT = FilterSettings(), (0.08, 0.40, 0.12)
FIELD, OBSTACLES = (-3.0, 3.0, -3.0, 3.0), [(1.0, 0.5, 0.3), (-2.0, 0.0, 0.2)]
MESSAGE = StateMessage(
    epoch=1, tick=0, robot_time=0.0, publish_time=0.0, values=(0.0, 0.0, 0.0, 0.0), applied=(0.0, 0.0),
    applied_by="none", period=0.05, lockstep=True, goal=(1.0, 1.0), obstacles=(), field=(), footprint=FOOTPRINT,
)  # fmt: skip


def distance_to_stop(speed: float) -> float:
    """By small steps of a car that loses what it can: b, and at low speed k v."""
    way, step, braking = 0.0, 1e-4, braking_of(SETTINGS)
    while speed > 1e-6:
        way += speed * step
        speed -= min(braking.deceleration, braking.gain * speed) * step
    return way


@pytest.mark.parametrize("speed", [-0.7, -0.1, 0.0, 0.3, 1.7])
def test_the_body_is_stretched_to_where_the_car_is_driving_by_as_far_as_it_needs_to_stop(speed: float) -> None:
    found = swept_capsule(replace(MESSAGE, values=(0.3, -0.2, 1.1, speed)), SETTINGS)
    assert found is not None
    more = distance_to_stop(abs(speed))
    wanted = (-0.08, 0.40 + more, 0.12) if speed > 0.0 else (-0.08 - more, 0.40, 0.12)
    assert found == pytest.approx(wanted, abs=1e-3)


@pytest.mark.parametrize(
    "changed",
    [
        {"footprint": ()},
        {"footprint": (0.1, 0.2, 0.3, 0.4)},
        {"values": (0.0, 0.0, 0.0)},
        {"values": (0.0, 0.0, 0.0, np.nan)},
        {"values": (np.inf, 0.0, 0.0, 0.0)},
    ],
)
def test_an_unknown_body_is_not_reported(changed: dict[str, tuple[float, ...]]) -> None:
    assert swept_capsule(replace(MESSAGE, **changed), SETTINGS) is None  # type: ignore[arg-type]


@pytest.mark.parametrize("field", [FIELD, None])
def test_barriers_of_a_load_that_was_moved_on_are_those_of_a_new_stack(field: tuple[float, ...] | None) -> None:
    random = np.random.default_rng(1)
    before, after = (TowedReach(0.1, 0.5, 0.2, way, (0.1 * way, 0.2, way)) for way in (0.0, 0.4))
    old, new = (car_barriers(SETTINGS, FOOTPRINT, OBSTACLES, field, towed) for towed in (before, after))
    found = towed_again(old, after)  # type: ignore[arg-type]
    assert [type(part) for part in found] == [type(part) for part in new]
    assert found[-1] is old[-1]
    differ = 0
    for state in random.uniform((-1.0, -1.0, -3.0, -0.8), (1.0, 1.0, 3.0, 1.0), (40, 4)):
        for part, wanted, former in zip(found, new, old, strict=True):
            np.testing.assert_array_equal(part.values(state), wanted.values(state))
            differ += not np.array_equal(wanted.values(state), former.values(state))
    assert differ > 10


def test_a_load_that_has_not_folded_claims_no_room() -> None:
    """Wherever the car stands or reverses: h is that of the car alone, of obstacles and of walls."""
    braking = braking_of(SETTINGS)
    for state in np.random.default_rng(2).uniform((-1.0, -1.0, -3.0, -0.3), (1.0, 1.0, 3.0, 1.0), (60, 4)):
        towed = TowedReach(0.3, 0.6, 0.2, 0.0, tuple(state[:3].tolist()))
        pairs = (
            (FieldBarrier(FIELD, FOOTPRINT, braking), FieldBarrier(FIELD, FOOTPRINT, braking, towed=towed)),
            (
                ObstacleBarrier(OBSTACLES, FOOTPRINT, braking),
                ObstacleBarrier(OBSTACLES, FOOTPRINT, braking, towed=towed),
            ),
        )
        for alone, with_load in pairs:
            np.testing.assert_allclose(with_load.values(state), alone.values(state), rtol=0.0, atol=1e-12)


def test_no_slope_exceeds_the_stated_bound_and_unread_states_have_slope_zero() -> None:
    braking, random = braking_of(SETTINGS), np.random.default_rng(3)
    for state in random.uniform((-1.0, -1.0, -3.0, -0.8), (1.0, 1.0, 3.0, 2.0), (60, 4)):
        part = ObstacleBarrier([(*random.uniform(-1.0, 1.0, 2), 0.1)], FOOTPRINT, braking)
        told = steepest(Given([*state.tolist(), 7.0], part.shared, (), part.form), FLOATS)
        assert told[4:] == [0.0]
        _, gradient = part.evaluate(state)
        assert (np.abs(gradient[0]) <= np.array(told[:4]) + 1e-9).all()
        assert hypot(*gradient[0, :2]) <= 1.0 + 1e-9
