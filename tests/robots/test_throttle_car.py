"""The car with a throttle and the differential drive: their simulated worlds, and how they stop."""

import json
from math import copysign, cos, sin
from pathlib import Path

import numpy as np
import pytest

from safedpa.bus import ActionMessage
from safedpa.check_robot import check_robot
from safedpa.dynamics.model_file import parse_model
from safedpa.errors import InputError
from safedpa.robots.differential_drive.barriers import Shape, wheeled_barriers
from safedpa.robots.differential_drive.ros_face import DifferentialDriveFace
from safedpa.safety.defaults import settings_named
from safedpa.systems.robots import robot_named
from safedpa_lab.experiments.driving.differential_drive import WheelsDrive, run_drive
from safedpa_services.command_line.group import safedpa
from safedpa_sim.differential_drive.stand_in import WORLDS, WheeledStandIn
from safedpa_sim.robots import CarRobot, Scene
from safedpa_sim.robots.car.parameters import THROTTLE_CAR
from safedpa_sim.robots.car.world import CarWorld

OPEN = (-500.0, 500.0, -500.0, 500.0)
SCENE = Scene(0, None, OPEN, (), (0.0, 0.0, 0.3), ((50.0, 0.0),))


def speed_after(throttle: float, seconds: float, steer: float = 0.0, begun: float = 0.0) -> float:
    world = CarWorld((0.0, 0.0, 0.0), OPEN, parameters=THROTTLE_CAR)
    world.body.velocity = (begun, 0.0)
    for _ in range(round(seconds / 0.05)):
        world.advance(throttle, steer, 0.05)
    return world.state[3]


def driven(robot: CarRobot, throttle: float, ticks: int) -> list[float]:
    speeds = []
    for _ in range(ticks):
        state = robot.state_message()
        message = ActionMessage(
            epoch=state.epoch, tick=state.tick, robot_time=state.robot_time, publish_time=0.0, values=(throttle, 0.0)
        )
        assert robot.receive(message) is None
        robot.advance()
        speeds.append(robot.values[3])
    return speeds


@pytest.mark.parametrize("throttle", [0.3, 0.5, -0.4])
def test_the_steady_speed_is_where_the_motor_meets_the_resistance(throttle: float) -> None:
    car, motor = THROTTLE_CAR, THROTTLE_CAR.throttle
    felt = abs(throttle) - motor.dead_zone
    expected = (motor.gain * felt - car.rolling) / (motor.back_emf * felt + car.viscous)
    assert abs(speed_after(throttle, 12.0)) == pytest.approx(expected, rel=0.02)


def test_steering_slows_it_the_dead_zone_moves_nothing_and_nothing_brakes_but_resistance() -> None:
    assert speed_after(0.16, 3.0) == pytest.approx(0.0, abs=1e-6)
    rolled = speed_after(0.0, 0.5, begun=1.5)
    assert 0.6 < rolled < 1.5 - 0.5 * THROTTLE_CAR.rolling
    assert speed_after(0.35, 10.0, 0.2) < 0.85 * speed_after(0.35, 10.0)


def test_its_watchdog_brakes_it_to_rest_and_not_backwards() -> None:
    robot = CarRobot(SCENE, parameters=THROTTLE_CAR)
    fast = driven(robot, 0.5, 60)[-1]
    assert fast > 1.5
    speeds = []
    for _ in range(60):
        robot.advance()
        speeds.append(robot.values[3])
    assert robot.watchdog_ticks == 60
    assert min(speeds) > -0.02
    assert robot.at_rest
    stopped = next(index for index, speed in enumerate(speeds) if speed < 0.1)
    assert 0.05 * stopped < 1.5


def test_its_guard_accepts_a_throttle_within_limits_and_it_tows_nothing() -> None:
    robot = CarRobot(SCENE, parameters=THROTTLE_CAR)
    assert robot.guard.low == (-1.0, -0.34)
    state = robot.state_message()
    message = ActionMessage(
        epoch=state.epoch, tick=state.tick, robot_time=state.robot_time, publish_time=0.0, values=(1.2, 0.0)
    )
    assert robot.receive(message) == "out of range"
    assert robot.state_message().footprint == (THROTTLE_CAR.rear, THROTTLE_CAR.front, THROTTLE_CAR.width / 2)
    with pytest.raises(InputError, match="got 'box' behind a car with a throttle, wanted none"):
        CarRobot(Scene.random(1, "box"), parameters=THROTTLE_CAR)


SETTINGS = settings_named("differential_drive")
MODEL = """
format = 1
robot = "differential_drive"
period = 0.05
[base]
kind = "servo_wheels"
track = 0.233
gain = 10.0
acceleration_limit = 1.2
[[effects]]
name = "{name}"
{numbers}
"""


@pytest.mark.long
def test_the_differential_drive_passes_the_robot_check() -> None:
    found = check_robot(robot_named("differential_drive"))
    assert [str(one) for one in found if not one.ends_well] == []


@pytest.mark.parametrize("world", WORLDS)
def test_a_policy_that_ignores_obstacles_touches_nothing_with_the_filter_alone(world: str) -> None:
    with_filter = [run_drive(WheelsDrive(world, seed, "straight", True, 8.0)) for seed in (21, 22)]
    without = [run_drive(WheelsDrive(world, seed, "straight", False, 8.0)) for seed in (21, 22, 23)]
    assert [one["collisions"] for one in with_filter] == [0, 0]
    assert all(one["way"] > 0.3 for one in with_filter)
    assert sum(one["collisions"] for one in without) > 0


