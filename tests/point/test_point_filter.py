"""The stopping manoeuvre keeps what its barrier says, and the batched filter is the filter."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.errors import InputError
from safedpa.robots.point.system import POINT
from safedpa.safety import FilterSettings, SafetyFilter, Status
from safedpa.safety.batch import STATUSES, BatchFilter
from safedpa.safety.inputs import Plausible
from safedpa.safety.many_stopping import ManyStopping
from safedpa.safety.shipped import settings_named
from safedpa.safety.stopping_barrier import ENDS, Motion, StoppingBarrier, stopping_action

STRONGEST, FASTEST, DRAG, PERIOD = 2.89, 3.0, 1.93, 0.02
STATE = st.tuples(*[st.floats(-1.0, 1.0)] * 2, st.floats(-3.1, 3.1), *[st.floats(-1.0, 1.0)] * 2)


def _affine(state: np.ndarray, wind: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x[t+1] = f + g a of a point mass, a = (thrust acceleration, turn)."""
    push = wind - DRAG * state[3:]
    drift = state + PERIOD * np.array([*state[3:], 0.0, *push])
    gain = np.zeros((5, 2))
    gain[3:, 0] = PERIOD * np.array([np.cos(state[2]), np.sin(state[2])])
    gain[2, 1] = PERIOD
    return drift, gain


@settings(max_examples=8, deadline=None)
@given(STATE, st.floats(0.0, 1.5), st.floats(0.0, 6.3))
def test_the_manoeuvre_ends_at_rest_against_the_wind_and_loses_no_room(
    start: tuple[float, ...], strength: float, direction: float
) -> None:
    wind = strength * np.array([np.cos(direction), np.sin(direction)])
    motion = Motion(wind, DRAG, STRONGEST, FASTEST)
    barrier = StoppingBarrier(np.array([[0.7, 0.2, 0.2], [-0.9, 0.5, 0.2]]), motion)
    state = np.array(start)
    room, end = barrier.values(state).min(), barrier.best_end(state)
    for _ in range(100):
        thrust, turn = (float(part[0]) for part in stopping_action(state[:, None], motion, np.array([end])))
        drift, gain = _affine(state, wind)
        state = drift + gain @ np.array([thrust, turn])
        apart = np.linalg.norm(state[:2] - np.array([[0.7, 0.2], [-0.9, 0.5]]), axis=1).min() - 0.2
        assert apart >= room - 0.03
    assert np.hypot(state[3], state[4]) < 0.2


def test_many_at_once_are_filtered_as_one_is() -> None:
    """To 1e-6, also where not every condition can be kept, and where an h is below 0."""
    random, hazards = np.random.default_rng(0), np.array([[0.4, 0.0, 0.2], [0.0, 0.5, 0.2], [-0.5, -0.2, 0.2]])
    own = replace(settings_named("point"), action_low=(-STRONGEST, -FASTEST), action_high=(STRONGEST, FASTEST))
    near = np.c_[random.uniform(-0.8, 0.8, (3000, 2)), random.uniform(-3, 3, 3000), random.uniform(-1, 1, (3000, 2))]
    wind = random.uniform(-1.0, 1.0, (2, 3000))
    room = ManyStopping(np.broadcast_to(hazards, (3000, 3, 3)), Motion(wind, DRAG, STRONGEST, FASTEST)).values(near)
    close = np.flatnonzero((room.min(axis=1) > -0.01) & (room.min(axis=1) < 0.02))[:40]
    state, motion = near[close], Motion(wind[:, close], DRAG, STRONGEST, FASTEST)
    wish = np.c_[random.uniform(0.3, 1.0, 40), random.uniform(-1.0, 1.0, 40)] * own.high
    pairs = [_affine(row, motion.of(index).wind) for index, row in enumerate(state)]
    affine = np.stack([f for f, _ in pairs]), np.stack([g for _, g in pairs])
    around = ManyStopping(np.broadcast_to(hazards, (40, 3, 3)), motion)
    backup = np.tile([0.1, -0.2], (40, 1))
    many = BatchFilter(POINT, own).decide(state, wish, barriers=around, affine=affine, backup=backup.__getitem__)
    for index, row in enumerate(state):
        barrier = StoppingBarrier(hazards, motion.of(index))
        one = _alone(pairs[index], barrier, own, backup[index]).decide(row, wish[index])
        assert STATUSES[many.status[index]] is one.status
        np.testing.assert_allclose(many.action[index], one.action, atol=1e-6)
        assert many.h_now[index] == pytest.approx(one.h_now, abs=1e-9)
    for status in (Status.passed, Status.corrected, Status.relaxed, Status.violated):
        assert many.count(status) > 0, status
    assert (~many.alone).sum() >= 10


