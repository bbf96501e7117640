"""The planner gets round obstacles to its goal, within its limits, the same every time."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from safedpa.bus import StateMessage
from safedpa.dynamics import load_model
from safedpa.errors import InputError, MessageError
from safedpa.robots.car.planner import Planner, PlannerSettings
from safedpa.robots.car.planner_time import Grid, TimeToGo, clearance, disc_ways

MODEL = load_model("car")
FIELD = (-4.0, 4.0, -4.0, 4.0)
FOOTPRINT = (0.08, 0.40, 0.12)
NO_OBSTACLES = np.zeros((0, 3))
WALL = tuple((0.0, y, 0.3) for y in (-0.9, -0.3, 0.3, 0.9))
"""A wall of discs across the straight way, open at both ends."""


def message(
    values: tuple[float, ...],
    goal: tuple[float, ...],
    obstacles: tuple[tuple[float, ...], ...] = (),
    applied: tuple[float, ...] = (0.0, 0.0),
) -> StateMessage:
    return StateMessage(
        epoch=1,
        tick=0,
        robot_time=0.0,
        publish_time=0.0,
        values=values,
        applied=applied,
        applied_by="filter",
        period=0.05,
        lockstep=True,
        goal=goal,
        obstacles=obstacles,
        field=FIELD,
        footprint=FOOTPRINT,
    )


def driven(
    start: tuple[float, ...],
    goal: tuple[float, float],
    obstacles: tuple[tuple[float, ...], ...] = (),
    seconds: float = 15.0,
    seed: int = 0,
) -> tuple[float, float, list[tuple[float, ...]]]:
    """When the goal is reached (infinity: not), the least clearance on the way, and the wishes; no filter behind it."""
    planner, state, wish = Planner(MODEL, seed=seed), np.array(start), (0.0, 0.0)
    room, wishes = math.inf, []
    for tick in range(round(seconds / 0.05)):
        pose = tuple(np.array([value]) for value in state[:3])
        ends = (np.array([-FOOTPRINT[0]]), np.array([FOOTPRINT[1]]))
        found = clearance(pose, ends, np.array(obstacles).reshape(-1, 3), FIELD)
        room = min(room, float(found[0]) - FOOTPRINT[2])
        if math.dist(state[:2], goal) < 0.3:
            return tick * 0.05, room, wishes
        wish, name = planner.wish(message(tuple(state.tolist()), goal, obstacles, wish), MODEL.latent)
        assert name == "planner"
        wishes.append(wish)
        state = MODEL.step(state, np.array(wish), MODEL.latent)
    return math.inf, room, wishes


@pytest.mark.parametrize("yaw", [0.0, 1.5, -1.5, 3.1])
def test_it_reaches_a_goal_in_an_empty_field(yaw: float) -> None:
    seconds, room, _ = driven((-2.0, 0.0, yaw, 0.0), (2.0, 0.5))
    assert seconds < 9.0
    assert room > 0.0


def test_a_goal_behind_a_wall_is_reached_round_the_wall() -> None:
    """Straight towards the goal there is no way: a controller that only looks one second ahead stays there."""
    seconds, room, _ = driven((-2.0, 0.0, 0.0, 0.0), (2.0, 0.0), WALL)
    assert seconds < 10.0
    assert room > 0.0


def test_it_leaves_a_dead_end() -> None:
    pocket = (*WALL, (-0.6, 1.2, 0.3), (-0.6, -1.2, 0.3), (-1.2, 1.2, 0.3), (-1.2, -1.2, 0.3))
    seconds, room, _ = driven((-1.2, 0.0, 0.0, 0.0), (2.0, 0.0), pocket, 25.0)
    assert seconds < 25.0
    assert room > -0.02


def test_the_same_seed_drives_the_same_drive_and_another_one_another() -> None:
    start, goal = (-2.0, 0.0, 0.3, 0.0), (2.0, 0.0)
    first, again, other = (driven(start, goal, WALL, 2.0, seed)[2] for seed in (3, 3, 4))
    assert first == again
    assert first != other


@given(
    some.tuples(some.floats(-4, 4), some.floats(-4, 4), some.floats(-7, 7), some.floats(-1, 2.3)),
    some.tuples(some.floats(-4, 4), some.floats(-4, 4)),
    some.integers(0, 6),
)
@settings(max_examples=25, deadline=None)
def test_whatever_it_sees_it_stays_within_its_limits(
    values: tuple[float, ...], goal: tuple[float, float], count: int
) -> None:
    random = np.random.default_rng(count)
    obstacles = tuple(map(tuple, np.column_stack([random.uniform(-4, 4, (count, 2)), np.full(count, 0.3)]).tolist()))
    planner, limits = Planner(MODEL), PlannerSettings()
    for latent in (None, MODEL.latent):
        (speed, steer), _ = planner.wish(message(values, goal, obstacles), latent)
        assert limits.slowest_target <= speed <= limits.fastest_target
        assert abs(steer) <= limits.steer_limit


def test_states_that_do_not_fit_are_refused() -> None:
    good = message((0.0, 0.0, 0.0, 0.0), (1.0, 1.0))
    planner = Planner(MODEL)
    for wrong in ({"values": (0.0, 0.0)}, {"goal": (1.0,)}, {"applied": ()}, {"field": ()}, {"footprint": (1.0,)}):
        with pytest.raises(MessageError, match="wanted"):
            planner.wish(dataclasses.replace(good, **wrong), None)  # type: ignore[arg-type]
    with pytest.raises(MessageError, match="leave all bounds"):
        planner.wish(dataclasses.replace(good, values=(0.0, 0.0, 0.0, math.nan)), None)


@pytest.mark.parametrize(
    "wrong", [{"samples": 0}, {"temperature": -1.0}, {"knots": 1}, {"slowest_target": 3.0}, {"room": math.nan}]
)
def test_impossible_settings_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match="planner"):
        PlannerSettings(**wrong)  # type: ignore[arg-type]


@given(some.tuples(some.floats(-3, 3), some.floats(-3, 3)))
@settings(max_examples=40, deadline=None)
def test_a_free_way_is_nearly_straight(goal: tuple[float, float]) -> None:
    """Eight neighbours lengthen a way by 8.2 % at most; around the goal it is exact."""
    grid = Grid(FIELD, 0.2)
    found = disc_ways(grid, goal, np.ones((len(grid.x), len(grid.y))))
    straight = np.hypot(grid.x[:, None] - goal[0], grid.y[None, :] - goal[1])
    assert (found >= straight - 0.3).all()
    assert (found <= 1.083 * straight + 0.3).all()


def settled(goal: tuple[float, float], obstacles: np.ndarray, speeds: tuple[float, float] = (1.5, 0.4)) -> TimeToGo:
    to_go = TimeToGo(goal, obstacles, (-6.0, 6.0, -6.0, 6.0), FOOTPRINT, 0.1)
    to_go.drive_at(*speeds)
    rounds = 0
    while not to_go.settled:
        to_go.relax(1)
        rounds += 1
        assert rounds < 300
    return to_go


def time(to_go: TimeToGo, x: float, y: float, yaw: float) -> float:
    return float(to_go(np.array(x), np.array(y), np.array(yaw)))


def test_straight_ahead_the_time_is_the_way_over_the_speed() -> None:
    to_go = settled((3.0, 0.0), NO_OBSTACLES)
    assert time(to_go, -1.0, 0.0, 0.0) == pytest.approx(4.0 / 1.5, rel=0.08)


def test_turning_round_takes_its_time_and_reversing_is_chosen_where_it_is_quicker() -> None:
    """A goal 0.8 m behind: 2 s in reverse at 0.4 m/s; with a reverse gear that is dead, half a circle and more."""
    to_go = settled((0.0, 0.0), NO_OBSTACLES)
    assert time(to_go, 3.0, 0.0, 0.0) > time(to_go, 3.0, 0.0, math.pi) + 0.8
    assert time(to_go, 1.2, 0.0, 0.0) == pytest.approx(1.2 / 0.4, rel=0.25)
    dead = settled((0.0, 0.0), NO_OBSTACLES, (1.5, 0.01))
    assert time(dead, 1.2, 0.0, 0.0) > time(to_go, 1.2, 0.0, 0.0) + 0.5


def test_the_way_round_a_wall_takes_longer_than_through_it() -> None:
    to_go = settled((1.5, 0.0), np.array(WALL))
    assert time(to_go, -1.5, 0.0, 0.0) > 2 * math.hypot(1.5, 1.4) / 1.5


def test_the_time_mirrors_with_its_scene() -> None:
    obstacles = np.array([(0.5, 0.7, 0.3), (-1.0, -0.4, 0.2)])
    one, other = settled((2.0, 1.0), obstacles), settled((2.0, -1.0), obstacles * (1, -1, 1))
    x, y, yaw = np.random.default_rng(0).uniform(-3.8, 3.8, (3, 200))
    assert one(x, y, yaw) == pytest.approx(other(x, -y, -yaw), rel=1e-3, abs=0.02)


def test_clearance_is_that_of_the_segment() -> None:
    """Against points along the segment."""
    random = np.random.default_rng(2)
    obstacles = np.column_stack([random.uniform(-3, 3, (5, 2)), random.uniform(0.1, 0.4, 5)])
    x, y, yaw = random.uniform((-3, -3, -np.pi), (3, 3, np.pi), (50, 3)).T
    found = clearance((x, y, yaw), (np.full(50, -0.2), np.full(50, 0.7)), obstacles, FIELD)
    along = np.linspace(-0.2, 0.7, 2001)[:, None]
    px, py = x + along * np.cos(yaw), y + along * np.sin(yaw)
    room = np.min([px + 4, 4 - px, py + 4, 4 - py], axis=0)
    for ox, oy, radius in obstacles:
        room = np.minimum(room, np.hypot(px - ox, py - oy) - radius)
    assert found == pytest.approx(room.min(axis=0), abs=1e-3)
