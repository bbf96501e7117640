"""Scenes, footprints, changes during a drive, and the position of a pushed load."""

from dataclasses import replace
from itertools import islice
from math import atan2, cos, hypot, sin, tan

import numpy as np
import pytest

from safedpa.bus import LATENT, NOMINAL, VERDICT
from safedpa.bus.messages.messages import ActionMessage, LatentMessage, NominalMessage, VerdictMessage
from safedpa.dynamics import fingerprint, load_model
from safedpa.errors import InputError
from safedpa.robots.car.barriers.reverse_odometer import ReverseOdometer
from safedpa.robots.car.scenes.perceived import CarScene
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.barriers.equation import AbstractEquationBarrier
from safedpa.safety.defaults import margin_for, settings_named
from safedpa_sim.robots import (
    CHANGES,
    GOAL_RADIUS,
    LOADS,
    CarRobot,
    CarWorld,
    PlannedChange,
    Scene,
    footprint,
    load_named,
)
from safedpa_sim.robots.car.loads import towed_reach

LOAD_NAMES = ("none", *LOADS)


def distance_to_segment(x: float, y: float, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Returns the distances from a point to segments (segments, 2)."""
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


def test_a_seed_gives_one_scene_and_impossible_ones_are_refused():
    first, again, other = Scene.random(3, "box"), Scene.random(3, "box"), Scene.random(4, "box")
    assert first == again
    assert list(islice(first.goals(), 30)) == list(islice(again.goals(), 30)) == list(islice(first.goals(), 30))
    assert first.obstacles != other.obstacles
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
    """The region swept by the capsule's axis, and how far the load extends from it."""

    def __init__(self, load: str) -> None:
        self.rear, self.front, self.radius = footprint(LOADS[load])
        self.world = CarWorld((0.0, 0.0, 0.0), (-400.0, 400.0, -400.0, 400.0), (), LOADS[load])
        self.poses = [(-back, 0.0, 0.0) for back in np.arange(1.5, 0.0, -0.02)]

    def drive(self, target_speed: float, steer: float) -> float:
        """Simulates a period; returns the largest distance of a corner of the load from the corridor [m]."""
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


OPEN = Scene(0, None, (-100.0, 100.0, -100.0, 100.0), (), (0.0, 0.0, 0.3), ((50.0, 0.0),))
NARROW = Scene(0, None, (-100.0, 100.0, -0.42, 0.42), (), (0.0, 0.0, 0.0), ((50.0, 0.0),))


def driven(
    change: str, seconds: float, action: tuple[float, float], scene: Scene = OPEN, released_at: int = 0
) -> CarRobot:
    robot = CarRobot(scene, change=PlannedChange(change, 1.0))
    robot.hold_change(lambda: robot.tick >= released_at)
    for _ in range(round(seconds / robot.period)):
        state = robot.state_message()
        message = ActionMessage(
            epoch=state.epoch, tick=state.tick, robot_time=state.robot_time, publish_time=0.0, values=action
        )
        assert robot.receive(message) is None
        robot.advance()
    return robot


@pytest.mark.parametrize("change", CHANGES)
def test_a_planned_change_is_applied_once_when_it_is_due(change: str) -> None:
    before = driven(change, 1.0, (1.5, 0.0))
    after = driven(change, 1.05, (1.5, 0.0))
    assert before.changed_at is None
    assert after.changed_at == 20
    assert driven(change, 3.0, (1.5, 0.0)).changed_at == 20


def test_a_planned_change_also_waits_until_it_is_released() -> None:
    assert driven("headwind", 3.0, (1.5, 0.0), released_at=40).changed_at == 40


def test_a_head_wind_takes_speed_off_and_a_steering_offset_turns_the_car() -> None:
    calm = driven("steering_offset", 1.0, (1.5, 0.0)).values[3]
    windy = driven("headwind", 4.0, (1.5, 0.0))
    assert windy.values[3] == pytest.approx(calm - 1.0 / windy.world.parameters.servo_gain, abs=0.03)
    assert hypot(*windy.world.wind) == pytest.approx(1.0)
    assert atan2(-windy.world.wind[1], -windy.world.wind[0]) == pytest.approx(0.3, abs=0.02)
    robot = driven("steering_offset", 4.0, (1.0, 0.0))
    earlier = driven("steering_offset", 3.0, (1.0, 0.0))
    rate = robot.values[2] - earlier.values[2]
    assert rate == pytest.approx(robot.values[3] * tan(0.08) / 0.32, rel=0.1)


def test_nothing_is_hitched_without_motion_or_room_and_an_unknown_change_is_refused() -> None:
    assert driven("hitch", 3.0, (0.0, 0.0)).changed_at is None
    assert driven("hitch", 3.0, (1.0, 0.0), NARROW).changed_at is None
    assert driven("hitch", 3.0, (1.0, 0.0)).world.towed is not None
    with pytest.raises(InputError, match="headwind, hitch, steering_offset"):
        PlannedChange("flood", 1.0)


PERIOD = 0.05


def programme(kind: str, seed: int, ticks: int) -> list[tuple[float, float]]:
    """Random forward and backward motion that turns the load, after a second straight ahead."""
    draw, actions = np.random.default_rng([seed, len(kind)]), [(1.0, 0.0)] * 20
    speeds = {"rocking": (-0.6, 0.8), "mixed": (-0.6, -0.6, 0.6, 1.8), "backwards": (-0.6, -0.6, -0.6, 1.2)}[kind]
    longest = {"rocking": 24, "mixed": 50, "backwards": 120}[kind]
    while len(actions) < ticks:
        stretch = int(draw.integers(5, longest))
        actions += [(float(draw.choice(speeds)), float(draw.choice((-0.34, 0.34))))] * stretch
    return actions[:ticks]


class Claimed:
    """The regions covered so far by the capsule and the disc around the hitch, and how far the load leaves them."""

    def __init__(self, load: str) -> None:
        self.load, self.world = LOADS[load], CarWorld((0.0, 0.0, 0.0), (-200.0, 200.0, -200.0, 200.0), (), LOADS[load])
        self.rear, self.front, self.radius = footprint(self.load)
        self.begin, self.end, self.reach = towed_reach(self.load)
        self.way = self.end  # unknown at the start
        self.hitches: list[tuple[float, float, float]] = []
        self.lines: list[tuple[float, float, float, float]] = []
        self.claim()

    def claim(self) -> None:
        x, y, yaw, _ = self.world.state
        c, s = cos(yaw), sin(yaw)
        share = min(max((self.way - self.begin) / (self.end - self.begin), 0.0), 1.0)
        self.hitches.append((x - self.rear * c, y - self.rear * s, self.radius + share * (self.reach - self.radius)))
        self.lines.append((x - self.rear * c, y - self.rear * s, x + self.front * c, y + self.front * s))

    def drive(self, action: tuple[float, float]) -> float:
        """Simulates a period; returns how far the load extends beyond the covered regions [m]."""
        x, y, yaw, _ = self.world.state
        self.world.advance(*action, PERIOD)
        now_x, now_y, _, _ = self.world.state
        self.way -= cos(yaw) * (now_x - x) + sin(yaw) * (now_y - y)
        self.way = min(max(self.way, 0.0), self.end)
        self.claim()
        assert self.world.towed is not None
        points = [self.world.towed.body.local_to_world(v) for v in self.world.towed.shape.get_vertices()]
        return max(self.outside(*point) for point in points)

    def outside(self, x: float, y: float) -> float:
        discs, lines = np.array(self.hitches), np.array(self.lines)
        along = lines[:, 2:] - lines[:, :2]
        apart = np.array((x, y)) - lines[:, :2]
        share = np.clip((apart * along).sum(1) / (along**2).sum(1), 0.0, 1.0)
        to_line = np.hypot(*(apart - share[:, np.newaxis] * along).T).min() - self.radius
        return float(min(to_line, (np.hypot(discs[:, 0] - x, discs[:, 1] - y) - discs[:, 2]).min()))


@pytest.mark.long
@pytest.mark.parametrize("load", list(LOADS))
@pytest.mark.parametrize("kind", ["rocking", "mixed", "backwards"])
def test_a_pushed_load_stays_within_its_envelope(load: str, kind: str) -> None:
    worst = -1.0
    for seed in range(4):
        claimed = Claimed(load)
        worst = max(worst, *(claimed.drive(action) for action in programme(kind, 4000 + seed, 240)))
    assert worst <= 0.005, "m; beyond it the clearance of 5 cm begins"


def test_without_the_growth_a_pushed_load_leaves_its_envelope() -> None:
    worst = -1.0
    for seed in range(4):
        claimed = Claimed("box")
        claimed.reach = claimed.radius
        worst = max(worst, *(claimed.drive(action) for action in programme("backwards", 4000 + seed, 240)))
    assert worst > 0.05


def test_the_reach_is_that_of_the_farthest_corner_and_is_reported_with_a_load() -> None:
    for load in LOADS.values():
        begin, end, reach = towed_reach(load)
        assert 0.0 <= reach - hypot(load.drawbar + load.side, load.side / 2) < 0.01
        assert 0.0 < begin < end < reach
    assert towed_reach(None) == ()
    robot = CarRobot(Scene.random(1, "box"), PERIOD)
    assert robot.state_message().towed == towed_reach(LOADS["box"])
    robot.unhitch()
    assert robot.state_message().towed == ()
    robot.hitch(LOADS["chair"])
    assert robot.state_message().towed == towed_reach(LOADS["chair"])


def drive(robot: CarRobot, ticks: int, speed: float, steer: float) -> None:
    for _ in range(ticks):
        action = ActionMessage(
            epoch=robot.guard.epoch, tick=robot.tick, robot_time=robot.tick * robot.period, publish_time=0.0,
            values=(speed, steer),
        )  # fmt: skip
        assert robot.receive(action) is None
        robot.advance()


def test_the_robot_reports_the_distance_that_a_filter_without_gaps_counts() -> None:
    robot, way = CarRobot(Scene.random(3, "box")), ReverseOdometer()
    reported = []
    for number, speed in enumerate([0.0, *[1.0] * 20, *[-0.5] * 15, *[0.6] * 5]):
        state = robot.state_message()
        reported.append(state.distance_reversed)
        way.follow(replace(state, distance_reversed=-1.0))
        assert state.distance_reversed == way.way, f"tick {number}, to the last bit"
        drive(robot, 1, speed, 0.1)
    assert reported[0] == robot.state_message().towed[1], "at first no one knows how the load hangs"
    assert min(reported) == 0.0
    assert reported[-1] > 0.0


def test_another_load_hangs_at_an_unknown_angle_and_none_is_not_counted() -> None:
    robot = CarRobot(Scene.random(3, "none"))
    drive(robot, 5, 1.0, 0.0)
    assert robot.state_message().distance_reversed == -1.0
    robot.hitch(LOADS["chair"])
    state = robot.state_message()
    assert state.distance_reversed == state.towed[1]
    drive(robot, 12, 1.0, 0.0)
    assert robot.state_message().distance_reversed < state.towed[1]
    robot.unhitch()
    assert robot.state_message().distance_reversed == -1.0


def test_a_restarted_filter_has_the_same_h_as_the_old_one() -> None:
    robot, settings = CarRobot(Scene.random(3, "box")), settings_named("car")
    old = CarScene(settings)
    for _ in range(25):
        old.of(robot.state_message())
        drive(robot, 1, 1.0, 0.0)
    state = robot.state_message()
    before, after = old.of(state), CarScene(settings).of(state)
    assert not isinstance(before, str)
    assert not isinstance(after, str)
    assert after.h_floats(state.values) == before.h_floats(state.values)


def test_updated_barriers_equal_newly_built_ones() -> None:
    robot, settings = CarRobot(Scene.random(3, "box")), settings_named("car")
    scene = CarScene(settings)
    for number, speed in enumerate([0.0, *[1.0] * 6, *[-0.5] * 8]):
        state = robot.state_message()
        if number == 9:  # the scene changes too
            state = replace(state, obstacles=state.obstacles[1:])
        found, restarted = scene.of(state), CarScene(settings)
        restarted.remember(scene)
        wanted = restarted.of(state)
        assert not isinstance(found, str)
        assert not isinstance(wanted, str)
        assert found.names == wanted.names
        assert found.rows == wanted.rows
        at = np.array(state.values)
        assert found.h_floats(state.values) == wanted.h_floats(state.values)
        np.testing.assert_array_equal(found.grad_h(at), wanted.grad_h(at))
        for part, other in zip(found, wanted, strict=True):
            np.testing.assert_array_equal(part.h_and_grad(at)[1], other.h_and_grad(at)[1])
        drive(robot, 1, speed, 0.1)


def test_obstacles_of_a_car_with_a_load_are_parsed_once() -> None:
    """Each tick moves the load; obstacles, field and the names of their rows stay."""
    robot = CarRobot(Scene.random(3, "box"))
    scene = CarScene(settings_named("car"))
    before = scene.of(robot.state_message())
    drive(robot, 1, 1.0, 0.0)
    after = scene.of(robot.state_message())
    assert not isinstance(before, str)
    assert not isinstance(after, str)
    assert after is not before
    assert after.names is before.names
    assert after.rows is before.rows
    for part, other in zip(before, after, strict=True):
        assert isinstance(part, AbstractEquationBarrier)
        assert isinstance(other, AbstractEquationBarrier)
        assert other.each is part.each


def test_hitching_a_load_is_not_counted_as_a_model_error() -> None:
    """A load reported between two ticks lowers h by its reach, which the model did not predict."""
    model = load_model("car")
    node = SafetyFilterNode(model, settings_named("car"), margin_for(model))
    state = replace(CarRobot(Scene.random(3, "none")).state_message(), applied_by="filter", values=(0.0, 0.0, 0.0, 0.0))
    state = replace(state, obstacles=((-1.0, 0.0, 0.2),))
    for towed in ((), (), (0.1, 0.5, 0.6)):
        state = replace(state, tick=state.tick + 1, robot_time=state.robot_time + state.period, towed=towed)
        stamped = {"epoch": state.epoch, "tick": state.tick, "robot_time": state.robot_time, "publish_time": 0.0}
        known = tuple(model.latent.tolist())
        latent = LatentMessage(  # type: ignore[arg-type]
            **stamped, model=fingerprint(model), values=known, deviations=(0.1,) * len(known)
        )
        nominal = NominalMessage(**stamped, values=(0.0, 0.0), controller="t")  # type: ignore[arg-type]
        node.step("r", state, {LATENT: latent, NOMINAL: nominal})
        verdict = node.afterwards("r")[VERDICT]
        assert isinstance(verdict, VerdictMessage)
        state = replace(state, values=verdict.predicted[0], applied=verdict.action)
    assert verdict.h_now < 0.2
    assert verdict.coverage == 1.0, "no step missed its margin"