def _alone(
    pair: tuple[np.ndarray, np.ndarray], barrier: StoppingBarrier, own: FilterSettings, backup: np.ndarray
) -> SafetyFilter:
    believed = Plausible(POINT.state_low, POINT.state_high, POINT.state_names)
    return SafetyFilter(lambda _: pair, [barrier], own, backup=lambda _: backup, state_range=believed)


def test_the_backup_of_each_robot_is_its_own() -> None:
    state, hazards = np.zeros((2, 5)), np.tile([0.1, 0.0, 0.2], (2, 1, 1))
    motion, own = Motion(np.zeros(2), DRAG, STRONGEST, FASTEST), settings_named("point")
    backup, affine = np.array([[0.01, 0.0], [0.0, 1.0]]), (state, np.full((2, 5, 2), np.nan))
    around = ManyStopping(hazards, motion)
    found = BatchFilter(POINT, own).decide(
        state, np.zeros((2, 2)), barriers=around, affine=affine, backup=backup.__getitem__
    )
    assert found.count(Status.fallback) == 2
    np.testing.assert_array_equal(found.action, backup)


def test_a_filter_without_a_model_wants_f_and_g() -> None:
    around, many = (
        ManyStopping(np.zeros((1, 1, 3)), Motion(np.zeros(2), 1.0, 1.0, 1.0)),
        BatchFilter(POINT, settings_named("point")),
    )
    with pytest.raises(InputError, match="wanted f and g of each robot"):
        many.decide(np.zeros((1, 5)), np.zeros((1, 2)), barriers=around)
    with pytest.raises(InputError, match=r"g: got shape \(1, 5\)"):
        many.decide(np.zeros((1, 5)), np.zeros((1, 2)), barriers=around, affine=(np.zeros((1, 5)), np.zeros((1, 5))))


def test_either_end_is_a_manoeuvre_of_its_own() -> None:
    motion = Motion(np.zeros(2), DRAG, STRONGEST, FASTEST)
    state = np.tile(np.array([[0.0], [0.0], [np.pi / 2 - 0.1], [1.0], [0.0]]), (1, 2))
    thrust, turn = stopping_action(state, motion, ENDS)
    assert turn[0] > 0.0 > turn[1]
    assert np.all(thrust < 0.0)


def test_the_room_jumps_neither_with_the_state_nor_with_the_wind() -> None:
    """An end that changed along the way made it jump by up to 17 cm, below 0 while no hazard was near."""
    random, jumps = np.random.default_rng(5), []
    for _ in range(400):
        state = np.array([0.0, 0.0, *random.uniform(-np.pi, np.pi, 1), *random.uniform(-0.4, 0.4, 2)])
        wind, direction = random.uniform(-0.7, 0.7, 2), random.uniform(-np.pi, np.pi)
        hazards = np.array([[0.45 * np.cos(direction), 0.45 * np.sin(direction), 0.225]])
        least = [
            StoppingBarrier(hazards, Motion(wind + change, DRAG, STRONGEST, FASTEST)).values(state + move).min()
            for change, move in ((0.0, 0.0), (0.002, 0.0), (0.0, 0.002))
        ]
        jumps += [abs(least[1] - least[0]), abs(least[2] - least[0])]
    assert max(jumps) < 0.01
