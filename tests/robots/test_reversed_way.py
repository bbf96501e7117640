"""A robot that tows counts how far it was driven backwards, so that a filter that dies takes nothing with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from safedpa.bus import LATENT, VERDICT, WISH, ActionMessage
from safedpa.bus.wire.messages import LatentMessage, VerdictMessage, WishMessage
from safedpa.dynamics import fingerprint, load_model
from safedpa.robots.car.car_scene import CarScene
from safedpa.robots.car.reversed_way import ReversedWay
from safedpa.safety.equation_barrier import AbstractEquationBarrier
from safedpa.safety.node import SafetyFilterNode
from safedpa.safety.shipped import margin_for, settings_named
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


def test_another_load_hangs_at_an_unknown_angle_and_none_is_not_counted() -> None:
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


def test_a_filter_that_is_started_again_sees_the_room_that_the_old_one_saw() -> None:
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


def test_the_barriers_follow_the_load_as_if_they_were_built_again() -> None:
    robot, settings = CarRobot(Scene.random(3, "box")), settings_named("car")
    scene = CarScene(settings)
    for number, speed in enumerate([0.0, *[1.0] * 6, *[-0.5] * 8]):
        state = robot.state_message()
        if number == 9:  # what is seen changes, too
            state = replace(state, obstacles=state.obstacles[1:])
        found, anew = scene.of(state), CarScene(settings)
        anew.remember(scene)
        wanted = anew.of(state)
        assert not isinstance(found, str)
        assert not isinstance(wanted, str)
        assert found.names == wanted.names
        assert found.rows == wanted.rows
        at = np.array(state.values)
        assert found.heights(state.values) == wanted.heights(state.values)
        np.testing.assert_array_equal(found.gradient(at), wanted.gradient(at))
        for part, other in zip(found, wanted, strict=True):
            np.testing.assert_array_equal(part.evaluate(at)[1], other.evaluate(at)[1])
        drive(robot, 1, speed, 0.1)


def test_a_car_that_tows_has_its_obstacles_read_once() -> None:
    """Each tick moves the load; obstacles, field and what their rows are called stay."""
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


def test_a_load_that_is_hitched_is_no_error_of_the_model() -> None:
    """Told between two ticks, it takes h down by its reach; the model foresaw the motion, and not the load."""
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
        wish = WishMessage(**stamped, values=(0.0, 0.0), controller="t")  # type: ignore[arg-type]
        node.step("r", state, {LATENT: latent, WISH: wish})
        verdict = node.afterwards("r")[VERDICT]
        assert isinstance(verdict, VerdictMessage)
        state = replace(state, values=verdict.predicted[0], applied=verdict.action)
    assert verdict.h_now < 0.2
    assert verdict.coverage == 1.0, "no step missed its margin"
