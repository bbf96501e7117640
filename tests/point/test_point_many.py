"""The stopping manoeuvres of many robots at once are those of each alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from safedpa.safety.many_stopping import ManyStopping
from safedpa.safety.stopping_barrier import Motion, StoppingBarrier, nearer_end, stopping_path
from safedpa.safety.stopping_walk import least_rooms

Values = NDArray[np.float64]

ROBOTS, FASTEST = 60, 3.0


def drawn(seed: int, hazards: int) -> tuple[Values, ManyStopping]:
    """States of robots that differ in wind, drag and strength, some of them at rest, and the room around them."""
    random = np.random.default_rng(seed)
    state = np.c_[random.uniform(-0.5, 0.5, (ROBOTS, 2)), random.uniform(-3.1, 3.1, ROBOTS), np.zeros((ROBOTS, 2))]
    state[:, 3:] = random.uniform(-1.0, 1.0, (ROBOTS, 2)) * random.choice([0.0, 1.0], (ROBOTS, 1))
    wind = random.uniform(-1.0, 1.0, (2, ROBOTS)) * random.choice([0.0, 1.0], ROBOTS)
    motion = Motion(wind, random.uniform(1.0, 2.0, ROBOTS), random.uniform(2.0, 3.0, ROBOTS), FASTEST, 0.02)
    places, radii = random.uniform(-1.0, 1.0, (ROBOTS, hazards, 2)), random.uniform(0.2, 0.3, (ROBOTS, hazards, 1))
    return state, ManyStopping(np.concatenate([places, radii], axis=2), motion)


def alone(many: ManyStopping, robot: int) -> StoppingBarrier:
    (one,) = many.one(robot)
    assert isinstance(one, StoppingBarrier)
    return one


@pytest.mark.parametrize("hazards", [1, 4])
def test_rooms_ends_and_slopes_are_those_of_each_alone(hazards: int) -> None:
    state, many = drawn(hazards, hazards)
    g = np.random.default_rng(9).normal(size=(ROBOTS, 5, 2))
    assert many.kinds == (StoppingBarrier.kind,) * hazards
    assert len(many) == ROBOTS
    (room, end), slopes = many.best(state), many.along(state, g, np.ones(2))
    ones = [alone(many, robot) for robot in range(ROBOTS)]
    assert end.tolist() == [one.best_end(own) for one, own in zip(ones, state, strict=True)]
    assert {*end.tolist()} == {1.0, -1.0}
    for robot, (one, own) in enumerate(zip(ones, state, strict=True)):
        h, gradient = one.evaluate(own)
        np.testing.assert_allclose(room[robot], h, atol=1e-9)
        np.testing.assert_allclose(slopes[robot], gradient @ g[robot], rtol=1e-6, atol=1e-7)
    np.testing.assert_array_equal(many.values(state), room)


def test_slopes_are_those_of_the_walk_in_plain_numbers() -> None:
    """Along the actions' directions, an end kept; of robots that move: at rest they bend, and where another step is the
    nearest."""
    state, many = drawn(2, 3)
    g, far = np.random.default_rng(8).normal(size=(ROBOTS, 5, 2)), 1e-5
    end, slopes, apart = many.best(state)[1], many.along(state, g, np.ones(2)), []
    for robot in np.flatnonzero(state[:, 3]).tolist():
        hazards, motion = many.hazards[robot], many.motion_of(robot)

        def rooms(at: Values, hazards: Any = hazards, motion: Motion = motion, robot: int = robot) -> Values:
            return np.asarray(least_rooms(at, motion, float(end[robot]), hazards[:, :2], hazards[:, 2]))

        for action, along in enumerate(g[robot].T):
            change = (rooms(state[robot] + far * along) - rooms(state[robot] - far * along)) / (2.0 * far)
            apart.append(np.abs(change - slopes[robot, :, action]))
    assert len(apart) > 40
    assert np.quantile(np.array(apart), 0.9) < 1e-3


def test_some_of_them_are_those() -> None:
    state, many = drawn(3, 2)
    which = np.array([7, 3, 31])
    np.testing.assert_allclose(many.only(which).values(state[which]), many.values(state)[which], rtol=0.0, atol=1e-15)
    for place, robot in enumerate(which):
        one = alone(many.only(which), place)
        np.testing.assert_allclose(one.values(state[robot]), many.values(state)[robot], atol=1e-9)


def test_without_hazards_there_is_no_room_to_report() -> None:
    state, many = drawn(4, 0)
    room, end = many.best(state)
    assert room.shape == (ROBOTS, 0)
    assert end.tolist() == [alone(many, robot).best_end(own) for robot, own in enumerate(state)]
    assert many.along(state, np.zeros((ROBOTS, 5, 2)), np.ones(2)).shape == (ROBOTS, 0, 2)


def test_the_nearer_end_is_the_one_that_points_more_to_where_the_robot_has_to_push() -> None:
    """What has to be pushed: the acceleration that ends the motion in 0.15 s, less what wind and drag do."""
    random, ends = np.random.default_rng(6), set[float]()
    for _ in range(200):
        state = np.r_[random.uniform(-1.0, 1.0, 2), random.uniform(-3.1, 3.1), random.uniform(-1.0, 1.0, 2)]
        wind, drag = complex(*random.uniform(-3.0, 3.0, 2)), random.uniform(1.0, 9.0)
        motion = Motion(np.array([wind.real, wind.imag]), drag, 2.9, FASTEST)
        velocity = complex(*state[3:])
        push = -velocity / 0.15 - (wind - drag * velocity)
        towards = np.angle(push / np.exp(1j * state[2]))
        found = float(nearer_end(state, motion))
        assert found == (1.0 if abs(towards) < np.pi / 2 else -1.0)
        ends.add(found)
    assert ends == {1.0, -1.0}


def test_the_end_that_leaves_more_room_is_taken_though_the_other_one_is_nearer() -> None:
    state, many = drawn(5, 2)
    gained = 0
    for robot in range(ROBOTS):
        one, hazards, motion = alone(many, robot), many.hazards[robot], many.motion_of(robot)
        rooms = {end: min(least_rooms(state[robot], motion, end, hazards[:, :2], hazards[:, 2])) for end in (1.0, -1.0)}
        assert one.values(state[robot]).min() >= max(rooms.values()) - 1e-6
        gained += rooms[one.best_end(state[robot])] > rooms[float(nearer_end(state[robot], motion))] + 0.01
    assert gained > 2


@pytest.mark.parametrize("ahead", [0.0, 0.02, 1.0])
def test_the_room_is_that_of_the_middle(ahead: float) -> None:
    motion = Motion(np.zeros(2), 1.0, 2.0, FASTEST, ahead)
    path = stopping_path(np.array([[0.5], [0.2], [0.7], [0.0], [0.0]]), motion, np.ones(1))
    np.testing.assert_allclose(path[:, :, 0], [(0.5 - ahead * np.cos(0.7), 0.2 - ahead * np.sin(0.7))] * len(path))
