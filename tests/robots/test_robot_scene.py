"""Scenes are valid and hard: free start and goals, passages, obstacles in the way. The footprint keeps its promise."""

from __future__ import annotations

from itertools import islice
from math import cos, hypot, sin

import numpy as np
import pytest

from safedpa.bus.wire.messages import ActionMessage
from safedpa.errors import InputError
from safedpa_sim.robots import GOAL_RADIUS, LOADS, CarRobot, CarWorld, Scene, footprint, load_named

LOAD_NAMES = ("none", *LOADS)


def distance_to_segment(x: float, y: float, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """From one point to each of many segments (segments, 2)."""
    along = end - start
    share = ((x - start[:, 0]) * along[:, 0] + (y - start[:, 1]) * along[:, 1]) / (along**2).sum(1)
    nearest = start + np.clip(share, 0.0, 1.0)[:, None] * along
    return np.hypot(x - nearest[:, 0], y - nearest[:, 1])


@pytest.mark.parametrize("load", LOAD_NAMES)
def test_two_hundred_scenes_are_free_where_they_must_be(load):
    rear, front, radius = footprint(load_named(load))
    for seed in range(200):
        scene = Scene.random(seed, load)
        assert len(scene.obstacles) == 6
        for index, (x, y, size) in enumerate(scene.obstacles):
            assert 0.2 <= size <= 0.35
            assert 4.0 - max(abs(x), abs(y)) - size >= 2 * radius + 0.4 - 1e-9
            for ox, oy, other in scene.obstacles[:index]:
                assert hypot(x - ox, y - oy) - size - other >= 2 * radius + 0.4 - 1e-9
        x, y, yaw = scene.start
        line = np.linspace(-rear, front, 20)
        for px, py in zip(x + line * cos(yaw), y + line * sin(yaw), strict=True):
            assert all(hypot(px - ox, py - oy) - size > radius for ox, oy, size in scene.obstacles)
            assert 4.0 - max(abs(px), abs(py)) > radius
        at = scene.start[:2]
        for goal in islice(scene.goals(), 8):
            assert hypot(goal[0] - at[0], goal[1] - at[1]) > GOAL_RADIUS
            assert 4.0 - max(abs(goal[0]), abs(goal[1])) >= radius + 0.35
            assert all(hypot(goal[0] - ox, goal[1] - oy) - size >= radius + 0.35 for ox, oy, size in scene.obstacles)
            at = goal


@pytest.mark.parametrize("load", LOAD_NAMES)
def test_nothing_touches_at_the_start(load):
    for seed in range(30):
        robot = CarRobot(Scene.random(seed, load))
        for _ in range(5):
            robot.advance()
        assert robot.collisions == []


def test_the_same_seed_gives_the_same_scene_and_another_another():
    first, again, other = Scene.random(3, "box"), Scene.random(3, "box"), Scene.random(4, "box")
    assert first == again
    assert list(islice(first.goals(), 30)) == list(islice(again.goals(), 30)) == list(islice(first.goals(), 30))
    assert first.obstacles != other.obstacles


def test_impossible_scenes_are_refused():
    with pytest.raises(InputError, match="fewer obstacles"):
        Scene.random(0, "large_chair", obstacles=40)
    with pytest.raises(InputError, match="larger field"):
        Scene.random(0, "large_chair", size=2.0)
    with pytest.raises(InputError, match="did you mean 'chair'"):
        Scene.random(0, "chairs")


def seek_goal(robot: CarRobot) -> tuple[float, float]:
    x, y, yaw, _ = robot.values
    bearing = np.arctan2(robot.goal[1] - y, robot.goal[0] - x) - yaw
    bearing = (bearing + np.pi) % (2 * np.pi) - np.pi
    return 1.5, float(np.clip(1.5 * bearing, -0.34, 0.34))


def collides(seed: int, load: str) -> bool:
    robot = CarRobot(Scene.random(seed, load))
    for _ in range(400):
        state = robot.state_message()
        values = seek_goal(robot)
        message = ActionMessage(epoch=1, tick=state.tick, robot_time=0.0, publish_time=0.0, values=values)
        assert robot.receive(message) is None
        robot.advance()
        if robot.collisions:
            return True
    return False


@pytest.mark.parametrize("load", LOAD_NAMES)
def test_an_unfiltered_goal_seeker_collides_in_most_scenes(load):
    assert sum(collides(seed, load) for seed in range(20)) >= 14


def test_the_capsule_of_the_body_contains_the_body_and_touches_its_corners():
    rear, front, radius = footprint(None)
    start, end = np.array([[-rear, 0.0]]), np.array([[front, 0.0]])
    world = CarWorld((0.0, 0.0, 0.0), (-4.0, 4.0, -4.0, 4.0))
    (shape,) = world.body.shapes
    distances = [
        distance_to_segment(*world.body.local_to_world(corner), start, end)[0] for corner in shape.get_vertices()
    ]
    assert max(distances) <= radius + 1e-9
    assert min(distances) == pytest.approx(radius)


class Corridor:
    """The region that the capsule's line has passed, and how far the load reaches from it."""

    def __init__(self, load: str) -> None:
        self.rear, self.front, self.radius = footprint(LOADS[load])
        self.world = CarWorld((0.0, 0.0, 0.0), (-400.0, 400.0, -400.0, 400.0), (), LOADS[load])
        self.poses = [(-back, 0.0, 0.0) for back in np.arange(1.5, 0.0, -0.02)]

    def drive(self, target_speed: float, steer: float) -> float:
        """One period; returns the largest distance of a corner of the load from the corridor [m]."""
        for _ in range(2):
            self.world.advance(target_speed, steer, 0.025)
            self.poses.append(self.world.state[:3])
        x, y, yaw = np.array(self.poses).T
        heading = np.stack([np.cos(yaw), np.sin(yaw)], 1)
        start, end = np.stack([x, y], 1) - self.rear * heading, np.stack([x, y], 1) + self.front * heading
        towed = self.world.towed
        assert towed is not None
        corners = [towed.body.local_to_world(corner) for corner in towed.shape.get_vertices()]
        return max(distance_to_segment(*corner, start, end).min() for corner in corners)


@pytest.mark.parametrize("load", list(LOADS))
@pytest.mark.parametrize("style", ["full lock", "slalom", "random"])
def test_a_load_stays_in_the_corridor_that_the_capsule_has_passed(load, style):
    draw = np.random.default_rng(5)
    corridor, action = Corridor(load), (2.0, 0.34)
    for step in range(300):
        if style == "slalom":
            action = (2.0, 0.34 if (step // 16) % 2 else -0.34)
        elif style == "random" and step % 12 == 0:
            action = (float(draw.choice([0.0, 1.0, 2.0])), float(draw.choice([-0.34, 0.0, 0.34])))
        assert corridor.drive(*action) <= corridor.radius


@pytest.mark.parametrize("load", list(LOADS))
@pytest.mark.parametrize("steers", [(0.34, 0.34), (0.34, -0.34), (0.34, 0.0), (0.0, 0.34)])
def test_half_a_metre_in_reverse_keeps_the_load_in_the_corridor(load, steers):
    corridor, backwards = Corridor(load), 0.0
    for _ in range(60):
        assert corridor.drive(1.2, steers[0]) <= corridor.radius
    while backwards < 0.5:
        assert corridor.drive(-0.6, steers[1]) <= corridor.radius
        backwards -= 0.05 * min(0.0, corridor.world.state[3])


def test_long_reversing_leaves_the_corridor_which_is_why_the_docs_limit_it():
    corridor, furthest = Corridor("box"), 0.0
    for _ in range(60):
        corridor.drive(1.2, 0.34)
    for _ in range(100):
        furthest = max(furthest, corridor.drive(-0.6, 0.34))
    assert furthest > corridor.radius
