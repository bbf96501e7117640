"""Wishes at random, and which controller a pendulum gets."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safedpa.bus import StateMessage
from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.policy.controller import NetworkLatent, RandomWishes, controller_for


def state(tick: int, values: tuple[float, ...]) -> StateMessage:
    return StateMessage(
        epoch=1,
        tick=tick,
        robot_time=0.0,
        publish_time=0.0,
        values=values,
        applied=(0.0,),
        applied_by="none",
        period=0.01,
        lockstep=True,
        goal=(0.0,),
        obstacles=(),
        field=(),
        footprint=(),
    )


@pytest.mark.parametrize(
    ("model", "values", "low", "high"),
    [
        ("pendulum", (0.1, 0.2), (-10.0,), (10.0,)),
        ("car", (0.0, 1.0, 2.0, 0.5), (-0.6, -0.34), (2.0, 0.34)),
        ("point", (0.0, 0.0), (-0.015, -3.0), (0.015, 3.0)),
    ],
)
def test_they_are_uniform_over_the_bounds(model: str, values: tuple[float, ...], low: Any, high: Any) -> None:
    own = load_model(model)
    low, high = (own.system.action_low, own.system.action_high) if low is None else (low, high)
    wishes = RandomWishes(own)
    values = (*values, *(0.0 for _ in range(len(own.system.state) - len(values))))
    drawn = np.array([wishes.wish(state(tick, values), None)[0] for tick in range(2000)])
    share = (drawn - low) / (np.array(high) - low)
    assert share.min() >= 0.0
    assert share.max() <= 1.0
    assert np.quantile(share, [0.25, 0.5, 0.75], axis=0) == pytest.approx(
        np.array([[0.25], [0.5], [0.75]]) * np.ones(drawn.shape[1]), abs=0.05
    )


def test_they_repeat_for_the_same_state_and_differ_between_states() -> None:
    model = load_model("pendulum")
    one = RandomWishes(model).wish(state(7, (0.1, 0.2)), None)
    assert one == RandomWishes(model).wish(state(7, (0.1, 0.2)), np.zeros(2))
    assert one != RandomWishes(model).wish(state(8, (0.1, 0.2)), None)
    assert one != RandomWishes(model).wish(state(7, (0.1, -0.2)), None)
    assert one[1] == "random"


def test_a_pendulum_wishes_at_random_until_its_model_has_a_policy() -> None:
    physics, learned = load_model("pendulum"), load_model("pendulum_learned")
    assert isinstance(controller_for(physics)(), RandomWishes)
    assert isinstance(controller_for(learned)(), NetworkLatent), "backing off is what a car does"
    assert isinstance(controller_for(learned, "random")(), RandomWishes)
    for name in ("goal_seeker", "planner"):
        with pytest.raises(InputError, match="known: learned, random"):
            controller_for(physics, name)
    with pytest.raises(InputError, match="no networks"):
        controller_for(physics, "learned")