@pytest.mark.parametrize("shape", [Shape(0.0, 0.0, 0.17, 0.233), Shape(0.3, 0.1, 0.2, 0.5)])
def test_no_h_decreases_while_each_wheel_brakes_as_guaranteed(shape: Shape) -> None:
    draw = np.random.default_rng(8)
    low, gain, step = SETTINGS.barrier("braking_deceleration"), SETTINGS.barrier("braking_gain"), 5e-4
    for _ in range(60):
        obstacles = np.column_stack([draw.uniform(-2.0, 2.0, (5, 2)), draw.uniform(0.1, 0.4, 5)])
        parts = wheeled_barriers(SETTINGS, shape, obstacles, (-2.0, 2.0, -2.0, 2.0))[:2]
        x, y, yaw = draw.uniform(-1.5, 1.5), draw.uniform(-1.5, 1.5), draw.uniform(-3.0, 3.0)
        left, right = draw.uniform(-0.8, 0.8, 2)
        before = None
        for index in range(2500):
            speed, turn = 0.5 * (left + right), (right - left) / shape.track
            if index % 50 == 0:
                rooms, walls = (part.h(np.array([x, y, yaw, speed, turn])) for part in parts)
                now = np.concatenate([rooms, np.minimum(walls[:4], walls[4:])])  # the end closer to each wall
                assert before is None or (now - before).min() > -2e-4
                before = now
            x, y, yaw = x + step * speed * cos(yaw), y + step * speed * sin(yaw), yaw + step * turn
            left, right = (w - copysign(step * min(gain * abs(w), low), w) for w in (left, right))


def test_invalid_scenes_are_refused() -> None:
    for shape, obstacles, field in (
        (Shape(0.0, 0.0, -0.1, 0.2), (), ()),
        (Shape(0.0, -1.0, 0.1, 0.2), (), ()),
        (Shape(0.0, 0.0, 0.1, 0.0), (), ()),
        (Shape(0.0, 0.0, 0.1, 0.2), ((1.0, 2.0),), ()),
        (Shape(0.0, 0.0, 0.1, 0.2), ((1.0, float("nan"), 0.1),), ()),
        (Shape(0.0, 0.0, 0.1, 0.2), (), (1.0, -1.0, 0.0, 1.0)),
    ):
        with pytest.raises(InputError, match="wanted"):
            wheeled_barriers(SETTINGS, shape, obstacles, field)


@pytest.mark.parametrize(
    ("name", "numbers", "world"),
    [
        ("wheel_radius", "ratio = 0.9", {"radius": 0.9}),
        ("unequal_wheels", "pull = 0.4292", {"difference": 0.1}),
        ("track_error", "ratio = 1.2", {"track": 1.2}),
        ("payload", "mass_ratio = 0.8", {"payload": 0.8}),
        ("drive_lag", "time_constant = 0.12", {"lag": 0.22}),
    ],
)
def test_an_effect_moves_the_model_towards_the_wheels_that_have_it(name: str, numbers: str, world: dict[str, float]):
    def missed(model_text: str) -> float:
        model = parse_model(model_text, Path())
        truth = WheeledStandIn(3, grip=1.5, **world)
        state, action = np.array(truth.values), np.array((0.35, 0.8))
        memory = model.initial_memory(np.zeros(2))
        worst = 0.0
        for _ in range(20):
            state, memory = model.advance(state, action, memory=memory)
            truth.advance(tuple(action), 0.05)
            assert truth.contact() == ""
            worst += float(np.abs(state - np.array(truth.values)) @ (1.0, 1.0, 1.0, 1.0, 0.3))
        return worst

    plain = MODEL.format(name="payload", numbers="mass_ratio = 0.0")
    assert missed(MODEL.format(name=name, numbers=numbers)) < 0.75 * missed(plain)


def test_a_differential_drive_is_commanded_by_twist_and_refuses_worlds_of_other_robots() -> None:
    face = DifferentialDriveFace()
    assert face.state(1.0, 2.0, 0.5, 0.3, -0.2) == (1.0, 2.0, 0.5, 0.3, -0.2)
    assert face.message("geometry_msgs/msg/Twist", (0.3, 1.1), ()) == {"linear": {"x": 0.3}, "angular": {"z": 1.1}}
    assert face.paths("geometry_msgs/msg/TwistStamped") == ("twist.linear.x", "twist.angular.z")
    with pytest.raises(InputError, match="wanted one of geometry_msgs/msg/Twist"):
        face.paths("ackermann_msgs/msg/AckermannDrive")
    for wrong in ({"grip": -1.0}, {"lag": float("nan")}, {"radius": 2.0}):
        with pytest.raises(InputError, match=f"--world {next(iter(wrong))}="):
            WheeledStandIn(0, **wrong)


@pytest.mark.processes
def test_up_drives_the_differential_drive_and_refuses_another_robot_s_model(tmp_path, capfd):
    phrase = ["up", "--robot", "differential_drive", "--lockstep", "--headless", "--seconds", "6", "--json"]
    assert safedpa.run([*phrase, "--world", "grip=0.3", "--seed", "2", "--out", str(tmp_path)]) == 0
    summary = json.loads(capfd.readouterr().out)
    assert summary["collisions"] == 0
    assert summary["ticks"] == 120
    assert safedpa.run([*phrase, "--model", "point", "--out", str(tmp_path)]) == 2
    assert "--model point" in capfd.readouterr().err
