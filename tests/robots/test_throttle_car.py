"""The simulated car whose action is a throttle: it rolls at 0, answers as its motor does, and brakes by itself."""

from __future__ import annotations

import pytest

from safedpa.bus import ActionMessage
from safedpa.errors import InputError
from safedpa_sim.robots import CarRobot, Scene
from safedpa_sim.robots.car_parameters import THROTTLE_CAR
from safedpa_sim.robots.world import CarWorld

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


def test_the_dead_zone_moves_nothing_and_nothing_brakes_but_resistance() -> None:
    assert speed_after(0.16, 3.0) == pytest.approx(0.0, abs=1e-6)
    rolled = speed_after(0.0, 0.5, begun=1.5)
    assert 0.6 < rolled < 1.5 - 0.5 * THROTTLE_CAR.rolling


def test_steering_slows_it() -> None:
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


def test_its_gate_takes_a_throttle_and_refuses_more() -> None:
    robot = CarRobot(SCENE, parameters=THROTTLE_CAR)
    assert robot.guard.low == (-1.0, -0.34)
    state = robot.state_message()
    message = ActionMessage(
        epoch=state.epoch, tick=state.tick, robot_time=state.robot_time, publish_time=0.0, values=(1.2, 0.0)
    )
    assert robot.receive(message) == "out of range"
    assert robot.state_message().footprint == (THROTTLE_CAR.rear, THROTTLE_CAR.front, THROTTLE_CAR.width / 2)


def test_it_tows_nothing() -> None:
    with pytest.raises(InputError, match="got 'box' behind a car with a throttle, wanted none"):
        CarRobot(Scene.random(1, "box"), parameters=THROTTLE_CAR)
