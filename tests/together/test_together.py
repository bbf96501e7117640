"""Many cars at once get what each would get alone: histories, back-offs, wishes, actions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from safedpa.adaptation import HistoryEstimator
from safedpa.bus import StateMessage
from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.policy.backing_off import BackingOff
from safedpa.policy.backing_off_together import BackingOffTogether
from safedpa.policy.controller import controller_for
from safedpa.safety import SafetyFilter, Status
from safedpa.safety.car_barriers import car_barriers
from safedpa.safety.car_stack import stacked
from safedpa.safety.shipped import settings_named
from safedpa.together import CarsTogether, HistoriesTogether, Surroundings

PERIOD = 0.05
FIELD = (-4.0, 4.0, -4.0, 4.0)
FOOTPRINT = (0.1, 0.35, 0.2)


def message(tick: int, state, applied, goal, obstacles=()) -> StateMessage:
    return StateMessage(
        epoch=1,
        tick=tick,
        robot_time=PERIOD * tick,
        publish_time=0.0,
        values=tuple(state.tolist()),
        applied=tuple(applied.tolist()),
        applied_by="filter",
        period=PERIOD,
        lockstep=True,
        goal=tuple(goal.tolist()),
        obstacles=tuple(tuple(row) for row in np.asarray(obstacles).tolist()),
        field=FIELD,
        footprint=FOOTPRINT,
    )


class Straight:
    """A controller that always wishes for the same."""

    def wish(self, state, latent):
        del state, latent
        return (1.0, 0.1), "straight"


@given(some.integers(0, 2**32 - 1), some.integers(1, 4))
@settings(max_examples=30)
def test_cars_back_off_as_each_would_alone(seed, cars):
    draw = np.random.default_rng(seed)
    alone, together = [BackingOff(Straight()) for _ in range(cars)], BackingOffTogether(cars)
    state, goal = draw.uniform(-1.0, 1.0, (cars, 4)), draw.uniform(-3.0, 3.0, (cars, 2))
    for tick in range(160):
        state += draw.normal(size=(cars, 4)) * draw.choice([0.0, 0.003, 0.1], size=(cars, 1))
        goal[draw.random(cars) < 0.01] = draw.uniform(-3.0, 3.0, 2)
        wishes = together.wishes(PERIOD * tick, state, goal, np.tile((1.0, 0.1), (cars, 1)))
        for car in range(cars):
            one = alone[car].wish(message(tick, state[car], np.zeros(2), goal[car]), None)[0]
            assert tuple(wishes[car].tolist()) == one


@given(some.integers(0, 2**32 - 1))
@settings(max_examples=8)
def test_histories_are_those_of_each_alone(seed):
    """Also where a state cannot be believed: that car alone begins anew."""
    draw, model, cars = np.random.default_rng(seed), load_model("car_learned"), 3
    together, alone = HistoriesTogether(model, cars), [HistoryEstimator(model) for _ in range(cars)]
    state, before = draw.normal(size=(cars, 4)) * 0.2, None
    for tick in range(80):
        state = state + draw.normal(size=(cars, 4)) * 0.03
        given_, applied = state.copy(), draw.uniform(-0.3, 0.3, (cars, 2))
        if tick == 60:
            given_[1, 0] = np.nan
        latents = together.latents(given_, applied)
        for car in range(cars):
            if before is None or not np.isfinite([*given_[car], *before[car]]).all():
                alone[car].forget_transient()
            else:
                alone[car].update(before[car], applied[car], given_[car], PERIOD)
            np.testing.assert_allclose(latents[car], alone[car].latent, atol=2e-6)
        before = given_


def test_a_model_without_networks_is_refused():
    with pytest.raises(InputError, match="wanted learned networks"):
        HistoriesTogether(load_model("car"), 2)
    with pytest.raises(InputError, match="wanted learned networks"):
        CarsTogether(load_model("car"), settings_named("car"), 2)


def test_actions_are_those_of_each_alone():
    """Forty cars drive for forty ticks by what comes out; every one is asked alone as well."""
    model, chosen, cars = load_model("car_learned"), settings_named("car"), 40
    draw = np.random.default_rng(5)
    epsilon = {"obstacle": 0.02, "field": 0.02, "speed": 0.02}
    together = CarsTogether(model, chosen, cars, epsilon)
    controllers, estimators = (
        [controller_for(model)() for _ in range(cars)],
        [HistoryEstimator(model) for _ in range(cars)],
    )
    alone = SafetyFilter.for_model(model, chosen)
    state = np.column_stack(
        [draw.uniform(-2.0, 2.0, (cars, 2)), draw.uniform(-3.0, 3.0, cars), draw.uniform(0.0, 1.0, cars)]
    )
    goal = draw.uniform(-3.0, 3.0, (cars, 2))
    obstacles = np.dstack([draw.uniform(-4.0, 4.0, (cars, 6, 2)), draw.uniform(0.1, 0.4, (cars, 6, 1))])
    around = Surroundings(goal, obstacles, np.tile(FIELD, (cars, 1)), np.tile(FOOTPRINT, (cars, 1)))
    applied, before = np.zeros((cars, 2)), None
    for tick in range(40):
        found = together.step(PERIOD * tick, state, applied, around)
        for car in range(cars):
            if before is not None:
                estimators[car].update(before[car], applied[car], state[car], PERIOD)
            told = message(tick, state[car], applied[car], goal[car], obstacles[car])
            wish = np.array(controllers[car].wish(told, estimators[car].latent)[0])
            parts = car_barriers(chosen, FOOTPRINT, obstacles[car].tolist(), FIELD)
            verdict = alone.decide(state[car], wish, estimators[car].latent, barriers=parts, epsilon=epsilon)
            if verdict.status is Status.violated:
                stack = stacked(parts)
                heights = [
                    min(stack.heights(model.step(state[car], action, estimators[car].latent).tolist()))
                    for action in (found.action[car], verdict.action)
                ]
                assert heights[0] == pytest.approx(heights[1], abs=1e-9), "h is flat where it is highest"
                np.testing.assert_allclose(found.action[car], verdict.action, atol=1e-3)
            else:
                np.testing.assert_allclose(found.action[car], verdict.action, atol=2e-5)
        before, applied = state, found.action
        state = (
            np.array([model.step(*pair) for pair in zip(state, applied, strict=True)])
            + draw.normal(size=(cars, 4)) * 0.002
        )
