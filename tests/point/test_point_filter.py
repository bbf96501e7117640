"""The stopping manoeuvre keeps what its barrier says, and the batched filter is the filter."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.safety import FilterSettings, SafetyFilter
from safedpa.safety.stopping_barrier import ENDS, Motion, StoppingBarrier, stopping_action
from safedpa_sim.point.filtering import ETA, Believed, best_end, filtered, nearest_in_polygon

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
    room, end = barrier.values(state).min(), barrier._best(state)[1]
    for _ in range(100):
        thrust, turn = (float(part[0]) for part in stopping_action(state[:, None], motion, np.array([end])))
        drift, gain = _affine(state, wind)
        state = drift + gain @ np.array([thrust, turn])
        apart = np.linalg.norm(state[:2] - np.array([[0.7, 0.2], [-0.9, 0.5]]), axis=1).min() - 0.2
        assert apart >= room - 0.03
    assert np.hypot(state[3], state[4]) < 0.2


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000))
def test_the_nearest_point_of_a_polygon_is_the_one_that_a_grid_finds(seed: int) -> None:
    random = np.random.default_rng(seed)
    slope, needed = random.normal(size=(1, 3, 2)), random.normal(size=(1, 3)) * 0.5
    wish = random.uniform(-1.0, 1.0, (1, 2))
    found, exists = nearest_in_polygon(wish, slope, needed)
    axis = np.linspace(-1.0, 1.0, 201)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    inside = np.all(grid @ slope[0].T >= needed, axis=1)
    if inside.any():
        assert exists[0]
        nearest = np.linalg.norm(grid[inside] - wish, axis=1).min()
        assert np.linalg.norm(found[0] - wish[0]) <= nearest + 1e-9
        assert np.all(slope[0] @ found[0] >= needed[0] - 1e-6)


def test_many_at_once_are_filtered_as_one_is() -> None:
    random = np.random.default_rng(0)
    wind, hazards = np.array([0.9, -0.4]), np.array([[0.4, 0.0], [0.0, 0.5], [-0.5, -0.2]])
    motion = Motion(wind, DRAG, STRONGEST, FASTEST)
    settings_ = FilterSettings(
        action_low=(-STRONGEST, -FASTEST),
        action_high=(STRONGEST, FASTEST),
        backup_action=(0.0, 0.0),
        eta=ETA,
        epsilon=0.002,
    )
    one = SafetyFilter(lambda x: _affine(x, wind), [StoppingBarrier(np.c_[hazards, [0.2] * 3], motion)], settings_)
    near = np.c_[random.uniform(-0.8, 0.8, (3000, 2)), random.uniform(-3, 3, 3000), random.uniform(-1, 1, (3000, 2))]
    room, _ = best_end(near, np.broadcast_to(hazards, (3000, 3, 2)), np.full(3, 0.2), motion)
    state = near[(room.min(axis=1) > 0.0) & (room.min(axis=1) < 0.02)][:40]
    count = len(state)
    wish = np.c_[random.uniform(0.3, 1.0, count), random.uniform(-1.0, 1.0, count)]
    pairs = [_affine(row, wind) for row in state]
    scale = np.array([STRONGEST, FASTEST])
    gain = np.stack([g for _, g in pairs]) * scale
    believed = Believed(np.stack([f for f, _ in pairs]), gain, motion, scale)
    many = filtered(state, wish, np.broadcast_to(hazards, (count, 3, 2)), 0.2, believed, 0.002)
    agreed = compared = 0
    for index, row in enumerate(state):
        verdict = one.decide(row, wish[index] * scale)
        if verdict.status.value == "passed":
            assert not many.corrected[index]
        if verdict.status.value == "corrected" and not many.stopping[index]:
            compared += 1
            agreed += np.abs(verdict.action / scale - many.action[index]).max() < 0.05
    assert compared >= 5
    assert agreed >= 0.8 * compared


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
