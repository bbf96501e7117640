"""A robot that tows counts how far it was driven backwards, so that a filter that dies takes nothing with it."""

from __future__ import annotations

from dataclasses import replace

from safedpa.bus import ActionMessage
from safedpa.robots.car.car_scene import CarScene
from safedpa.safety.reversed_way import ReversedWay
from safedpa.safety.shipped import settings_named
from safedpa_sim.robots.core import CarRobot
from safedpa_sim.robots.loads import LOADS
from safedpa_sim.robots.scene import Scene


def drive(robot: CarRobot, ticks: int, speed: float, steer: float) -> None:
    for _ in range(ticks):
        action = ActionMessage(
            epoch=robot.guard.epoch,
            tick=robot.tick,
            robot_time=robot.tick * robot.period,
            publish_time=0.0,
            values=(speed, steer),
        )
        assert robot.receive(action) is None
        robot.advance()


def test_the_robot_tells_what_a_filter_counts_that_never_slept() -> None:
    robot, way = CarRobot(Scene.random(3, "box")), ReversedWay()
    told = []
    for number, speed in enumerate([0.0, *[1.0] * 20, *[-0.5] * 15, *[0.6] * 5]):
        state = robot.state_message()
        told.append(state.reversed_way)
        way.follow(replace(state, reversed_way=-1.0))
        assert state.reversed_way == way.way, f"tick {number}, to the last bit"
        drive(robot, 1, speed, 0.1)
    assert told[0] == robot.state_message().towed[1], "at first nobody knows how the load hangs"
    assert min(told) == 0.0
    assert told[-1] > 0.0


def test_another_load_hangs_as_nobody_knows_and_none_is_not_counted() -> None:
    robot = CarRobot(Scene.random(3, "none"))
    drive(robot, 5, 1.0, 0.0)
    assert robot.state_message().reversed_way == -1.0
    robot.hitch(LOADS["chair"])
    state = robot.state_message()
    assert state.reversed_way == state.towed[1]
    drive(robot, 12, 1.0, 0.0)
    assert robot.state_message().reversed_way < state.towed[1]
    robot.unhitch()
    assert robot.state_message().reversed_way == -1.0


def test_a_filter_that_is_started_anew_sees_the_room_that_the_old_one_saw() -> None:
    robot, settings = CarRobot(Scene.random(3, "box")), settings_named("car")
    old = CarScene(settings)
    for _ in range(25):
        old.of(robot.state_message())
        drive(robot, 1, 1.0, 0.0)
    state = robot.state_message()
    before, after = old.of(state), CarScene(settings).of(state)
    assert not isinstance(before, str)
    assert not isinstance(after, str)
    assert after.heights(state.values) == before.heights(state.values)
