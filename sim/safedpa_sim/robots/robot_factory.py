"""Creates the simulated robot that the options of its process describe."""

from __future__ import annotations

import argparse
import secrets
from collections.abc import Callable

from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.runtime.scene import check_senses
from safedpa.stand_in import AbstractStandIn, world_number
from safedpa.systems.robots import Robot, robot_named
from safedpa_sim.point.body import CONTROL_SECONDS
from safedpa_sim.robots.car.parameters import CAR_PARAMETERS, THROTTLE_CAR
from safedpa_sim.robots.car.robot import CarRobot, PlannedChange
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.robots.pendulum.robot import PendulumRobot, task_named
from safedpa_sim.robots.pendulum.world import PendulumParameters, wind_towards
from safedpa_sim.robots.point_robot import PointRobot, force_towards
from safedpa_sim.robots.robot import SimulatedRobot
from safedpa_sim.robots.stand_in_robot import StandInRobot
from safedpa_sim.sensing import Laser, LaserSettings
from safedpa_sim.sensing.people import MOST_PEOPLE, walkers, walkers_in
from safedpa_sim.sensing.sensor_inputs import SimulatedSensors
from safedpa_sim.sensing.stand_in_sensors import StandInSensors

SHIPPED = ("car", "pendulum", "point")
"""Robots that are simulated in this package; other robot packages bring their own stand-in."""
_EPOCH_BITS = 53
"""Integers of this size are exact in every reader of a recording, including those that use doubles."""


def make_robot(options: argparse.Namespace) -> SimulatedRobot:
    """Creates the robot that the options of ``python -m safedpa_sim.robots`` describe, with a new random epoch.

    Raises InputError naming the invalid option.
    """
    if not 1.0 <= options.rate <= 500.0:
        raise InputError(f"--rate: got {options.rate}, wanted 1 to 500 ticks per second")
    if not 0.0 <= options.seconds < 1e9:
        raise InputError(f"--seconds: got {options.seconds}, wanted 0 (no limit) or more")
    if options.seed < 0:
        raise InputError(f"--seed: got {options.seed}, wanted 0 or more")
    if not 0.0 <= options.change_after < 1e9:
        raise InputError(f"--change-after: got {options.change_after}, wanted 0 s or more")
    epoch = secrets.randbits(_EPOCH_BITS)
    if options.robot not in SHIPPED:
        given = dict(world_number(text) for text in options.world)
        declared = robot_named(options.robot)
        sensors = _stand_in_sensors(options, declared)
        return StandInRobot(declared, 1.0 / options.rate, options.seed, given, options.lockstep, epoch, sensors=sensors)
    if options.world:
        raise InputError(
            f"--world: got {options.world[0]} for a {options.robot}, which has its own options; wanted your own robot"
        )
    if options.drive == "throttle" and options.robot != "car":
        raise InputError(f"--drive: got a throttle for a {options.robot}, wanted none; it is the car's")
    if options.robot != "car" and (options.laser or options.people):
        raise InputError(
            f"--laser, --people: got one for a {options.robot}, whose simulation has no sensors; leave them out"
        )
    if options.robot == "pendulum":
        return _pendulum(options, epoch)
    if options.robot == "point":
        return _point(options, epoch)
    return _car(options, epoch)


def _car(options: argparse.Namespace, epoch: int) -> CarRobot:
    throttle = options.drive == "throttle"
    if throttle and (options.load != "none" or options.change == "hitch"):
        raise InputError("--load, --change: got a load for a car with a throttle, wanted none")
    scene = Scene.random(options.seed, options.load)
    change = None if options.change == "none" else PlannedChange(options.change, options.change_after)
    parameters = THROTTLE_CAR if throttle else CAR_PARAMETERS
    return CarRobot(
        scene,
        1.0 / options.rate,
        options.lockstep,
        epoch=epoch,
        change=change,
        parameters=parameters,
        sensor_inputs=_sensor_inputs(options, scene),
    )


def _stand_in_sensors(options: argparse.Namespace, robot: Robot) -> Callable[[AbstractStandIn], StandInSensors] | None:
    """Returns what puts a laser on a stand-in, and people around it; None without a laser."""
    _check_people(options)
    if not options.laser:
        return None
    model = load_model(str(robot.model))
    settings = robot.settings()
    check_senses(model, settings, "--laser")
    body = robot.planar_body(model, settings)
    names = robot.system.state_names
    x, y = (names.index(name) for name in body.pose[:2])
    pose = (x, y, names.index(body.pose[2]) if len(body.pose) == 3 else -1)

    def sensors(stand_in: AbstractStandIn) -> StandInSensors:
        laser = Laser(LaserSettings(mount=(0.0, 0.0, 0.0)), options.seed)
        empty = StandInSensors((laser,), pose=pose)
        field = stand_in.field if len(stand_in.field) == 4 else (-5.0, 5.0, -5.0, 5.0)
        start = empty.pose(stand_in)[:2]
        people = walkers_in(empty.solid(stand_in), field, start, options.people, options.seed)
        return StandInSensors((laser,), people, pose=pose, parts=body.parts)

    return sensors


def _check_people(options: argparse.Namespace) -> None:
    if not 0 <= options.people <= MOST_PEOPLE:
        raise InputError(f"--people: got {options.people}, wanted 0 to {MOST_PEOPLE}")
    if options.people and not options.laser:
        raise InputError(f"--people: got {options.people} without --laser; people need a robot with a laser scanner")


def _sensor_inputs(options: argparse.Namespace, scene: Scene) -> SimulatedSensors | None:
    _check_people(options)
    if not options.laser:
        return None
    return SimulatedSensors((Laser(LaserSettings(), options.seed),), walkers(scene, options.people))


def _pendulum(options: argparse.Namespace, epoch: int) -> PendulumRobot:
    if options.load != "none" or options.change != "none":
        raise InputError("--load, --change: got one for a pendulum, wanted none; they are the car's")
    if not 0.0 <= options.wind <= 15.0:
        raise InputError(f"--wind: got {options.wind}, wanted 0 to 15 m/s")
    if not -360.0 <= options.wind_direction <= 360.0:
        raise InputError(f"--wind-direction: got {options.wind_direction}, wanted -360 to 360 degrees")
    wind = wind_towards(options.wind, options.wind_direction)
    task = task_named(options.task)
    body = PendulumParameters(payload=options.payload, dry_friction=options.dry_friction)
    return PendulumRobot(task, wind, options.seed, body, 1.0 / options.rate, options.lockstep, epoch=epoch)


def _point(options: argparse.Namespace, epoch: int) -> PointRobot:
    if options.load != "none" or options.change != "none":
        raise InputError("--load, --change: got one for a point robot, wanted none; they are the car's")
    if abs(options.rate * CONTROL_SECONDS - 1.0) > 1e-6:
        raise InputError(f"--rate: got {options.rate:g}, wanted the point robot's {1.0 / CONTROL_SECONDS:g}")
    if not -360.0 <= options.wind_direction <= 360.0:
        raise InputError(f"--wind-direction: got {options.wind_direction}, wanted -360 to 360 degrees")
    force = force_towards(options.force, options.wind_direction)
    return PointRobot(force, options.seed, options.lockstep, epoch=epoch)
