"""The robot without a bus: determinism, watchdog, goals, collisions, what its state says."""

from __future__ import annotations

from dataclasses import replace
from math import hypot, pi, sin

import pytest

from safedpa.bus.wire.codec import decode, encode
from safedpa.bus.wire.messages import ActionMessage, StateMessage
from safedpa.errors import InputError
from safedpa_sim.robots import LOADS, CarRobot, Scene, footprint

FIELD = (-4.0, 4.0, -4.0, 4.0)
LOAD_NAMES = ("none", *LOADS)


def scene(load: str = "none", start: tuple[float, float, float] = (0.0, 0.0, 0.0), **fields) -> Scene:
    return Scene(0, LOADS.get(load), FIELD, fields.pop("obstacles", ()), start, fixed_goals=((3.0, 3.0),), **fields)


def drive(robot: CarRobot, values: tuple[float, float], ticks: int) -> CarRobot:
    for _ in range(ticks):
        message = ActionMessage(epoch=1, tick=robot.tick, robot_time=0.0, publish_time=0.0, values=values)
        assert robot.receive(message) is None
        robot.advance()
    return robot


@pytest.mark.parametrize("load", LOAD_NAMES)
def test_the_same_seed_and_actions_give_bit_equal_states(load):
    def run() -> tuple[list[tuple[float, ...]], str]:
        robot, states = CarRobot(Scene.random(7, load)), []
        for step in range(300):
            drive(robot, (1.2 + 0.7 * sin(0.05 * step), 0.34 * sin(0.13 * step)), 1)
            states.append(robot.values)
        return states, robot.trajectory_hash

    first, second = run(), run()
    assert first == second


def test_another_action_gives_another_hash():
    assert (
        drive(CarRobot(scene()), (1.0, 0.0), 5).trajectory_hash
        != drive(CarRobot(scene()), (1.0, 0.1), 5).trajectory_hash
    )


@pytest.mark.parametrize("load", LOAD_NAMES)
def test_without_actions_the_watchdog_brings_the_robot_to_rest(load):
    robot = drive(CarRobot(scene(load, (-3.0, 0.0, 0.0))), (2.0, 0.0), 40)
    assert robot.values[3] > 1.3
    for _ in range(60):
        robot.advance()
    state = robot.state_message()
    assert abs(state.values[3]) < 1e-3
    assert (state.applied, state.applied_by) == ((0.0, 0.0), "watchdog")
    assert robot.watchdog_ticks == 60


@pytest.mark.parametrize(("heading", "wall"), [(0.0, "east"), (pi / 2, "north"), (pi, "west"), (-pi / 2, "south")])
def test_driving_into_a_wall_is_one_collision_with_that_wall(heading, wall):
    robot = drive(CarRobot(scene(start=(0.0, 0.0, heading))), (1.5, 0.0), 200)
    (collision,) = robot.collisions
    assert (collision.part, collision.what) == ("car", f"wall {wall}")
    assert collision.speed > 1.2
    assert robot.state_message().collisions == 1
    x, y, _, _ = robot.values
    assert max(abs(x), abs(y)) + 0.40 < 4.01, "it does not go through"
    assert f"car against wall {wall}" in str(collision)


def test_every_obstacle_that_is_hit_is_named_and_counted():
    robot = CarRobot(scene(obstacles=((2.0, 3.0, 0.3), (1.5, 0.0, 0.3))))
    drive(robot, (1.0, 0.0), 80)
    assert [collision.what for collision in robot.collisions] == ["obstacle 1"]
    drive(robot, (-0.5, 0.0), 60)
    drive(robot, (1.0, 0.0), 80)
    assert [collision.what for collision in robot.collisions] == ["obstacle 1", "obstacle 1"], "a second contact counts"


def test_a_load_that_touches_counts_as_the_load():
    # The car passes, the load that cuts the corner behind it is wider.
    robot = CarRobot(scene("large_chair", obstacles=((1.0, 0.40, 0.22),)))
    drive(robot, (1.0, 0.0), 100)
    assert [(collision.part, collision.what) for collision in robot.collisions] == [("load", "obstacle 0")]


def test_passing_close_to_an_obstacle_is_no_collision():
    radius = footprint(None)[2]
    robot = CarRobot(scene(obstacles=((1.0, 0.3 + radius + 0.005, 0.3),)))
    assert drive(robot, (1.0, 0.0), 60).collisions == []


def test_a_goal_counts_when_the_rear_axle_is_near_and_the_next_one_follows():
    robot = CarRobot(replace(scene(), fixed_goals=((1.0, 0.0), (3.0, 2.0))))
    while robot.goals_reached == 0:
        x, y, _, _ = robot.values
        assert hypot(1.0 - x, y) >= 0.3
        assert robot.goal == (1.0, 0.0)
        drive(robot, (1.0, 0.0), 1)
    assert robot.goal == (3.0, 2.0)


def test_the_state_message_says_what_the_robot_knows_and_survives_the_codec():
    robot = CarRobot(Scene.random(2, "box"), 0.05, True, epoch=77, wall_clock=lambda: 12.5)
    first = robot.state_message()
    assert (first.epoch, first.tick, first.applied_by, first.publish_time) == (77, 0, "none", 12.5)
    assert first.footprint == footprint(LOADS["box"])
    assert len(first.obstacles) == 6
    assert len(first.load_pose) == 5
    robot.advance()
    second = robot.state_message()
    assert (second.tick, second.robot_time) == (1, 0.05)
    assert decode(StateMessage, encode(second)) == second


def test_unhitching_shrinks_the_footprint_and_hitching_grows_it():
    robot = drive(CarRobot(scene("chair")), (1.0, 0.0), 20)
    robot.unhitch()
    assert robot.state_message().footprint == footprint(None)
    assert robot.state_message().load_pose == ()
    robot.hitch(LOADS["box"])
    assert robot.state_message().footprint == footprint(LOADS["box"])


def test_other_periods_tell_the_same_physics():
    coarse, fine = CarRobot(scene(), period=0.1), CarRobot(scene(), period=0.01)
    drive(coarse, (1.5, 0.2), 20)
    drive(fine, (1.5, 0.2), 200)
    assert coarse.values == pytest.approx(fine.values, abs=1e-9)
    with pytest.raises(InputError, match="period"):
        CarRobot(scene(), period=0.0)
