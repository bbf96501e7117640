"""Fast implementations give the same numbers as the simple ones that they replace."""

import math
from collections import deque
from math import inf, isfinite
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.bus import SurroundingsMessage
from safedpa.bus.messages.codec import decode
from safedpa.dynamics import AbstractDynamics, load_model
from safedpa.errors import MessageError
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.safety.barriers.base import CachingBarrierSet
from safedpa.safety.barriers.stack import make_barrier_set
from safedpa.safety.margins.conformal import OnlineMargin
from safedpa.safety.settings import FilterSettings
from safedpa_sim.robots.fleet.loop import Durations

anything = st.one_of(
    st.floats(), st.integers(-5, 5), st.booleans(), st.none(), st.text(max_size=2), st.just(1e12), st.just(1.1e12)
)
STAMP = {"epoch": 1, "tick": 0, "robot_time": 0.0, "publish_time": 0.0}
SEEN = {**STAMP, "points": (), "movers": (), "hidden": (), "ages": ()}


def is_number(value: Any) -> bool:
    return type(value) in (float, int) and -1e12 <= value <= 1e12


def is_vector(value: Any) -> bool:
    return type(value) is tuple and all(map(is_number, value))


def is_rows(value: Any) -> bool:
    return type(value) is tuple and all(map(is_vector, value))


def agrees(field: str, value: Any, *, allowed: bool) -> None:
    """Whether a message with this value is read, exactly where that is allowed, and names the field where it is not."""
    payload = msgpack.packb({**SEEN, field: value})
    if allowed:
        assert getattr(decode(SurroundingsMessage, payload), field) == value
    else:
        with pytest.raises(MessageError, match=f"SurroundingsMessage.{field}"):
            decode(SurroundingsMessage, payload)


@settings(max_examples=100, deadline=None)
@given(
    value=st.one_of(anything, st.lists(anything, max_size=5).map(tuple), st.lists(st.floats(-1e12, 1e12)).map(tuple))
)
def test_a_vector_is_read_exactly_if_each_entry_is_a_finite_number_of_sensible_size(value: Any) -> None:
    agrees("ages", value, allowed=is_vector(value))


rows = st.lists(
    st.lists(st.one_of(st.floats(), st.floats(-1e3, 1e3), st.integers(0, 3)), max_size=3).map(tuple), max_size=4
)


@settings(max_examples=100, deadline=None)
@given(value=st.one_of(rows.map(tuple), anything, st.lists(anything, max_size=3).map(tuple)))
def test_rows_are_read_exactly_if_each_row_is_a_vector(value: Any) -> None:
    agrees("points", value, allowed=is_rows(value))


class SlowMargin:
    """Adaptive conformal inference as its definition has it: sorts the whole window in every step.

    Calm steps save no level up, and with a level that is used up every further miss doubles the margin.
    """

    def __init__(self, calibrated: float, coverage: float, rate: float, window: int) -> None:
        self.calibrated, self.target, self.rate, self.window = calibrated, 1.0 - coverage, rate, window
        self.level, self.value, self.factor = self.target, calibrated, 2.0
        self.errors: deque[float] = deque(maxlen=window)
        self.missed: deque[bool] = deque(maxlen=window)

    def update(self, error: float) -> float:
        missed = not error <= self.value
        self.missed.append(missed)
        spent = self.level <= 0.0
        self.level = min(self.target, self.level + self.rate * (self.target - float(missed)))
        if self.level > 0.0:
            self.factor = 2.0
        elif spent and missed and isfinite(error):
            self.factor *= 2.0
        if isfinite(error):
            self.errors.append(error)
        self.value = max(self.calibrated, self.quantile())
        return self.value

    def quantile(self) -> float:
        if not self.errors:
            return self.calibrated
        if self.level <= 0.0:
            return self.factor * max(self.calibrated, *self.errors)
        rank = math.ceil((self.window + 1) * (1.0 - self.level) - 1e-9)
        above = self.window - rank
        return self.calibrated if above >= len(self.errors) else sorted(self.errors, reverse=True)[max(above, 0)]


@settings(max_examples=100, deadline=None)
@given(
    errors=st.lists(st.one_of(st.floats(-0.1, 1.0), st.sampled_from((0.0, 0.2, 0.2, inf, float("nan")))), max_size=80),
    window=st.integers(1, 20),
    coverage=st.sampled_from((0.5, 0.9, 0.99)),
)
def test_a_margin_with_ordered_errors_is_the_one_that_sorts(errors: list[float], window: int, coverage: float) -> None:
    quick, slow = OnlineMargin(0.1, coverage, 0.02, window), SlowMargin(0.1, coverage, 0.02, window)
    for error in errors:
        assert quick.update(error) == slow.update(error)
        assert quick.coverage == pytest.approx(1.0 - sum(slow.missed) / len(slow.missed))


@settings(max_examples=50, deadline=None)
@given(states=st.lists(st.tuples(*[st.floats(-3.0, 3.0)] * 4), min_size=1, max_size=30))
def test_a_stack_with_a_memory_has_the_values_of_the_stack(states: list[tuple[float, ...]]) -> None:
    obstacles, field = ((0.5, 0.5, 0.2), (1.0, -1.0, 0.3)), (-4.0, 4.0, -4.0, 4.0)
    stack = make_barrier_set(car_barriers(FilterSettings.for_robot("car"), (0.08, 0.4, 0.12), obstacles, field))
    remembering = CachingBarrierSet(stack)
    for values in (*states, *states[-3:]):
        state = np.array(values)
        h = remembering.h(state)
        assert h.tobytes() == stack.h(state).tobytes()
        h[:] = np.nan  # an array of its own: what is remembered stays
        assert remembering.h(state).tobytes() == stack.h(state).tobytes()
        assert remembering.grad_h(state).tobytes() == stack.grad_h(state).tobytes()


@pytest.mark.parametrize("name", ["car", "car_measured", "car_learned", "pendulum"])
def test_a_held_action_leads_where_single_steps_lead(name: str) -> None:
    model = load_model(name)
    draw = np.random.default_rng(0)
    for _ in range(60):  # often enough that the straight road is taken at last
        state = 0.5 * draw.normal(size=len(model.system.state))
        action = draw.uniform(model.system.action_low, model.system.action_high)
        memory = model.initial_memory(action)
        latent = model.latent if draw.random() < 0.5 else None
        got, after = model.rollout_held(state, action, memory, latent, 8, period=0.05)
        wanted, cached = AbstractDynamics.rollout_held(model, state, action, memory, latent, 8, period=0.05)
        np.testing.assert_array_equal(got, wanted)
        assert after == cached


@settings(max_examples=50, deadline=None)
@given(seconds=st.lists(st.floats(0.0, 0.9), min_size=1, max_size=50), share=st.sampled_from((0.5, 0.99, 0.999)))
def test_percentiles_of_a_histogram_are_those_of_the_durations_to_one_bin(seconds: list[float], share: float) -> None:
    durations = Durations()
    for value in seconds:
        durations.add(value)
    exact = sorted(seconds)[math.ceil(share * len(seconds)) - 1]
    found = durations.percentile(share)
    assert found is not None
    assert exact <= found + 1e-9 <= exact + 1.1e-5 + 1e-9
    assert durations.longest == max(seconds)
